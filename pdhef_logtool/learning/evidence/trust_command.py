"""``pdhef trust`` from drives with truth to a vehicle file that says how far a network may be followed, and why."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pdhef_logtool.car.vehicle import Network, VehicleParameters, load_vehicle, vehicle_sha256, vehicle_to_toml
from pdhef_logtool.drive.options import NANOSECONDS_FROM, parse_time
from pdhef_logtool.drive.reading import Drive
from pdhef_logtool.estimators.adaptive_hybrid import adaptive_hybrid_ukf
from pdhef_logtool.estimators.cautious import at_trust
from pdhef_logtool.estimators.trust_policy import SHOWN_DIGITS
from pdhef_logtool.evaluation.metrics import signal_error
from pdhef_logtool.learning.drives import (
    DriveRecord,
    Refusal,
    choose_drives,
    drives_document,
    exit_code,
    load_drive,
    tell_drive,
)
from pdhef_logtool.learning.evidence.trust import (
    BLOCK_S,
    EXCITED_M_S2,
    LEVEL,
    MIN_BLOCKS,
    MIN_EXCITED_S,
    RESAMPLES,
    TOLERANCE,
    TRUSTS,
    UNCONFIRMED_CAP,
    BlockErrors,
    TrustDecision,
    block_errors,
    decide_cap,
    join_blocks,
)
from pdhef_logtool.learning.noise.tune_command import read_comments
from pdhef_logtool.learning.noise.tune_drives import MIN_SCORED_STAMPS
from pdhef_logtool.logs.discovery import find_logs
from pdhef_logtool.mapping import load_mapping
from pdhef_logtool.records.errors import EstimatorError, UsageError
from pdhef_logtool.records.files import write_bytes
from pdhef_logtool.records.signals import BoolArray, FloatArray, Signals
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.residual_model.bundle import ModelBundle, open_model
from pdhef_logtool.residual_model.service import NetworkCarry, NetworkService
from pdhef_logtool.run.config import RunConfig
from pdhef_logtool.sinks.report import tool_versions, write_json

FORMAT = "pdhef-trust"
FORMAT_VERSION = 1
#: Splits of a set that a network is trained on and chosen by: it looks better there than in service.
SEEN = ("train", "validation")
#: A drive as ``pdhef identify`` names it in the vehicle file.
_SPAN = re.compile(r"(?P<name>.+): (?P<start>-?[\d.]+) to (?P<end>-?[\d.]+) s")

Warn = Callable[[str], None]
#: Drives that this command refuses.
REFUSED = Refusal(
    SEEN,
    "drives that no network was trained on",
    "trust",
    "take --split test, or say --any-split if this network has not seen them",
)


@dataclass(frozen=True, slots=True)
class TrustSettings:
    """What decides the cap, beside the logs.

    Attributes
    ----------
    config : vehicle, mapping, model, slice, sensors, which truth; the other entries are not used.
    seed : of the bootstrap. split : only drives that their set's manifest puts into this split.
    any_split : do not refuse drives of the splits that networks are trained on.
    """

    config: RunConfig
    seed: int = 0
    split: str | None = None
    any_split: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class TrustResult:
    """What the command decided and wrote; ``rmse_deg`` holds a row a drive, a column a trust."""

    vehicle_file: Path
    record_file: Path
    decision: TrustDecision
    network: Network
    drives: tuple[DriveRecord, ...]
    left_out: tuple[DriveRecord, ...]
    rmse_deg: tuple[tuple[float, ...], ...]

    @property
    def exit_code(self) -> int:
        """0 if all drives took part whole, 3 if not."""
        return exit_code((*self.drives, *self.left_out))

    def drives_document(self) -> dict[str, Any]:
        """Return the drives with their errors at each trust, and those left out."""
        document = drives_document((*self.drives, *self.left_out))
        for drive, rmse in zip(document["drives"], self.rmse_deg, strict=True):
            drive["rmse_deg"] = list(rmse)
        return document

    def to_dict(self) -> dict[str, Any]:
        """Return the result as one JSON-able document."""
        d = self.decision
        return {
            "vehicle": str(self.vehicle_file),
            "record": str(self.record_file),
            "exit_code": self.exit_code,
            "trust_cap": d.cap,
            "reason": d.reason,
            "evidence": self.network.evidence,
            "model_sha256": self.network.model_sha256,
            **_figures(d),
            **self.drives_document(),
        }


@dataclass(frozen=True)
class RepeatedNetwork(NetworkService):
    """A network whose last answer is kept: trust is applied behind it, so that one pass serves all trusts."""

    _last: dict[bytes, tuple[FloatArray, NetworkCarry]]

    def run(
        self, features: FloatArray, starts: BoolArray, carry: NetworkCarry | None
    ) -> tuple[FloatArray, NetworkCarry]:
        """Return what the network says; a whole drive only, from its start."""
        if carry is not None:
            return super().run(features, starts, carry)
        key = hashlib.sha256(np.ascontiguousarray(features).tobytes() + starts.tobytes()).digest()
        if key not in self._last:
            self._last.clear()
            self._last[key] = super().run(features, starts, None)
        return self._last[key]


def run_trust(
    arguments: Sequence[str],
    output: Path,
    settings: TrustSettings,
    *,
    progress: Callable[[str, float], None] = lambda _text, _share: None,
    warn: Warn = lambda _text: None,
) -> TrustResult:
    """Try a network on drives with truth; write ``output``, the vehicle file with its cap, and ``<stem>.trust.json``.

    Parameters
    ----------
    arguments : logs, folders, glob patterns.

    Raises
    ------
    UsageError
        An option is wrong, or the network was trained on the drives.
    PdhefError
        A file or log cannot be read: an absent drive would change the result unnoticed.
    EstimatorError
        No drive can be scored.
    """
    config = settings.config
    source, model = _check(output, settings)
    vehicle = load_vehicle(source)
    inputs, splits = choose_drives(find_logs(arguments), settings, REFUSED)
    mapping = None if config.mapping is None else load_mapping(config.mapping)
    network = RepeatedNetwork(model, {})
    needs = adaptive_hybrid_ukf(vehicle, network).needs

    def lacking(drive: Drive) -> str:
        missing = sorted(needs - drive.available)
        return f"pd-hef needs {', '.join(missing)}" if missing else ""

    loaded: list[DriveRecord] = []
    scored: list[BlockErrors] = []
    for number, log_input in enumerate(inputs):
        progress(log_input.stem, number / len(inputs))
        record, drive = load_drive(
            log_input,
            vehicle,
            mapping,
            config.read_options,
            split=splits.get(log_input.stem),
            refuse=lacking,
            least_scored=MIN_SCORED_STAMPS,
        )
        tell_drive(record, warn)
        loaded.append(record)
        if drive is not None and drive.truth is not None:
            use_speed = config.read_options.use_speed
            scored.append(errors_by_trust(vehicle, network, drive.signals, drive.truth, use_speed=use_speed))
    drives = tuple(f for f in loaded if not f.left_out)
    if not drives:
        raise EstimatorError(
            expected="at least one drive with a true sideslip and the signals of pd-hef",
            got="none",
            where="trust",
            remedy="map v_y, sideslip, or position and heading of an RTK, INS or motion-capture reference",
        )
    for text in seen_by_identification(vehicle, drives, *_slice_s(config)):
        warn(text)
    together = join_blocks(scored)
    if together.lost:
        warn(f"{together.lost} stamps without an estimate at some trust above 0 are charged to it")
    decision = decide_cap(together, seed=settings.seed)
    found = Network(
        trust_cap=decision.cap, evidence=evidence(decision, len(drives), model.sha256), model_sha256=model.sha256
    )
    result = TrustResult(
        vehicle_file=output,
        record_file=output.with_suffix(".trust.json"),
        decision=decision,
        network=found,
        drives=drives,
        left_out=tuple(f for f in loaded if f.left_out),
        rmse_deg=tuple(_rmse_deg(b) for b in scored),
    )
    document = _record(result, settings, vehicle)
    write_bytes(output, trusted_toml(source, vehicle, found).encode())
    write_json(result.record_file, document)
    progress("done", 1.0)
    return result


def errors_by_trust(
    vehicle: VehicleParameters, network: NetworkService, signals: Signals, truth: StateTrack, *, use_speed: bool
) -> BlockErrors:
    """Return the sideslip errors of ``pd-hef`` on a drive at every trust, in blocks.

    The truth's v_x times the gyro's yaw rate is the lateral acceleration that decides what counts as excited: no
    bank, bias or vibration is in it.
    """
    slow = vehicle.low_speed_blend_m_s
    errors = np.stack(
        [
            signal_error(
                at_trust(vehicle, network, trust, use_speed=use_speed).run(signals, None)[0],
                truth,
                "sideslip_rad",
                slow,
            )
            for trust in TRUSTS
        ]
    )
    excited: BoolArray = np.abs(truth.vx_m_s * signals.yaw_rate_rad_s) > EXCITED_M_S2
    return block_errors(errors, truth.sideslip_rad, signals.stamps_ns, excited)


def seen_by_identification(
    vehicle: VehicleParameters, drives: Sequence[DriveRecord], start_s: float = 0.0, end_s: float = math.inf
) -> list[str]:
    """Return a warning for each drive that the vehicle was identified on within [start_s, end_s) of the log."""
    spans = vehicle.identification.get("drives", [])
    told = []
    for span in spans if isinstance(spans, list) else []:
        found = _SPAN.fullmatch(span)
        if found is None or found["name"] not in {d.name for d in drives}:
            continue
        if start_s < float(found["end"]) and end_s > float(found["start"]):
            told.append(f"the vehicle was identified on {span}: score another part (--start, --end)")
    return told


def _slice_s(config: RunConfig) -> tuple[float, float]:
    """Return the slice in seconds from a log's start as far as it is given so; else all of it."""
    given = [
        None if text is None else parse_time(text, 0, 0, option=option) * 1e-9
        for text, option in ((config.start, "--start"), (config.end, "--end"))
    ]
    start, end = (None if v is None or not 0.0 <= v < NANOSECONDS_FROM * 1e-9 else v for v in given)
    return 0.0 if start is None else start, math.inf if end is None else end


def evidence(decision: TrustDecision, drives: int, model_sha256: str) -> str:
    """Return the sentence of the vehicle file, with its figures."""
    d = decision
    rmse = dict(zip(TRUSTS, d.rmse_deg, strict=True))
    shown = ", ".join(f"{rmse[t]:.3f}° at trust {t:g}" for t in sorted({0.0, 0.5, 1.0, d.cap}))
    gain = d.against_zero[-1]
    bounds = "" if np.isnan(gain.low_deg2) else f" (95 %: {gain.low_deg2:.3g} to {gain.high_deg2:.3g})"
    return (
        f"{d.reason}: {drives} {'drive' if drives == 1 else 'drives'} with truth, {d.scored_s:.0f} s scored, "
        f"{d.excited_s:.0f} s of them above {EXCITED_M_S2:g} m/s²; sideslip RMSE {shown}; squared error at 1 less "
        f"that at 0 {gain.value_deg2:.3g}{bounds} deg² over {d.blocks} blocks; model {model_sha256[:SHOWN_DIGITS]}"
    )


def trusted_toml(source: Path, vehicle: VehicleParameters, network: Network) -> str:
    """Return the vehicle file with the network's entries; its comments are kept."""
    comments = {
        entry: note
        for entry, note in read_comments(source.read_text(encoding="utf-8")).items()
        if not entry.startswith("network.")
    }
    return vehicle_to_toml(vehicle.model_copy(update={"network": network}), comments)


def _check(output: Path, settings: TrustSettings) -> tuple[Path, ModelBundle]:
    config = settings.config
    if config.vehicle is None:
        raise UsageError(
            expected="a vehicle file", got="none", where="--vehicle", remedy="pdhef identify writes one of your car"
        )
    if output.suffix != ".toml":
        raise UsageError(expected="a file name that ends in .toml", got=output.name, where="--output")
    if settings.seed < 0:
        raise UsageError(expected="a seed of at least 0", got=str(settings.seed), where="--seed")
    model = open_model(config.model)
    if model is None:
        raise UsageError(
            expected="a model bundle", got="none", where="--model", remedy="give --model DIR of pdhef train"
        )
    return config.vehicle, model


def _rmse_deg(blocks: BlockErrors) -> tuple[float, ...]:
    return tuple(float(np.degrees(np.sqrt(row.sum() / blocks.counts.sum()))) for row in blocks.squares)


def _figures(d: TrustDecision) -> dict[str, Any]:
    return {
        "trusts": list(TRUSTS),
        "rmse_deg": list(d.rmse_deg),
        "against_trust_0": [_bound(b) for b in d.against_zero],
        "best_lower_trust": d.best_lower,
        "trust_1_against_best_lower": _bound(d.against_best),
        "blocks": d.blocks,
        "scored_s": round(d.scored_s, 3),
        "excited_s": round(d.excited_s, 3),
    }


def _bound(bound: Any) -> dict[str, float | None]:
    return {name: None if np.isnan(value) else value for name, value in asdict(bound).items()}


def _record(result: TrustResult, settings: TrustSettings, vehicle: VehicleParameters) -> dict[str, Any]:
    """Return the document of ``<stem>.trust.json``."""
    config = settings.config.to_dict()
    return {
        "format": FORMAT,
        "version": FORMAT_VERSION,
        "versions": tool_versions(),
        "settings": {
            **{
                k: config[k]
                for k in ("vehicle", "mapping", "model", "start", "end", "sensors", "friction", "prefer_truth")
            },
            "split": settings.split,
            "any_split": settings.any_split,
            "seed": settings.seed,
        },
        "vehicle": {"name": vehicle.name, "sha256": vehicle_sha256(vehicle)},
        "model_sha256": result.network.model_sha256,
        "rule": {
            "block_s": BLOCK_S,
            "min_blocks": MIN_BLOCKS,
            "excited_m_s2": EXCITED_M_S2,
            "min_excited_s": MIN_EXCITED_S,
            "tolerance": TOLERANCE,
            "unconfirmed_cap": UNCONFIRMED_CAP,
            "level": LEVEL,
            "resamples": RESAMPLES,
        },
        "trust_cap": result.decision.cap,
        "reason": result.decision.reason,
        "evidence": result.network.evidence,
        **_figures(result.decision),
        **result.drives_document(),
    }
