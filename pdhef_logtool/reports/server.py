"""``pdhef serve``: pages over the Parquet files of runs, read only, for a browser on this machine.

The server answers only requests to a loopback address: a name that an attacker resolves to 127.0.0.1 is refused. It
writes nothing, and serves no file but the reports of the runs. They run in a sandbox: a run may come from elsewhere.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote, urlencode

import numpy as np
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import FileResponse, HTMLResponse, Response
from starlette.routing import Route

from pdhef_logtool.evaluation.units import LABELS, SCORED_SIGNALS, read_unit
from pdhef_logtool.records.errors import OutputError
from pdhef_logtool.reports.charts import Charts, Cloud, PointsFigure, Series, TimeFigure
from pdhef_logtool.reports.colours import colour
from pdhef_logtool.reports.encoding import Envelope, Grid, grid_of
from pdhef_logtool.reports.page import render
from pdhef_logtool.results.drive_rows import FIGURES, TEXTS, csv_text, drive_rows
from pdhef_logtool.results.opened_run import ESTIMATES_FILE, PAGE_FILE, OpenedLog, OpenedRun
from pdhef_logtool.results.parquet_sink import list_estimators, read_blocks
from pdhef_logtool.results.sink import TRUTH

if TYPE_CHECKING:
    import polars as pl

HOSTS = ["127.0.0.1", "localhost"]
#: Value of the estimator filter for the selected estimate of each drive.
SELECTED = "selected"
#: Rows on one page, points of a distribution, and tracks in one figure at most.
_ROWS, _POINTS, _MOST_TRACKS = 200, 400, 12
_DASHES: tuple[tuple[int, ...], ...] = ((), (6, 3), (2, 2), (8, 3, 2, 3))
_COLOURS = ("#0072b2", "#b2182b", "#00795a", "#7a5195", "#a05a00", "#6b7785")
_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
#: A stored report: its own scripts, without access to the other pages of this server or to the network.
_SANDBOX = (
    "sandbox allow-scripts; default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:"
)


@dataclass(frozen=True, slots=True)
class Query:
    """Filter, order and page of the table of drives, as in an address."""

    name: str = ""
    run: str = ""
    car: str = ""
    outcome: str = ""
    estimator: str = SELECTED
    at_least: float | None = None
    at_most: float | None = None
    sort: str = "sideslip_rmse_deg"
    order: str = "down"
    page: int = 1

    @classmethod
    def of(cls, given: Mapping[str, str]) -> Query:
        """Return the query of an address; a value that cannot be used is its default."""
        texts = {key: given[key] for key in ("name", "run", "car", "outcome") if key in given}
        sort = given.get("sort")
        return cls(
            **texts,
            estimator=given.get("estimator") or SELECTED,
            at_least=_number(given.get("at_least")),
            at_most=_number(given.get("at_most")),
            sort=sort if sort in (*TEXTS, *FIGURES) else "sideslip_rmse_deg",
            order="up" if given.get("order") == "up" else "down",
            page=max(1, int(_number(given.get("page")) or 1)),
        )

    def address(self, **changed: object) -> str:
        """Return the query string with changes."""
        entries = {slot: getattr(self, slot) for slot in self.__slots__} | changed
        return urlencode({k: v for k, v in entries.items() if v not in ("", None)})

    def rows(self, table: pl.DataFrame) -> pl.DataFrame:
        """Return the rows that the query selects, in its order; missing figures last."""
        import polars as pl

        wanted = [pl.col(key) == value for key in ("run", "car", "outcome") if (value := getattr(self, key))]
        wanted.append(pl.col("selected") if self.estimator == SELECTED else pl.col("estimator") == self.estimator)
        if self.name:
            wanted.append(pl.col("drive").str.to_lowercase().str.contains(self.name.lower(), literal=True))
        if self.at_least is not None:
            wanted.append(pl.col("sideslip_rmse_deg") >= self.at_least)
        if self.at_most is not None:
            wanted.append(pl.col("sideslip_rmse_deg") <= self.at_most)
        return table.filter(*wanted).sort(
            self.sort, descending=self.order == "down", nulls_last=True, maintain_order=True
        )


def _number(text: str | None) -> float | None:
    try:
        value = float(text or "")
    except ValueError:
        return None
    return value if math.isfinite(value) and abs(value) < 1e9 else None


class Library:
    """The drives of some runs, loaded once. ``runs``: by a name of their folder that is unique here."""

    def __init__(self, runs: Sequence[OpenedRun]) -> None:
        self.runs = dict(zip(_names(runs), runs, strict=True))
        self.table = drive_rows(list(self.runs.items()))
        self.logs = {name: {log.label: log for log in run.logs} for name, run in self.runs.items()}

    def log(self, run: str, drive: str) -> OpenedLog:
        """Return a log by the names in an address; raises HTTPException (404) for others."""
        try:
            return self.logs[run][drive]
        except KeyError:
            raise HTTPException(404, "No such drive.") from None

    def same_drive(self, log: OpenedLog) -> dict[str, OpenedLog]:
        """Return the drive in each run: by the content of its signals, else by its name."""
        digest = log.entry.get("signals_sha256")
        by_run = {}
        for name, logs in self.logs.items():
            match = logs.get(log.label)
            if digest and (match is None or match.entry.get("signals_sha256") != digest):
                match = next((other for other in logs.values() if other.entry.get("signals_sha256") == digest), match)
            if match is not None:
                by_run[name] = match
        return by_run


def _names(runs: Sequence[OpenedRun]) -> list[str]:
    """Return the name of each run's folder, with a number where several are equal."""
    names: list[str] = []
    for run in runs:
        name = Path(run.place).name or "run"
        names.append(name if name not in names else f"{name} ({len(names) + 1})")
    return names


def application(library: Library) -> Starlette:
    """Return the server's application."""

    def drives(request: Request) -> Response:
        return _drives(library, Query.of(request.query_params))

    def export(request: Request) -> Response:
        columns = [*TEXTS, *FIGURES]
        text = csv_text(columns, Query.of(request.query_params).rows(library.table).select(columns).iter_rows())
        headers = {**_HEADERS, "Content-Disposition": 'attachment; filename="drives.csv"'}
        return Response(text, media_type="text/csv; charset=utf-8", headers=headers)

    def drive(request: Request) -> Response:
        log = library.log(request.path_params["run"], request.path_params["drive"])
        tracks = request.query_params.getlist("track")
        return _drive(library, log, request.query_params.get("signal", ""), tracks)

    def report(request: Request) -> Response:
        return _stored(library, request.path_params["run"], request.path_params.get("drive"))

    routes = [
        Route("/", drives),
        Route("/drives.csv", export),
        Route("/drive/{run}/{drive}", drive),
        Route("/run/{run}/report.html", report),
        Route("/run/{run}/logs/{drive}/report.html", report),
    ]
    hosts = Middleware(TrustedHostMiddleware, allowed_hosts=HOSTS, www_redirect=False)
    return Starlette(
        routes=routes, middleware=[hosts], exception_handlers={HTTPException: _refused, OutputError: _damaged}
    )


def _page(template: str, charts: Charts, status: int = 200, **texts: Any) -> HTMLResponse:
    page = render(template, charts, forms=True, **texts)
    return HTMLResponse(page, status_code=status, headers=_HEADERS)


def _refused(_request: Request, error: Exception) -> Response:
    status, text = (error.status_code, error.detail) if isinstance(error, HTTPException) else (500, "")
    return _page("served_error.html", Charts(), status, text=text)


def _damaged(_request: Request, error: Exception) -> Response:
    return _page("served_error.html", Charts(), 500, text=str(error))


def _stored(library: Library, run: str, drive: str | None) -> Response:
    """Return a report that a run contains."""
    if run not in library.runs:
        raise HTTPException(404, "No such run.")
    folder = library.runs[run].folder
    path = folder / PAGE_FILE if drive is None else library.log(run, drive).file(PAGE_FILE)
    # A link that leads out of the run's folder is not followed.
    if path is None or not path.is_file() or not path.resolve().is_relative_to(folder.resolve()):
        raise HTTPException(404, "The run contains no such report: pdhef report OUT writes it.")
    return FileResponse(path, headers={**_HEADERS, "Content-Security-Policy": _SANDBOX})


def _drives(library: Library, query: Query) -> Response:
    table = library.table
    rows = query.rows(table)
    pages = max(1, -(-len(rows) // _ROWS))
    page = min(query.page, pages)
    shown = rows.slice((page - 1) * _ROWS, _ROWS)
    charts = Charts()
    _add_distributions(charts, rows, list(library.runs))
    heads = [
        {
            "column": column,
            "label": column.replace("_", " ") if column in TEXTS else _head(column),
            "sorted": ("descending" if query.order == "down" else "ascending") if query.sort == column else "",
            "address": query.address(
                sort=column, order="up" if query.sort == column and query.order == "down" else "down", page=1
            ),
        }
        for column in (*TEXTS, *FIGURES)
    ]
    return _page(
        "served_drives.html",
        charts,
        query=query,
        heads=heads,
        rows=[_row(row) for row in shown.iter_rows(named=True)],
        count=len(rows),
        drives=table.select("run", "drive").n_unique(),
        runs=[{"name": name, "page": (run.folder / PAGE_FILE).is_file()} for name, run in library.runs.items()],
        cars=_values(table, "car"),
        outcomes=_values(table, "outcome"),
        estimators=[SELECTED, *_values(table, "estimator")],
        page=page,
        pages=pages,
        before=query.address(page=page - 1),
        after=query.address(page=page + 1),
        export=query.address(page=""),
    )


def _values(table: pl.DataFrame, column: str) -> list[str]:
    return [value for value in table[column].unique().sort().to_list() if value]


def _head(column: str) -> str:
    signal, metric, _ = FIGURES[column]
    if metric == "coverage95":
        return "coverage of the 95 % CI"
    if metric == "d2":
        return "lateral kinematic consistency, m/s"
    unit, _ = read_unit(SCORED_SIGNALS[signal])
    return f"{LABELS[signal]} RMSE, {unit}"


def _row(row: Mapping[str, Any]) -> dict[str, Any]:
    return {
        **{key: row[key] or "" for key in TEXTS},
        "figures": [row[c] for c in FIGURES],
        "address": f"/drive/{quote(row['run'], safe='')}/{quote(row['drive'], safe='')}",
    }


def _add_distributions(charts: Charts, rows: pl.DataFrame, runs: Sequence[str]) -> None:
    """Draw the share of drives below an error, a line per run."""
    clouds = []
    for number, run in enumerate(runs):
        values = np.sort(rows.filter(rows["run"] == run)["sideslip_rmse_deg"].drop_nulls().to_numpy())
        if len(values) > 1:
            share = np.linspace(0.0, 1.0, min(len(values), _POINTS))
            shade = _COLOURS[number % len(_COLOURS)]
            clouds.append(Cloud(f"{run} ({len(values)})", shade, np.quantile(values, share), 100.0 * share, line=True))
    if clouds:
        title = "Share of the drives below an RMSE of sideslip, by run"
        charts.figures["distributions"] = PointsFigure(title, "RMSE of sideslip, °", "share of the drives, %", clouds)


def _drive(library: Library, log: OpenedLog, signal: str, chosen: Sequence[str]) -> Response:
    """Return the page of one drive: a signal of any tracks of any run, in one figure."""
    signal = signal if signal in SCORED_SIGNALS else "sideslip_rad"
    logs = library.same_drive(log)
    files = {name: path for name, match in logs.items() if (path := match.file(ESTIMATES_FILE)) is not None}
    offered = [(name, track) for name, path in files.items() for track in list_estimators(path)]
    truth = [place for place in offered if place[1] == TRUTH][:1]
    usual = [*truth, *((name, track) for name, track in offered if track == logs[name].main())]
    wanted = [place for place in offered if _key(*place) in chosen] or usual
    charts = Charts()
    if wanted:
        _add_tracks(charts, signal, [(name, track, files[name]) for name, track in wanted[:_MOST_TRACKS]])
    rows = library.table.filter(library.table["drive"].is_in([match.label for match in logs.values()]))
    return _page(
        "served_drive.html",
        charts,
        label=log.label,
        outcome=log.outcome,
        signal=signal,
        signals=[(s, LABELS[s]) for s in SCORED_SIGNALS],
        tracks=[
            {"key": _key(*place), "name": _shown(*place), "on": place in wanted[:_MOST_TRACKS]} for place in offered
        ],
        most=_MOST_TRACKS,
        rows=[_row(row) for row in rows.iter_rows(named=True) if logs.get(row["run"], log).label == row["drive"]],
        heads=[*TEXTS, *map(_head, FIGURES)],
        reports=[
            (name, f"/run/{quote(name, safe='')}/logs/{quote(match.label, safe='')}/report.html")
            for name, match in logs.items()
            if match.file(PAGE_FILE) is not None
        ],
    )


def _key(run: str, track: str) -> str:
    return f"{run}/{track}"


def _shown(run: str, track: str) -> str:
    return f"{run}: {'ground truth' if track == TRUTH else track}"


def _add_tracks(charts: Charts, signal: str, tracks: Sequence[tuple[str, str, Path]]) -> None:
    """Draw a signal of tracks over the time of the first one."""
    unit, factor = read_unit(SCORED_SIGNALS[signal])
    runs = list(dict.fromkeys(run for run, _, _ in tracks))
    grid: Grid | None = None
    series = []
    for run, track, path in tracks:
        blocks = [(b.stamps_ns, getattr(b, signal), b.valid) for b in read_blocks(path, track, (signal, "valid"))]
        if not blocks:
            continue
        if grid is None:
            grid = grid_of(np.concatenate([stamps for stamps, _, _ in blocks]))
        envelope = Envelope(grid)
        for stamps, values, valid in blocks:
            envelope.add(stamps, np.where(valid | (track == TRUTH), values, np.nan) * factor)
        dash = _DASHES[runs.index(run) % len(_DASHES)]
        series.append(Series(_shown(run, track), colour(track), envelope.values, dash=dash))
    if grid is not None:
        charts.grid, charts.origin_ns = grid, grid.start_ns
        charts.figures["tracks"] = TimeFigure(LABELS[signal].capitalize(), unit, series, height=320)
