"""mapping.toml: strict reading, and writing ready to edit (docs/formats.md#mappingtoml)."""

from collections.abc import Collection, Mapping as MappingABC, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, PositiveFloat

from pdhef_logtool.mapping.naming import UNITS, plain_unit, unit_of
from pdhef_logtool.mapping.records import CAN_PREFIX, RECORDER_STAMPS, CanSettings, Mapping, QualityGate, SignalSource
from pdhef_logtool.records.errors import MappingFileError
from pdhef_logtool.records.signals import ESTIMATE_UNITS, SIGNAL_UNITS, TRUTH_UNITS, WHEELS
from pdhef_logtool.storage.documents import checked, one_of, read_toml
from pdhef_logtool.storage.toml_text import toml_value

if TYPE_CHECKING:
    from pdhef_logtool.mapping.candidates import Candidate

#: Number of alternatives per signal in a written file, and the two steering signals, which can replace each other.
ALTERNATIVES = 3
_STEERING = ("steer_rad", "steering_wheel_rad")
#: Table names that are not available for estimators.
RESERVED_NAMES = ("truth", "sensors", "reference")

#: SI units by signal, ground truth and estimate.
_UNITS = SIGNAL_UNITS | TRUTH_UNITS | ESTIMATE_UNITS
#: Kind of unit of a quantity by its SI unit.
_KINDS = {"rad": "angle", "rad/s": "rate", "m/s": "speed", "m/s^2": "acceleration", "m": "position"}

Record = TypeVar("Record", SignalSource, QualityGate, CanSettings)


def _consistent(record: Record) -> Record:
    """Return a record. Raises ValueError if its entries contradict one another."""
    if problem := problem_of(record):
        raise ValueError(problem)
    return record


def problem_of(record: SignalSource | QualityGate | CanSettings) -> str:
    """Return which entries of a record contradict one another; empty without a contradiction."""
    if isinstance(record, CanSettings):
        if not record.dbc or Path() in record.dbc:
            return "dbc should name at least one file"
        if not 1 <= record.id_mask <= (most := CanSettings(()).id_mask):
            return f"id_mask should be from 1 to {most}"
        return "" if (record.bus is None) == (not record.bus_field) else "bus and bus_field belong together"
    if record.clock == "device" and record.stamp in RECORDER_STAMPS:
        return f'clock = "device" needs a stamp of the device, not "{record.stamp}"'
    if isinstance(record, SignalSource):
        low, high = record.valid_min, record.valid_max
        is_empty = low is not None and high is not None and low >= high
        return _shape_problem(record) or ("valid_min must be below valid_max" if is_empty else "")
    if record.min is not None and record.max is not None and record.min > record.max:
        return "min must not be above max"
    return "" if (record.min, record.max, record.values) != (None, None, ()) else "give min, max or values"


def _estimator(name: str) -> str:
    """Return the name of an estimator. Raises ValueError if it may not be called so."""
    if name in ESTIMATE_UNITS:
        raise ValueError(f"name the estimator too: [estimates.NAME.{name}]")
    if not name or name in RESERVED_NAMES:
        raise ValueError(f"an estimator may not be called {name!r}")
    return name


_Source = Annotated[SignalSource, AfterValidator(_consistent)]


class _File(BaseModel):
    """The entries of a mapping file; each source has its name as an entry, too."""

    model_config = ConfigDict(extra="forbid", strict=True, str_min_length=1, allow_inf_nan=False, defer_build=True)

    signals: dict[Annotated[str, one_of(SIGNAL_UNITS)], _Source] = {}
    truth: dict[Annotated[str, one_of(TRUTH_UNITS)], _Source] = {}
    truth_quality: Annotated[QualityGate, AfterValidator(_consistent)] | None = None
    estimates: dict[Annotated[str, AfterValidator(_estimator)], dict[Annotated[str, one_of(ESTIMATE_UNITS)], _Source]]
    can: Annotated[CanSettings, AfterValidator(_consistent)] | None = None
    fill_recognised: bool = False
    recorder: dict[str, str] = {}
    rate_hz: PositiveFloat | None = None
    group: str = ""


def mapping_of(given: Mapping | Path | str | None) -> Mapping | None:
    """Return the mapping, read from its file if a path is given; None stays None. Raises MappingFileError."""
    return load_mapping(given) if isinstance(given, Path | str) else given


def load_mapping(path: Path | str) -> Mapping:
    """Read mapping.toml, or a folder of mappings, from which each log uses the one for its recorder.

    Raises
    ------
    MappingFileError
        The file is missing, is no TOML, or contains wrong, unknown, missing or contradicting entries; all are named.
    """
    path = Path(path)
    if path.is_dir():
        files = sorted(path.glob("*.toml"))
        if not files:
            raise MappingFileError(expected="mapping files (*.toml)", got="none in the folder", where=str(path))
        return Mapping(file=str(path), recorders=tuple(load_mapping(file) for file in files))
    raw = read_toml(path, "a mapping TOML file", MappingFileError)
    return replace(mapping_from_dict(raw, where=str(path), folder=path.parent), file=path.name)


def mapping_from_dict(raw: dict[str, Any], *, where: str, folder: Path = Path()) -> Mapping:
    """Build a mapping from parsed TOML. DBC files are relative to ``folder``.

    Raises
    ------
    MappingFileError
        Entries are wrong, unknown, missing or contradict one another. All are named in one line; contradictions between
        sources once all of them are right.
    """
    problems: list[str] = []
    signals = _named(raw.get("signals", {}), "signals", TRUTH_UNITS.keys() - SIGNAL_UNITS.keys(), "truth", problems)
    truth = _named(raw.get("truth", {}), "truth", SIGNAL_UNITS.keys() - TRUTH_UNITS.keys(), "signals", problems)
    estimates = raw.get("estimates", {})
    if isinstance(estimates, dict):
        estimates = {n: _named(tables, f"estimates.{n}", (), "", problems) for n, tables in estimates.items()}
    can = raw.get("can")
    if isinstance(can, dict) and isinstance(can.get("dbc"), str):
        can = can | {"dbc": [can["dbc"]]}
    given = {"signals": signals, "truth": truth, "estimates": estimates} | ({} if can is None else {"can": can})
    file = checked(_File, raw | given, "", problems)
    if file is not None:
        entries: dict[str, Any] = dict(file)
        entries |= {"quality": entries.pop("truth_quality"), "recorder": tuple(file.recorder.items())}
        if file.can is not None:
            entries["can"] = replace(file.can, dbc=tuple(folder / path for path in file.can.dbc))
        mapping = Mapping(**entries)
        problems += contradictions(mapping)
    if file is None or problems:
        expected, remedy = "the entries of mapping.toml", "see docs/formats.md for every entry and its unit"
        raise MappingFileError(expected=expected, got="; ".join(problems), where=where, remedy=remedy)
    return mapping


def _named(tables: object, section: str, others: Collection[str], other: str, problems: list[str]) -> object:
    """Return the tables of sources with their names and scales to SI; ``others`` belong to the section ``other``."""
    if not isinstance(tables, dict):
        return tables
    problems += [f"{section}.{name}: belongs under [{other}.{name}]" for name in tables if name in others]
    return {name: _complete(name, t, f"{section}.{name}", problems) for name, t in tables.items() if name not in others}


def _complete(name: str, table: object, where: str, problems: list[str]) -> object:
    """Return the table of a source with its name, and with its scale to SI in place of a unit."""
    if not isinstance(table, dict):
        return table
    problems += [f"{where}.name: unknown"] if "name" in table else []
    named = table | {"name": name}
    if (unit := named.pop("unit", None)) is None:
        return named
    scale = table.get("scale", 1.0)
    factor = factor_of(name, "x", unit) if isinstance(unit, str) else None
    if factor is None:
        si, units = _UNITS.get(name, ""), UNITS.get(_kind_of(name), {})
        problems.append(f'{where}: unit = "{unit}" is unknown for {si}, known are {", ".join(units) or si}')
        return named
    if scale not in (1.0, -1.0):
        problems.append(f"{where}: give unit or scale, not both; scale = -1 reverses the sign")
        return named
    return named | {"scale": factor * scale}


def factor_of(name: str, leaf: str, unit: str) -> float | None:
    """Return the factor to the SI unit of a quantity that a field's stated unit, or its name, gives; None without."""
    kind = _kind_of(name)
    return unit_of(f"{leaf}_{plain_unit(unit)}" if unit else leaf, kind)[1] if kind in UNITS else None


def _kind_of(name: str) -> str:
    si = _UNITS.get(name, "")
    return "wheel rate" if si == "rad/s" and name.startswith("wheel") else _KINDS.get(si, "")


def _shape_problem(source: SignalSource) -> str:
    """Return why fields, scale and offset of a source do not fit its columns or one another; empty if they do."""
    name, columns, fields_, offset = source.name, source.columns, len(source.paths), source.offset
    scales = source.scale if isinstance(source.scale, tuple) else (source.scale,)
    problem = ""
    # A column of a vector may be absent: 0 times another one.
    is_zero = 0.0 in scales if columns == 1 else not any(scales)
    if is_zero or not all(source.paths):
        problem = "scale must not be 0" if is_zero else "field must not be empty"
    elif source.combine != "sum" and (columns > 1 or fields_ < 2):
        what = {"norm": "length", "root": "root of the sum", "signed": "magnitude and sign"}[source.combine]
        problem = f'combine = "{source.combine}" is the {what} of two or more fields, '
        problem += f"{name} has {columns} columns of {fields_}"
    elif columns > 1:
        lists = {key: v for key in ("field", "scale", "offset") if isinstance(v := getattr(source, key), tuple)}
        wrong = [f"{key} must have {columns} entries, got {len(v)}" for key, v in lists.items() if len(v) != columns]
        problem = next(iter(wrong), "")
    elif isinstance(offset, tuple):
        problem = f"offset must be a single value, {name} is no vector"
    elif fields_ == 1 and isinstance(source.scale, tuple):
        problem = f"scale must be a single value, {name} is no vector and has one field"
    # Sum of several fields: one component of a sensor with rotated axes.
    elif fields_ > 1 and not (isinstance(source.scale, tuple) and len(scales) == fields_):
        problem = f"{name} is the sum of its fields, each times its scale: scale must have {fields_} entries"
    return problem or _problem_of_frames(source)


def _problem_of_frames(source: SignalSource) -> str:
    from_can, columns = [f for f in source.paths if f.startswith(CAN_PREFIX)], source.columns
    if from_can and (columns > 1 or len(source.paths) > 1):
        what = "is a vector" if columns > 1 else "has several fields"
        return f"{source.name} {what}: CAN signals of different frames have no common stamp"
    is_wrong = any(f.count(".") != 1 for f in from_can)
    return f"field must be {CAN_PREFIX}<message>.<signal>" if is_wrong else ""


def contradictions(mapping: Mapping) -> list[str]:
    """Return contradictions in a mapping: two names of one signal, or one field for two signals of a section."""
    pairs = [_STEERING, *((f"wheel_speed_{w}_m_s", f"wheel_speed_{w}_rad_s") for w in WHEELS)]
    problems = [
        f"signals.{a} and signals.{b}: give one of them, not both"
        for a, b in pairs
        if a in mapping.signals and b in mapping.signals
    ]
    estimates = [(f"estimates.{name}", sources) for name, sources in mapping.estimates.items()]
    for section, sources in (("signals", mapping.signals), ("truth", mapping.truth), *estimates):
        can = [n for n, source in sources.items() if mapping.can is None and source.can_signal is not None]
        problems += [f"{section}.{name}: field = {CAN_PREFIX}... needs [can] with a dbc" for name in can]
        first: dict[tuple[object, ...], str] = {}
        for name, source in sources.items():
            summed = len(source.paths) > source.columns
            key = (source.topic, source.paths, source.scale if summed else None)
            if key in first:
                problems.append(f"{section}.{name}: duplicates {section}.{first[key]} ({source.label})")
            first.setdefault(key, name)
    units: dict[tuple[str, str], tuple[str, str]] = {}
    for source in mapping.sources():
        if source.stamp in RECORDER_STAMPS:
            continue
        kind = (source.stamp_unit, source.clock)
        if units.setdefault((source.topic, source.stamp), kind) != kind:
            problems.append(f"{source.name}: {source.topic}.{source.stamp} has another stamp_unit or clock elsewhere")
    return problems


# ------------------------------------------------------------------------------------------------ writing


def mapping_to_toml(
    mapping: Mapping, comments: MappingABC[str, str] | None = None, alternatives: "Sequence[Candidate]" = ()
) -> str:
    """Write a mapping as TOML that is ready to edit; ``load_mapping`` returns the same sources.

    Parameters
    ----------
    comments : text by name (``steer_rad``) or table (``truth.yaw_rate_rad_s``), by ``truth_quality``, or ``""`` for the
        head of the file; each is written above its entry.
    alternatives : candidates; those that are not taken are written as comments, with score and reason.

    Missing signals are written as commented examples that only need a topic and a field.
    """
    notes = dict(comments or {})
    lines = [
        "# Sources of the log's signals: value_SI = scale * raw + offset, measured at stamp - latency_s.",
        "# ISO 8855: x forward, y left, z up; angles and rates are positive to the left. See docs/formats.md.",
    ]
    lines += _comment("\n".join([notes.get("", ""), *mapping.notes]))
    if mapping.rate_hz or mapping.group:
        lines += ["", *(f"{n} = {toml_value(v)}" for n in ("rate_hz", "group") if (v := getattr(mapping, n)))]
    if mapping.recorder:
        lines += ["", "[recorder]", *(f"{toml_value(topic)} = {toml_value(kind)}" for topic, kind in mapping.recorder)]
    if mapping.can is not None:
        lines += ["", "[can]", *_lines(mapping.can)]
    tables = {"signals": mapping.signals, "truth": mapping.truth}
    tables |= {f"estimates.{toml_value(name)}": sources for name, sources in mapping.estimates.items()}
    for section, sources in tables.items():
        for name in (n for n in _UNITS if n in sources):
            lines += ["", *_comment(notes.get(f"{section}.{name}", notes.get(name, "")))]
            lines += [*_table(section, sources[name]), *_alternative_lines(section, name, alternatives)]
    if mapping.quality is not None:
        lines += ["", *_comment(notes.get("truth_quality", "Ground truth is used where this condition is met."))]
        lines += ["[truth_quality]", *_lines(mapping.quality)]
    lines += _missing_lines(mapping, notes, alternatives)
    return "\n".join(lines) + "\n"


def _missing_lines(mapping: Mapping, notes: MappingABC[str, str], alternatives: "Sequence[Candidate]") -> list[str]:
    """Return commented examples of the missing signals."""
    lines: list[str] = []
    missing = missing_signals(mapping)
    if missing:
        lines += ["", "# Not mapped. To add one, remove the # and name its topic and field (a dotted path, [3] indexes"]
        lines += [
            "# an array); scale is to SI and ISO 8855: 0.017453292519943295 for deg, 0.2777777777777778 for km/h."
        ]
    for name in missing:
        alternative = _alternative_lines("signals", name, alternatives)
        lines += alternative or [*_example("signals", name), *_comment(notes.get(name, ""))]
    if not mapping.truth:
        lines += ["", "# No ground truth is mapped. For a comparison name at least a body velocity, for example:"]
        alternative = [line for name in TRUTH_UNITS for line in _alternative_lines("truth", name, alternatives)]
        lines += alternative or [line for name in ("vx_m_s", "vy_m_s") for line in _example("truth", name)]
    return lines


def _table(section: str, source: SignalSource) -> list[str]:
    return [f"[{section}.{source.name}]  # {_UNITS[source.name]}", *_lines(source)]


def _example(section: str, name: str) -> list[str]:
    """Return a commented table for a missing signal."""
    return ["#", *(f"# {line}" for line in _table(section, SignalSource(name, "/...", "...")))]


def _alternative_lines(section: str, name: str, candidates: "Sequence[Candidate]") -> list[str]:
    """Return commented tables of the best candidates that are not taken."""
    names = _STEERING if name in _STEERING else (name,)
    mine = [c for c in candidates if c.section == section and c.source.name in names and not c.taken]
    lines: list[str] = []
    for candidate in mine[:ALTERNATIVES]:
        doubt = f"; unsure: {candidate.doubt}" if candidate.doubt else ""
        lines += ["#", *_comment(f"Instead, score {candidate.score:.2f}: {candidate.reason}{doubt}")]
        lines += [f"# {line}" for line in _table(section, candidate.source)]
    return lines


def missing_signals(mapping: Mapping) -> tuple[str, ...]:
    """Return the missing signals that an estimator can use; the speed may come from any wheel."""
    have = mapping.signals.keys()
    given = {
        "steer_rad": bool(have & {*_STEERING}),
        **{name: name in have for name in ("ax_m_s2", "ay_m_s2", "yaw_rate_rad_s")},
        "speed_m_s": any(name.startswith(("speed_m_s", "wheel_speed_")) for name in have),
    }
    return tuple(name for name, is_given in given.items() if not is_given)


def _lines(record: SignalSource | QualityGate | CanSettings) -> list[str]:
    """Return the entries of a table that differ from the defaults, and the scale."""
    entries = ((f.name, getattr(record, f.name), f.default) for f in fields(record) if f.name != "name")
    given = {name: value for name, value, default in entries if value != default or name == "scale"}
    if isinstance(record, CanSettings):
        given["dbc"] = [p.absolute().as_posix() if p.exists() else p.name for p in record.dbc]
    return [f"{name} = {toml_value(value)}" for name, value in given.items()]


def entries_of(source: SignalSource, *names: str) -> str:
    """Return entries of a source's table in one line, for a remedy."""
    return ", ".join(f"{name} = {toml_value(getattr(source, name))}" for name in names)


def _comment(text: str) -> list[str]:
    return [
        "# " + "".join(c if c.isprintable() else " " for c in line).strip()
        for line in text.splitlines()
        if line.strip()
    ]
