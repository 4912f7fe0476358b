"""Of sensors that go together the late one is named; the shift is the one that every shift gives."""

from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.drive.checks import delay_checks
from pdhef_logtool.drive.correlation import CommonGrid, Shift, find_shift, on_common_grid, shift_error
from pdhef_logtool.drive.delays import LatencyEstimate
from pdhef_logtool.drive.measured import measure
from pdhef_logtool.drive.plan import plan_drive
from pdhef_logtool.drive.survey import mapping_proposals, survey_log
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.mapping import MappedChannels, Mapping, auto_map, fit_clocks
from pdhef_logtool.records.interpolation import Bracket
from pdhef_logtool.records.signals import WHEELS, Channel, FloatArray
from tests.drive.test_checks import survey

WHEEL_NAMES = tuple(f"wheel_speed_{w}_m_s" for w in WHEELS)


@pytest.fixture(scope="module")
def dlc(sample_logs_dir):
    return survey(sample_logs_dir / "dlc.mcap")


def delayed(found: MappedChannels, names: tuple[str, ...], delay_s: float) -> dict[str, Channel]:
    """Return a log's signals, some of them late."""
    late = round(delay_s * 1e9)
    return {n: replace(c, stamps_ns=c.stamps_ns + late) if n in names else c for n, c in found.signals.items()}


@pytest.mark.parametrize("name", ["dlc", "sweep", "fishhook", "step"])
def test_sound_sensors_are_not_late(sample_logs_dir, name):
    assert measure(survey(sample_logs_dir / f"{name}.mcap").signals).late == ()


@pytest.mark.parametrize(
    ("names", "delay_s", "exact"),
    [
        (("yaw_rate_rad_s",), 0.12, True),
        (WHEEL_NAMES, 0.12, True),
        (("steer_rad",), 0.12, False),
        (("ay_m_s2",), 0.25, False),
    ],
)
def test_a_late_sensor_is_named_with_its_delay_or_with_the_least_of_it(dlc, names, delay_s, exact):
    (late,) = measure(delayed(dlc, names, delay_s)).late
    assert (set(late.names), late.exact) == (set(names), exact)
    assert late.delay_s == pytest.approx(delay_s, abs=0.02) if exact else 0.0 < late.delay_s < delay_s
    checks = delay_checks([late])
    assert {c.name for c in checks} == {f"{n}.delay" for n in names}
    assert checks[0].remedy.endswith("at least") is not exact


def test_a_late_gyro_is_put_right_once_without_truth(sample_logs_dir):
    log = open_log(sample_logs_dir / "dlc.mcap")
    recognised = auto_map(log).mapping
    gyro = replace(recognised.signals["yaw_rate_rad_s"], latency_s=-0.12)
    mapping = replace(recognised, signals={**recognised.signals, gyro.name: gyro}, truth={}, origin="file")

    def proposed(given: Mapping) -> dict[str, float]:
        clocks = fit_clocks(log, given, log.start_ns, log.end_ns)
        found = survey_log(log, given, clocks, (log.start_ns, log.end_ns))
        return {p.subject: p.source.latency_s for p in mapping_proposals(found) if p.source is not None}

    latency_s = proposed(mapping)
    assert latency_s == {"yaw_rate_rad_s": pytest.approx(0.0, abs=0.02)}
    right = replace(gyro, latency_s=latency_s["yaw_rate_rad_s"])
    assert proposed(replace(mapping, signals={**mapping.signals, gyro.name: right})) == {}
    log.close()


ERROR_S = 0.002


@pytest.fixture(scope="module")
def planned(sample_logs_dir):
    with closing(open_log(sample_logs_dir / "step.mcap")) as log:
        return plan_drive(log, auto_map(log).mapping, default_vehicle(), log.start_ns, log.end_ns)


@pytest.mark.parametrize("std_errors", [2.001, -2.001, 30.0, 0.0, -1.1, 1.999, 2.0, -2.0])
def test_a_latency_is_applied_if_it_is_beyond_two_standard_errors(planned, std_errors):
    applied = std_errors * ERROR_S if abs(std_errors) > 2.0 else 0.0
    found = LatencyEstimate(std_errors * ERROR_S, 0.99, ERROR_S, True, False, "measured")
    assert replace(planned, latency=found).truth_latency_s == applied
    assert replace(planned, latency=None).truth_latency_s == 0.0


_UNKNOWN = Shift(float("nan"), float("nan"), False)


def by_every_shift(a: FloatArray, b: FloatArray, reach: int) -> FloatArray:
    """Return the coefficient at each shift as it is defined; NaN where a side varies by less than rounding."""
    found, n = np.full(2 * reach + 1, np.nan), len(a)
    for k in range(max(-reach, 2 - n), min(reach, n - 2) + 1):
        x, y = a[max(0, -k) : n - max(0, k)], b[max(0, k) : n - max(0, -k)]
        known = np.isfinite(x) & np.isfinite(y)
        sides = [(v[known], 1e-9 * np.nanvar(of)) for v, of in ((x, a), (y, b))]
        if np.count_nonzero(known) > 1 and all(v.var() > least for v, least in sides):
            found[k + reach] = np.corrcoef(x[known], y[known])[0, 1]
    return found


def pair(kind: str, rng: np.random.Generator, n: int) -> tuple[FloatArray, FloatArray]:
    """Make two signals of which one follows the other."""
    walk = np.cumsum(rng.standard_normal(n))
    late = np.roll(walk, int(rng.integers(-40, 40))) + rng.uniform() * rng.standard_normal(n)
    if kind == "holes":
        walk[rng.random(n) < 0.3] = late[rng.random(n) < 0.3] = np.nan
    made = {
        "walk": (walk, late), "holes": (walk, late), "equal": (walk, walk.copy()), "constant": (np.zeros(n), late),
        "ties": (np.arange(n) % 2.0, np.arange(n) % 2.0), "far from zero": (walk + 1e4, late),
        "tiny and huge": (walk * 1e-100, late * 1e100),
    }  # fmt: skip
    return made[kind]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["walk", "holes", "equal", "constant", "ties", "far from zero", "tiny and huge"])
@pytest.mark.filterwarnings("ignore:overflow", "ignore:invalid value")
def test_the_shift_is_that_of_every_shift(kind):
    rng = np.random.default_rng(0)
    for _ in range(40):
        a, b = pair(kind, rng, int(rng.integers(2, 200)))
        shift, every = find_shift(CommonGrid(0.01, a, b), 0.3), by_every_shift(a, b, 30)
        if not np.isfinite(every).any():
            assert repr(shift) == repr(_UNKNOWN)
            continue
        best = np.flatnonzero(every > np.nanmax(every) - 1e-6)  # equal to rounding
        assert shift.correlation == pytest.approx(np.nanmax(every), abs=1e-6)
        assert np.abs(shift.shift_s / 0.01 - (best - 30)).min() <= 0.5 + 1e-6
        assert shift.inside == (0.3 - abs(shift.shift_s) > 1e-9)


@pytest.mark.parametrize("share", [0.0, 0.4])
def test_columns_on_an_even_grid_are_those_of_numpy(share):
    rng = np.random.default_rng(1)
    stamps = np.cumsum(rng.integers(8_000_000, 12_000_000, 500)).astype(np.int64)
    stamps = stamps[(rng.random(500) >= share) | (np.arange(500) % 499 == 0)]
    for _ in range(3):
        values = np.cumsum(rng.standard_normal(len(stamps)))
        found = on_common_grid(stamps, values, stamps.copy(), values)
        on_grid = Bracket(
            stamps,
            np.arange(stamps[0], stamps[-1] + 1, round(found.step_s * 1e9)),
            round(3 * np.median(np.diff(stamps))),
        ).linear(values)
        known, n = np.flatnonzero(np.isfinite(on_grid)), len(on_grid)
        slope, offset = np.polyfit(known / n, on_grid[known], 1)
        expected = on_grid - offset - slope * (np.arange(n) / n)
        same = on_common_grid(stamps, values, stamps, values)
        for column in (same.a, same.b, found.a, found.b):
            np.testing.assert_allclose(column, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("coloured", [False, True])
def test_the_error_of_a_shift_is_that_of_its_scatter(coloured):
    """Noise is white or as slow as a bend: the spread of shifts over many drives is the error that is stated."""
    rng, ratios = np.random.default_rng(3), []
    for _ in range(40):
        a, noise = (np.convolve(rng.standard_normal(6200), np.hanning(200), "valid") for _ in range(2))
        noise = noise[:6000] if coloured else 6.0 * rng.standard_normal(6000)
        b = np.roll(a[:6000], 7) + 0.1 * noise
        grid = CommonGrid(0.01, a[:6000], b)
        shift = find_shift(grid, 0.5).shift_s
        ratios.append((shift - 0.07) / shift_error(grid, shift))
    assert 0.3 < np.sqrt(np.mean(np.square(ratios))) < 1.3
