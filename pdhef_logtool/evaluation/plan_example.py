"""The commented example of a validation plan."""

from __future__ import annotations

import textwrap
from pathlib import Path

from pdhef_logtool.evaluation.segments import SEGMENTS
from pdhef_logtool.evaluation.units import SIGNALS

_SEGMENTS = textwrap.fill(", ".join(SEGMENTS), 99, subsequent_indent="# ", break_on_hyphens=False)
EXAMPLE = (
    (Path(__file__).parent / "plan_example.toml")
    .read_text(encoding="utf-8")
    .replace("SIGNALS", ", ".join(SIGNALS))
    .replace("SEGMENTS", _SEGMENTS)
)
