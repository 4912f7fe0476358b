"""Merging of losses across windows, and rejected texts of ``--estimate`` and ``--truth``."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from fake_drive_log import FakeLog, FakeTopic

from pdhef_logtool.mapping import merge_losses
from pdhef_logtool.mapping.estimates import sources_of
from pdhef_logtool.records.errors import MappingError, UsageError
from pdhef_logtool.records.signals import ESTIMATE_UNITS, Loss


def test_losses_of_one_kind_at_one_place_become_one_that_spans_and_counts_all() -> None:
    parts = [
        Loss("nan", "not a number", "/a.x", 40, 50, 3),
        Loss("nan", "not a number", "/a.x", 10, 20, 4),
        Loss("nan", "not a number", "/a.x"),  # whole and uncounted: adds no bound and no count
    ]
    for order in permutations(parts):
        assert merge_losses([order[:1], order[1:]]) == (Loss("nan", "not a number", "/a.x", 10, 50, 7),)


def test_what_nobody_counted_stays_uncounted_and_unbounded() -> None:
    loss = Loss("truncated", "the file ends early", "a.mcap")
    assert merge_losses([[loss], [loss]]) == (loss,)


@pytest.mark.parametrize(
    "other",
    [
        Loss("gap", "w", "/a", 1, 2, 1),
        Loss("nan", "v", "/a", 1, 2, 1),
        Loss("nan", "w", "/b", 1, 2, 1),
        Loss("nan", "w", "/a", 1, 2, 1, "note"),
    ],
)
def test_losses_that_differ_in_kind_words_place_or_weight_stay_apart(other: Loss) -> None:
    loss = Loss("nan", "w", "/a", 1, 2, 1)
    assert merge_losses([[loss, other], [loss]]) == (Loss("nan", "w", "/a", 1, 2, 2), other)


def _log() -> FakeLog:
    times = np.arange(10, dtype=np.int64) * 10_000_000 + 1_700_000_000_000_000_000
    return FakeLog({name: FakeTopic("custom/Type", times, {"beta": np.zeros(10)}) for name in ("/esc", "/imu/raw")})


@pytest.mark.parametrize(
    ("texts", "error", "said"),
    [
        (["sidslip_rad=/esc.beta"], UsageError, "did you mean sideslip_rad?"),
        (["colour=/esc.beta"], UsageError, "got 'colour'"),
        (["=/esc.beta"], UsageError, "SIGNAL out of"),
        (["sideslip_rad=/esc.beta", "sideslip_rad=/imu/raw.beta"], UsageError, "expected each signal once"),
        (["sideslip_rad=/ecs.beta"], MappingError, "did you mean /esc?"),
        (["sideslip_rad=/nowhere/near.beta"], MappingError, "pdhef inspect lists the topics"),
        (["/esc.beta"], UsageError, "the type does not give the signal"),
    ],
)
def test_a_text_that_names_no_signal_of_the_log_is_refused(texts: list[str], error: type[Exception], said: str) -> None:
    with pytest.raises(error) as caught:
        sources_of(_log(), texts, ESTIMATE_UNITS, "--estimate")  # type: ignore[arg-type]
    assert said in str(caught.value)
    assert "--estimate" in str(caught.value)
