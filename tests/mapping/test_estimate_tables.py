"""[estimates.NAME.SIGNAL] tables, ``[SIGNAL=]TOPIC[.FIELD]`` texts, and losses of several windows as one."""

from __future__ import annotations

from itertools import permutations
from pathlib import Path

import numpy as np
import pytest
from fake_drive_log import FakeLog, FakeTopic

from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.mapping import load_mapping, mapping_to_toml, merge_losses
from pdhef_logtool.mapping.estimates import choose_estimates, sources_of
from pdhef_logtool.records.errors import MappingError, UsageError
from pdhef_logtool.records.signals import ESTIMATE_UNITS, Loss

TABLES = """
[signals.yaw_rate_rad_s]
topic = "/imu"
field = "gyro.z"
[estimates.esc.sideslip_rad]
topic = "/esc"
field = "beta"
scale = 0.017453292519943295
latency_s = 0.02
[estimates.esc.vx_m_s]
topic = "/esc"
field = "speed"
[estimates."my ekf 2.1".vy_m_s]
topic = "/ekf"
field = "vy"
"""


BETA = {"beta": np.zeros(10)}


def _log(**topics: dict[str, np.ndarray]) -> FakeLog:  # type: ignore[type-arg]
    times = np.arange(10, dtype=np.int64) * 10_000_000 + 1_700_000_000_000_000_000
    return FakeLog({name: FakeTopic("custom/Type", times, fields) for name, fields in topics.items()})


def test_tables_are_read_and_written_back(tmp_path: Path) -> None:
    (tmp_path / "m.toml").write_text(TABLES)
    mapping = load_mapping(tmp_path / "m.toml")
    assert list(mapping.estimates) == ["esc", "my ekf 2.1"]
    assert mapping.estimates["esc"]["sideslip_rad"].latency_s == 0.02
    assert "/esc" not in mapping.topics  # a run reads no estimates
    (tmp_path / "again.toml").write_text(mapping_to_toml(mapping))
    assert load_mapping(tmp_path / "again.toml").estimates == mapping.estimates


def test_topics_with_dots_are_found_by_the_longest_that_fits() -> None:
    values = {"c": np.zeros(10), "b.c": np.zeros(10)}
    log = _log(**{"a": values, "a.b": values})
    sources, _ = sources_of(log, ["vx_m_s=a.b.c", "vy_m_s=a.c"], ESTIMATE_UNITS, "--estimate")  # type: ignore[arg-type]
    assert {n: (s.topic, s.field) for n, s in sources.items()} == {"vx_m_s": ("a.b", "c"), "vy_m_s": ("a", "c")}


def test_flags_win_over_tables(tmp_path: Path) -> None:
    (tmp_path / "m.toml").write_text(TABLES)
    mapping = load_mapping(tmp_path / "m.toml")
    log = _log(**{"/esc": BETA})
    (flag,) = choose_estimates(log, ["sideslip_rad=/esc.beta"], mapping, None)  # type: ignore[arg-type]
    assert flag.name == "esc"
    assert flag.signals["sideslip_rad"].scale == 1.0
    tables = choose_estimates(log, [], mapping, None)  # type: ignore[arg-type]
    assert [e.name for e in tables] == ["esc", "my ekf 2.1"]


def test_a_topic_named_as_a_whole_brings_its_covariance_and_a_field_does_not(sample_logs_dir: Path) -> None:
    log = open_log(sample_logs_dir / "step.mcap")
    sources, covariance = sources_of(log, ["/rtk/odometry"], ESTIMATE_UNITS, "--estimate")
    assert {"vx_m_s", "vy_m_s"} <= sources.keys()
    assert covariance is not None
    assert covariance.topic == "/rtk/odometry"
    _, none = sources_of(log, ["vx_m_s=/rtk/odometry.twist.twist.linear.x"], ESTIMATE_UNITS, "--estimate")
    assert none is None
    log.close()


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
        sources_of(_log(**{"/esc": BETA, "/imu/raw": BETA}), texts, ESTIMATE_UNITS, "--estimate")  # type: ignore[arg-type]
    assert said in str(caught.value)
    assert "--estimate" in str(caught.value)


def test_losses_of_one_kind_at_one_place_become_one_that_spans_and_counts_all() -> None:
    first, second = Loss("nan", "w", "/a.x", 40, 50, 3), Loss("nan", "w", "/a.x", 10, 20, 4)
    whole = Loss("nan", "w", "/a.x")  # uncounted: adds no bound and no count
    for order in permutations((first, second, whole)):
        assert merge_losses([order[:1], order[1:]]) == (Loss("nan", "w", "/a.x", 10, 50, 7),)


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
