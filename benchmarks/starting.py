"""A short run in a new process.

A run of a 10 s log, with code compiled before: metrics only, and all outputs.
"""

from benchmarks.measuring import CACHE, ROOT, ROUNDS, Row, command_cost

_RUN = ("run", ROOT / "sample_logs" / "dlc.mcap", "--car", "saloon", "-o", CACHE / "start")
LIGHT = (*_RUN, "--keep", "metrics", "--no-report")


def rows() -> list[Row]:
    """Measure."""
    light, whole = (min(command_cost(*words).seconds for _ in range(ROUNDS)) for words in (LIGHT, _RUN))
    return [
        Row("a new process runs 10 s, figures", light, "s", 2.0, command="pdhef run --keep metrics --no-report"),
        Row("a new process runs 10 s, all outputs", whole, "s", command="pdhef run"),
    ]
