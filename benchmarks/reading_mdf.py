"""Reading all columns of one hour of MDF 4 at 100 Hz; asammdf's own access to the same columns.

The file has two channel groups of 360,000 samples and 12 channels in deflated blocks. Both readers open the file and
get all columns and times; ours cleans the times and reads in windows of a minute, as a run does.
"""

from contextlib import closing
from pathlib import Path

import numpy as np

from benchmarks.measuring import CACHE, Row, best_seconds
from benchmarks.one_hour_log import HOUR_S

_GROUPS = {"IMU": ("AccX", "AccY", "AccZ", "RollRate", "PitchRate", "YawRate")}
_GROUPS["ESP"] = ("SteeringWheelAngle", "Speed", "WheelFL", "WheelFR", "WheelRL", "WheelRR")
_RATE_HZ = 100


def hour_mdf() -> Path:
    """Return the one-hour MDF, written once."""
    import asammdf

    path = CACHE / "hour.mf4"
    if path.exists():
        return path
    CACHE.mkdir(parents=True, exist_ok=True)
    random = np.random.default_rng(1)
    clock = np.arange(HOUR_S * _RATE_HZ) / _RATE_HZ
    with asammdf.MDF(version="4.10") as file:
        for group, names in _GROUPS.items():
            waves = {n: np.sin(clock / (3.0 + i)) + random.normal(0.0, 0.02, len(clock)) for i, n in enumerate(names)}
            signals = [asammdf.Signal(w.astype(np.float32), clock, name=f"{group}.{n}") for n, w in waves.items()]
            file.append(signals, comment=group, common_timebase=True)
        file.save(path, compression=2, overwrite=True)
    return path


def read_ours(path: Path) -> int:
    """Read all columns in windows of a minute; returns the number of samples."""
    from pdhef_logtool.logs.drive_log import windows
    from pdhef_logtool.logs.open_log import open_log

    with closing(open_log(path)) as log:
        requests = {t.name: [f.path for f in log.fields(t.name)] for t in log.topics}
        total = 0
        for start_ns, end_ns in windows(log.start_ns, log.end_ns, 60 * 10**9, log.recording_span):
            total += sum(len(c) * len(c.fields) for c in log.read(requests, start_ns, end_ns).values())
        if log.lost:
            raise SystemExit(f"{path.name} is damaged; delete it")
        return total


def read_asammdf(path: Path) -> int:
    """Get every channel with its times by asammdf; returns the number of samples."""
    import asammdf

    total = 0
    with asammdf.MDF(path) as file:
        for number, group in enumerate(file.groups):
            for index in range(1, len(group.channels)):
                total += len(file.get(group=number, index=index).samples)
    return total


def rows() -> list[Row]:
    """Measure."""
    path = hour_mdf()
    if read_ours(path) != read_asammdf(path):
        raise SystemExit("the readers disagree")
    best = best_seconds({"asammdf": lambda: read_asammdf(path), "ours": lambda: read_ours(path)})
    return [
        Row("read 12 channels of 1 h at 100 Hz", best["ours"], "s"),
        Row("read / asammdf's own column access", best["ours"] / best["asammdf"], "x", 3.0),
    ]
