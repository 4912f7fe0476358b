"""A mapping with a mistake that the checks find."""

from pathlib import Path

from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.mapping import auto_map, mapping_to_toml


def wrong_sign(log: Path, folder: Path) -> Path:
    """Write a mapping of a log with the wrong sign of the steering into a folder; return the file."""
    opened = open_log(log)
    text = mapping_to_toml(auto_map(opened).mapping)
    opened.close()
    at = text.index("scale", text.index("[signals.steer_rad]"))
    path = folder / "mapping.toml"
    path.write_text(text[:at] + text[at:].replace("scale = 1.0", "scale = -1.0", 1))
    return path
