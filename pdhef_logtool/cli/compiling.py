"""``pdhef compile``: compile the code of runs in advance."""

from __future__ import annotations

from pdhef_logtool.cli import console, options

#: The receiver of the simulated car as a sensor.
_GNSS_MAPPING = """fill_recognised = true

[signals]
gnss_latitude_deg = { topic = "/rtk/fix", field = "latitude" }
gnss_longitude_deg = { topic = "/rtk/fix", field = "longitude" }
"""


@options.command()
def compile_() -> None:
    """Compile the filters in advance, so that the first run starts at once."""
    import time
    from pathlib import Path
    from tempfile import TemporaryDirectory

    from pdhef_logtool.compiled.sources import compiled_digest
    from pdhef_logtool.estimators.table import ALL_ESTIMATORS
    from pdhef_logtool.runs.config import RunConfig
    from pdhef_logtool.runs.fleet import run_logs
    from truthsim.drive import simulate_drive, write_drive

    began_s = time.perf_counter()
    saloon = RunConfig(car=Path("saloon"), estimators=(ALL_ESTIMATORS,), keep="metrics", reference="on")
    with TemporaryDirectory() as folder:
        log, mapping = Path(folder) / "drive.mcap", Path(folder) / "mapping.toml"
        write_drive(simulate_drive("banked-road"), log)
        mapping.write_text(_GNSS_MAPPING, encoding="utf-8")
        sedan = RunConfig(keep="metrics", reference="on", mapping=mapping)
        for config in (saloon, sedan):
            run_logs([str(log)], Path(folder) / "out", config, report=False)
    seconds = time.perf_counter() - began_s
    console.say(f"all code of runs is compiled ({seconds:.0f} s, {compiled_digest()})")
