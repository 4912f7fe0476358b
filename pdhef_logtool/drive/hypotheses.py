"""One engine for wrong units, signs and fields: the posterior of each hypothesis, given the relations between signals.

A relation has the gains of the blocks of a drive. A hypothesis multiplies them with what undoes it; its energy is its
prior plus what the gains then miss the plausible range by, bounded for each block: a car that slides, a wheel that
spins, or a bank is wrong in some blocks, a unit in all of them. Probabilities are exp(-energy), normalised.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from itertools import combinations

import numpy as np

from pdhef_logtool.mapping.naming import CACHED_NAMES, G_M_S2
from pdhef_logtool.records.signals import BoolArray, FloatArray

DEGREE = float(np.pi / 180.0)
#: Below this correlation a gain gives no information, and above it, it is between the two regressions. It must be so
#: far from chance, by Fisher's z of the independent samples; below so many of them (3 s) nothing is stated.
MIN_CORRELATION, MIN_CHANCE_Z, MIN_SAMPLES = 0.6, 3.0, 6.0
#: Two sides that move, and not with one another: another field was mapped.
UNRELATED_CORRELATION = 0.25
#: Typical values that recognise one quantity recorded as another.
TYPICAL_STEERING_RATIO, TYPICAL_WHEEL_RADIUS_M = 16.0, 0.3
_TYPICAL = (*(f for t in (TYPICAL_STEERING_RATIO, TYPICAL_WHEEL_RADIUS_M) for f in (t, 1.0 / t)),)
#: Factors between units that mappings confuse for any quantity: degrees, g, km/h.
FOREIGN = (1.0 / DEGREE, G_M_S2, 3.6)
#: Factors that differ by less in the logarithm are one unit (km/h and mph are 0.48 apart), and ranges of gains that are
#: narrower rule out all units but one: wider ones are lengths of any car.
SAME_FACTOR, DECIDES_UNIT = 0.25, 13.0

#: 1-sigma of the logarithm of a gain within a range that decides units, beyond its edges, and beyond those of a range
#: that has room for any car.
LEAST_WIDTH, EDGE, WIDE_EDGE = 0.05, 0.15, 0.04
#: Largest energy of one relation (sensors fail and cars slide), and its energy with a field that is something else.
MOST_ENERGY, _ANY_GAIN = 20.0, 2.0
#: Energies of hypotheses (negative logarithms of their prior odds): mistakes are seldom, two of them more so, units of
#: another quantity are the slips of templates, and a field that is something else explains any gain.
PRIORS = {"unit": 5.0, "sign": 5.0, "sign and unit": 9.0, "foreign": 5.7, "field": 14.0, "open": 0.0}
PRIORS |= {"open sign": 1.0}  # that nothing documents: most recorders count to the left
#: One in ten scales of right mappings is not that of a unit: raw counts, a ratio, a calibration.
PRIORS |= {"odd scale": math.log(10.0)}
#: Of signals that explain a contradiction equally well the first is the likeliest: no standard states how a steering
#: angle counts, and an axis of an IMU is turned more often than the sign of a gyro that is read from the right one.
_OFTEN_WRONG = ("steering_wheel_rad", "steer_rad", "wheels", "ax_m_s2", "ay_m_s2", "yaw_rate_rad_s", "speed_m_s")
_SELDOM, _SELDOM_STEP = 1.0, 0.3
#: Blocks of a drive whose gains are compared.
BLOCKS = 8


@dataclass(frozen=True, slots=True)
class Relation:
    """One relation with its measured gain; ``powers`` show how the gain grows with each signal's own scale.

    Attributes
    ----------
    expected : range of a plausible gain. samples : independent ones. moves : both sides, or one of two that must move
        together, move by more than what disturbs them. signless : a side is a size.
    least_correlation : below it the gain gives no information.
    typical : the likeliest gain. blocks : gains of blocks of the drive, each without its own means.
    """

    text: str
    powers: dict[str, int]
    correlation: float
    gain: float
    expected: tuple[float, float]
    samples: float
    moves: bool = False
    signless: bool = False
    least_correlation: float = MIN_CORRELATION
    typical: float = 1.0
    blocks: tuple[float, ...] = ()

    @property
    def decides_unit(self) -> bool:
        """Return whether no other unit that is met in mappings would be plausible between the two regressions."""
        return self.expected[1] < DECIDES_UNIT * self.expected[0] * self.correlation**2

    @property
    def tells(self) -> bool:
        """Return whether the drive excites the relation enough for a verdict."""
        bounded = min(abs(self.correlation), 1.0 - 1e-9)
        chance_z = math.atanh(bounded) * math.sqrt(max(self.samples - 3.0, 0.0))
        return abs(self.correlation) >= self.least_correlation and chance_z >= MIN_CHANCE_Z

    @property
    def unrelated(self) -> bool:
        """Return whether the sides move, and not with one another."""
        return self.moves and self.samples >= 4.0 * MIN_SAMPLES and abs(self.correlation) < UNRELATED_CORRELATION

    def accepts(self, factor: float = 1.0) -> bool:
        """Return whether the gain is plausible after multiplying it with ``factor``.

        It lies between the two regressions, which are correlation x gain and gain / correlation.
        """
        gain, size = self.gain * factor, abs(self.correlation)
        gain = abs(gain) if self.signless else gain
        return size > 0.0 and gain / size >= self.expected[0] and gain * size <= self.expected[1]

    def energies(self, factors: FloatArray) -> FloatArray:
        """Return the negative log likelihoods [N] of the blocks' gains after multiplying them with each factor [N].

        NaN: another field, whose gain may be any.
        """
        gains = factors[:, None] * (self.blocks or (self.gain,))
        low, high = (math.log(max(e, 1e-12)) for e in self.expected)
        with np.errstate(divide="ignore"):
            size = np.log(np.abs(gains))
        room = -math.log(max(abs(self.correlation), 1e-3))  # between the two regressions
        # Blocks that differ show what changes: sliding, a frequency that tyres do not follow; a unit does not change.
        # A drive without blocks slides for all of it: they would differ by half of what the relation leaves.
        unknown = 0.5 * math.sqrt(max(0.0, 1.0 - self.correlation**2))
        apart = float(np.std(np.log(np.abs(self.blocks)))) if self.blocks and all(self.blocks) else unknown
        beyond = np.maximum(np.maximum(low - room - size, size - high - room), 0.0)
        energy = 0.5 * (beyond / math.hypot(EDGE if self.decides_unit else WIDE_EDGE, apart)) ** 2
        if self.decides_unit:
            middle = math.log(self.typical) if low < math.log(self.typical) < high else 0.5 * (low + high)
            off = np.maximum(np.abs(size - middle) - room, 0.0)
            energy += 0.5 * (off / math.hypot(max((high - low) / 6.0, LEAST_WIDTH), apart)) ** 2
        energy = np.minimum(energy, MOST_ENERGY)
        mean = (energy if self.signless else np.where(gains > 0.0, energy, MOST_ENERGY)).mean(axis=1)
        return np.where(np.isnan(factors), _ANY_GAIN, mean)

    @property
    def evidence(self) -> str:
        """What was measured, in words."""
        low, high = self.expected
        return (
            f"{self.text}: gain {self.gain:.3g} where {low:.3g} to {high:.3g} is plausible, correlation "
            f"{self.correlation:.2f}"
        )


@dataclass(frozen=True)
class Hypothesis:
    """A mistake of a mapping: ``factors`` by signal undo it, NaN: nothing does. ``kind``: a key of :data:`PRIORS`."""

    factors: dict[str, float]
    words: str
    kind: str

    @property
    def is_exact(self) -> bool:
        """Whether the factors are those of units and signs, not a typical steering ratio or wheel radius."""
        return not any(abs(f) in _TYPICAL or math.isnan(f) for f in self.factors.values())

    @cached_property
    def energy(self) -> float:
        """The negative logarithm of its prior odds."""
        if self.kind.startswith("open"):
            return PRIORS[self.kind]
        names = {"wheels" if n.startswith("wheel_speed") else n for n in self.factors}
        rank = max(_OFTEN_WRONG.index(n) if n in _OFTEN_WRONG else len(_OFTEN_WRONG) for n in names)
        seldom = 0.0 if rank < 2 else (_SELDOM + _SELDOM_STEP * rank) * (2.0 if self.kind == "foreign" else 1.0)
        return PRIORS[self.kind] + seldom + 0.5 * (len(names) - 1) + (0.0 if self.is_exact else 0.5)

    def is_about(self, names: set[str]) -> bool:
        """Return whether all of it, or of an open sign a part, is of these signals."""
        shared = len(self.factors.keys() & names)
        return shared == len(self.factors) or (self.kind == "open sign" and shared > 0)

    def acts_on(self, relation: Relation) -> float:
        """Return what undoing it multiplies the relation's gain with."""
        return math.prod(f ** relation.powers[n] for n, f in self.factors.items() if n in relation.powers)


@dataclass(frozen=True, slots=True)
class Posterior:
    """Sets of mistakes with their probabilities, the likeliest first; the empty set: the mapping is right."""

    sets: tuple[tuple[float, tuple[Hypothesis, ...]], ...]

    def of(self, name: str) -> list[tuple[float, Hypothesis]]:
        """Return the mistakes of a signal with their probabilities, the likeliest first."""
        mistakes = {id(h): h for _, chosen in self.sets for h in chosen if name in h.factors}
        shares = [(sum(p for p, chosen in self.sets if any(h is m for h in chosen)), m) for m in mistakes.values()]
        return sorted(shares, key=lambda x: -x[0])

    def turned(self, name: str) -> float:
        """Return the probability that an open sign is the other one."""
        return sum(p for p, c in self.sets if any(h.kind == "open sign" and name in h.factors for h in c))


def posterior(
    relations: Sequence[Relation], hypotheses: Sequence[Hypothesis], scales: Mapping[str, object] | None = None
) -> Posterior:
    """Return the probabilities of sets of at most two hypotheses, given the relations that count.

    ``scales``: what the mapping multiplies the signals' raw values with, where known.
    """
    telling = [r for r in relations if r.tells]
    touched = {n for r in telling for n in r.powers}
    # With a signal that no relation is about, a mistake is another one of the same likelihood.
    useful = [h for h in hypotheses if h.is_about(touched)]
    priors = np.array([*(h.energy + _of_scales(h, scales or {}) for h in useful), 0.0])
    # What each mistake, and at last none, multiplies each relation's gain with.
    acts = np.ones((len(useful) + 1, len(telling)))
    for name in touched:
        factors = np.array([*(h.factors.get(name, 1.0) for h in useful), 1.0])
        acts *= factors[:, None] ** [r.powers.get(name, 0) for r in telling]
    looked_up = []
    for relation, column in zip(telling, acts.T, strict=True):
        single, index = np.unique(column, return_inverse=True)
        table = relation.energies(np.outer(single, single).ravel()).reshape(len(single), len(single))
        looked_up.append((table, index))

    none = len(useful)
    sets = np.concatenate([[(k, none) for k in range(none + 1)], np.argwhere(np.triu(_compatible(useful)))])
    first, second = sets.T
    energy = priors[first] + priors[second] + sum(table[index[first], index[second]] for table, index in looked_up)
    least = float(energy.min())
    likely = np.flatnonzero(energy < least + 25.0)  # the others have less than 1e-10 of the likeliest's probability
    weights = {tuple(k for k in sets[i].tolist() if k != none): math.exp(least - energy[i]) for i in likely}
    total = sum(weights.values())
    ordered = sorted(weights.items(), key=lambda x: (-x[1], x[0]))
    return Posterior(tuple((w / total, tuple(useful[i] for i in k)) for k, w in ordered))


def _compatible(mistakes: Sequence[Hypothesis]) -> BoolArray:
    """Return [N, N] which of them may both be true: of different signals, and neither is a foreign factor."""
    names = sorted({n for h in mistakes for n in h.factors})
    about = np.array([[n in h.factors for n in names] for h in mistakes], dtype=bool).reshape(len(mistakes), len(names))
    common = np.array([h.kind != "foreign" for h in mistakes], dtype=bool)
    return np.asarray(np.outer(common, common) & ~(about @ about.T))


@lru_cache
def known_hypotheses(
    names: tuple[str, ...], together: tuple[tuple[str, ...], ...] = (), open_signs: tuple[tuple[str, ...], ...] = ()
) -> tuple[Hypothesis, ...]:
    """List the mistakes that mappings make with these signals.

    Parameters
    ----------
    together : signals of one sensor, whose units or signs are wrong together.
    open_signs : signals whose sign nothing documents; those of a group share it. A recorder may turn all of them.
    """
    groups = [[n for n in group if n in names] for group in together]
    parts = [part for group in groups for size in range(2, len(group) + 1) for part in combinations(group, size)]
    # The mean of the wheels is no signal.
    alone = [(n,) for n in names if n != "wheel_speeds"]
    out = [h for part in (*alone, *dict.fromkeys(parts)) for h in _of_part(part)]
    every = tuple(n for group in open_signs for n in group)
    out = [h for h in out if h.kind != "sign" or not h.factors.keys() <= set(every)]
    for part in dict.fromkeys([*open_signs, *([every] if every else [])]):
        out.append(Hypothesis(dict.fromkeys(part, -1.0), f"{_together(part)} count to the right", "open sign"))
    wheels = [(*g,) for g in groups if g and all(n.startswith("wheel_speed") for n in g)]
    return (*out, *(Hypothesis(dict.fromkeys(part, math.nan), _together(part), "field") for part in (*alone, *wheels)))


def _of_part(part: tuple[str, ...]) -> Iterator[Hypothesis]:
    """Yield the wrong units and signs that signals have together."""
    words, is_one = _together(part), len(part) == 1
    units = units_of(part[0].removeprefix("truth."))
    for name in part[1:]:
        shared = {f for f, _ in units_of(name.removeprefix("truth."))}
        units = [(f, text) for f, text in units if f in shared]
    for factor, text in units:
        yield Hypothesis(dict.fromkeys(part, factor), f"{words if is_one else f'{words}: each'} {text}", "unit")
        if is_one:
            both = f"{words} {text} and has the wrong sign"
            yield Hypothesis({part[0]: -factor}, both, "sign and unit")
    # A sensor is mounted upside down or backwards, or ground truth has another convention; speeds count ahead.
    if part != ("truth.position_speed_m_s",) and (is_one or not _NEVER_TURNED & set(part)):  # a size has no sign
        has = "has" if is_one else "have"
        yield Hypothesis(dict.fromkeys(part, -1.0), f"{words} {has} the wrong sign", "sign")
    verb = "are" if words.endswith("speeds") else "is"
    for factor in (f for size in FOREIGN for f in (size, 1.0 / size)):
        if all(abs(math.log(factor / other)) > SAME_FACTOR for other, _ in units):
            text = f"{words} {verb} off by a factor of {1.0 / factor:.4g}"
            yield Hypothesis(dict.fromkeys(part, factor), text, "foreign")


_NEVER_TURNED = frozenset({"speed_m_s", "steer_rad", "steering_wheel_rad"})


def _together(names: Sequence[str]) -> str:
    """Return signals in words; the wheel speeds and their mean as one."""
    wheels = [n for n in names if n.startswith("wheel_speed")]
    # The path does not show which of the two is wrong.
    shown = ["truth.x_m or truth.y_m (which may be exchanged)" if n == "truth.y_m" else n for n in names]
    return "wheel speeds" if len(wheels) == len(names) > 2 else " and ".join(shown)


def units_of(name: str) -> list[tuple[float, str]]:
    """Return by what a signal is off where its unit is taken for another, and how that is stated."""
    to_radians = [(DEGREE, "is in degrees"), (1.0 / DEGREE, "was converted from degrees twice")]
    km_h, mph = 3.6, 0.44704
    of_speeds = [(1.0 / km_h, "is in km/h"), (km_h, "was converted from km/h twice")]
    of_speeds += [(mph, "is in mph"), (1.0 / mph, "was converted from mph twice")]
    if name in ("yaw_rate_rad_s", "roll_rate_rad_s", "pitch_rate_rad_s", "sideslip_rad", "yaw_rad"):
        return to_radians
    if name == "steer_rad":
        return [*to_radians, (1.0 / TYPICAL_STEERING_RATIO, "is the steering-wheel angle")]
    if name == "steering_wheel_rad":
        return [*to_radians, (TYPICAL_STEERING_RATIO, "is the road-wheel angle")]
    if name in ("ax_m_s2", "ay_m_s2"):
        return [(G_M_S2, "is in g"), (1.0 / G_M_S2, "was converted from g twice")]
    if name in ("vx_m_s", "vy_m_s", "speed_m_s"):
        return [*of_speeds, (1e-3, "is in mm/s")]
    if name.startswith("wheel_speed") and name.endswith("_rad_s"):
        return [(2.0 * np.pi / 60.0, "is in rpm"), (1.0 / TYPICAL_WHEEL_RADIUS_M, "is in m/s")]
    if name.startswith("wheel_speed"):
        return [*of_speeds, (TYPICAL_WHEEL_RADIUS_M, "is in rad/s")]
    return []


def _of_scales(mistake: Hypothesis, scales: Mapping[str, object]) -> float:
    """Return the energy of undoing a mistake in a mapping: its scales should become those of units."""
    energies = [
        PRIORS["odd scale"] * (is_odd(name, scale * factor) - is_odd(name, scale))
        for name, factor in mistake.factors.items()
        if isinstance(scale := scales.get(name), float | int) and not math.isnan(factor)
    ]
    return sum(energies) / max(len(energies), 1)


@lru_cache(maxsize=CACHED_NAMES)
def is_odd(name: str, scale: float) -> bool:
    """Return whether no unit of a signal has this scale."""
    return not any(abs(abs(scale) - unit) < 0.01 * unit for unit in _unit_scales(name))


@cache
def _unit_scales(name: str) -> tuple[float, ...]:
    of_units = units_of(name.removeprefix("truth."))
    return (1.0, *(f for f, words in of_units if words.startswith("is in") and f not in _TYPICAL))


def block_gains(reference: FloatArray, measured: FloatArray, blocks: int) -> tuple[float, ...]:
    """Return the gains [at most ``blocks``] of blocks of a drive that move; each has its own means: a bank, a bias.

    Parameters
    ----------
    reference, measured : float64 [N], known everywhere.
    """
    least, gains = 0.3 * float(reference.std()), []
    for a, b in zip(np.array_split(reference, blocks), np.array_split(measured, blocks), strict=True):
        spread_a, spread_b = float(a.std()), float(b.std())
        if a.size < 2 or min(spread_a - least, spread_b) <= 1e-12:
            continue
        correlation = float(np.mean((a - a.mean()) * (b - b.mean()))) / (spread_a * spread_b)
        if abs(correlation) >= MIN_CORRELATION:
            gains.append(math.copysign(spread_b / spread_a, correlation))
    return tuple(gains) if len(gains) >= 3 else ()
