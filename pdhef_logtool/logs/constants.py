"""Numbers of file formats and clocks: ``constants.toml``."""

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

CONSTANTS: Mapping[str, Any] = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
#: Smaller logs are read as a whole, where a part of a larger one is enough.
WHOLE_BYTES: int = CONSTANTS["whole_bytes"]
#: Letters in ASCII.
LATIN = str.maketrans(CONSTANTS["latin"])
_PAIRS = (pair.split("=") for pairs in CONSTANTS["alphabets"].values() for pair in pairs.split())
LETTERS = str.maketrans({u: latin for letter, latin in _PAIRS for u in (letter, letter.upper())})


def numbered(table: Mapping[str, Any]) -> dict[int, Any]:
    """Return a table by its numbers, which are texts in TOML."""
    return {int(number): entry for number, entry in table.items()}
