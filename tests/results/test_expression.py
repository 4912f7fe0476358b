"""Conditions as people write them."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.results.expression import Applied, Column, Number, parse_condition

SLIP, SPEED = Column(None, "sideslip_rad"), Column(None, "speed_m_s")


def test_and_binds_before_or_and_not_before_both() -> None:
    node = parse_condition("valid or not diverged and speed_m_s>1").node
    fast = Applied(">", (SPEED, Number(1.0)))
    not_diverged = Applied("not", (Column(None, "diverged"),))
    assert node == Applied("or", (Column(None, "valid"), Applied("and", (not_diverged, fast))))


def test_calculations_bind_as_in_school_and_to_the_left() -> None:
    node = parse_condition("speed_m_s - 2 * -sideslip_rad - 1e-1 < (3)").node
    times = Applied("*", (Number(2.0), Applied("minus", (SLIP,))))
    left = Applied("-", (Applied("-", (SPEED, times)), Number(0.1)))
    assert node == Applied("<", (left, Number(3.0)))


def test_tracks_units_and_errors_are_columns() -> None:
    condition = parse_condition("abs(pd-hef.sideslip_error_deg) > 2 and truth.speed_km_h >= yaw_rate_deg_s for 0.5 s")
    assert [(c.track, c.name, round(c.factor, 3)) for c in condition.columns()] == [
        ("pd-hef", "sideslip_error_rad", 57.296),
        ("truth", "speed_m_s", 3.6),
        (None, "yaw_rate_rad_s", 57.296),
    ]
    assert condition.least_s == 0.5
    assert condition.peak == Applied("abs", (Column("pd-hef", "sideslip_error_rad", 57.29577951308232),))
    assert not condition.falls
    (quoted,) = parse_condition("'pd-hef:gain=1'.vx_m_s > 2").columns()
    assert quoted == Column("pd-hef:gain=1", "vx_m_s")
    assert parse_condition("speed_m_s < 3").falls
    assert parse_condition("diverged").peak is None


@pytest.mark.parametrize(
    ("text", "sign", "expected", "got"),
    [
        ("", 1, "a condition on columns", "the end"),
        ("abs(sidslip_error_deg) > 2", 5, "a column such as sideslip_error_deg", "sidslip_error_deg"),
        ("speed_m_s > 2 and", 18, "a condition on columns", "the end"),
        ("speed_m_s > 2 & valid", 13, "a column, a number, abs or (", "2 & valid"),
        ("(speed_m_s > 2", 1, "a condition on columns", "("),
        ("speed_m_s > 2)", 14, "a condition on columns", ")"),
        ("1 < speed_m_s < 2", 17, "and between two comparisons", "2"),
        ("speed_m_s", 1, "a condition, such as a comparison", "speed_m_s"),
        ("speed_m_s and valid", 1, "a comparison or a flag", "speed_m_s"),
        ("valid + 1 > 2", 1, "a number", "valid"),
        ("abs(valid) > 2", 5, "a number", "valid"),
        ("speed_m_s > valid", 13, "a number", "valid"),
        ("valid for long", 11, "a time such as 0.5s", "long"),
        ("valid for 3 min", 13, "s, for seconds", "min"),
        ("truth.sideslip_error_rad > 1", 1, "an estimator before an error", "truth.sideslip_error_rad"),
        ("__import__('os').system('x') > 1", 1, "a column, a number, abs or (", "__import__('os').system('x')"),
        ("stamp_ns > 1", 1, "a column", "stamp_ns"),
        ("-" * 100 + "1 > 2", 41, "at most 40", "-"),
        ("(" * 1000 + "1", 0, "expected", "("),
        ("not " * 400 + "valid", 0, "at most 40", "not"),
        ("speed_m_s > 2 ü", 15, "a column, a number or an operator", "ü"),
        ("speed_m_s > 1j", 13, "a column, a number", "1j"),
        ("speed_m_s > True", 13, "a column, a number", "True"),
        ("speed_m_s > 2 " * 300, 0, "at most 2000 signs", "4200 signs"),
    ],
)
def test_an_error_points_at_its_place(text: str, sign: int, expected: str, got: str) -> None:
    with pytest.raises(UsageError) as error:
        parse_condition(text)
    assert expected in str(error.value)
    assert f"got {got}" in str(error.value)
    assert not sign or f"--where, character {sign} (here:" in str(error.value)


WORDS = ["speed_m_s", "valid", "truth.vx_km_h", "abs(", "(", ")", "and", "or", "not", "for", "0.5", "s", "<", "-", "*"]


@given(st.one_of(st.text(max_size=60), st.lists(st.sampled_from(WORDS), max_size=12).map(" ".join)))
def test_any_text_is_a_condition_or_one_line(text: str) -> None:
    try:
        parse_condition(text)
    except UsageError as error:
        assert "\n" not in str(error)
