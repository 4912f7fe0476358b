"""What more driving would be worth: stages that lack driving."""

from __future__ import annotations

from collections.abc import Sequence

from pdhef_logtool.learning.drives import GAIN, INTERVALS, NETWORK
from pdhef_logtool.learning.evidence.calibrate import MIN_DRIVES
from pdhef_logtool.learning.evidence.trust import BLOCK_S, MIN_BLOCKS
from pdhef_logtool.learning.split import TRAINING, VALIDATION, Split
from pdhef_logtool.learning.stages.intervals import PIECE_S
from pdhef_logtool.learning.stages.network import LEAST_TRAINING_S


def what_more_would_pay(split: Split, stages: Sequence[str]) -> list[str]:
    """Return sentences on what these drives do not show and which driving would."""
    lines = []
    training_s, validation_s = split.seconds(TRAINING), split.seconds(VALIDATION)
    if NETWORK in stages and max(training_s, split.seconds(split.network_part())) < LEAST_TRAINING_S:
        lines.append(f"the network was not trained on: needs {LEAST_TRAINING_S:g} s of usable driving in its part")
    if {GAIN, NETWORK} & set(stages) and validation_s < MIN_BLOCKS * BLOCK_S:
        lines.append(
            f"a residual gain above one half needs {MIN_BLOCKS} blocks of {BLOCK_S:g} s in the validation part, which "
            f"has {validation_s:.0f} s"
        )
    if INTERVALS in stages and len(split.pieces(VALIDATION, PIECE_S)) < MIN_DRIVES:
        lines.append(
            f"the 95 % intervals are not calibrated: needs {MIN_DRIVES} drives, or pieces of {PIECE_S:g} s, in the "
            f"validation part, which has {validation_s:.0f} s"
        )
    return lines
