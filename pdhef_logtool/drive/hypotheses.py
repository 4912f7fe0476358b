"""Posterior probabilities of wrong units, signs and fields, given the relations between signals.

Each relation stores one gain per block of the drive. A hypothesis rescales these gains. Its energy is the prior plus
the distance of the rescaled gains from the plausible range. The distance is bounded for each block, because sliding,
wheel spin or a bank change some blocks only, and a wrong unit changes all. Probabilities are exp(-energy), normalised.
"""

import math
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, lru_cache
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from pdhef_logtool.mapping.naming import CACHED_NAMES
from pdhef_logtool.records.geometry import DEGREES, GRAVITY_M_S2
from pdhef_logtool.records.signals import KM_H, LEAST_DIVISOR, BoolArray, FloatArray

#: Least correlation at which a gain gives information (the true gain is between the two regressions), least Fisher z
#: of the correlation, and least number of independent samples (3 s).
MIN_CORRELATION, MIN_CHANCE_Z, MIN_SAMPLES = 0.6, 3.0, 6.0
#: Two sides that move with a lower correlation are unrelated: another field is mapped.
UNRELATED_CORRELATION = 0.25
#: Relations and units as tables, here and in :mod:`~.relations`.
TABLE: dict[str, Any] = tomllib.loads(Path(__file__).with_name("relations.toml").read_text(encoding="utf-8"))
#: Correction factors with their texts by unit, and units in which mappings confuse a signal. A typical steering ratio
#: or wheel radius recognises one quantity recorded as another.
FACTORS: dict[str, list[tuple[float, str]]] = TABLE["factors"]
UNITS: dict[str, list[str]] = TABLE["units"]
_TYPICAL = {factor for unit, factors in FACTORS.items() if unit.startswith("typical") for factor, _ in factors}
#: Factors between units that mappings confuse for any quantity: degrees, g, km/h.
FOREIGN = (DEGREES, GRAVITY_M_S2, KM_H)
#: Logarithms of factors that differ by less are one unit (km/h and mph are 0.48 apart). A range of gains with a smaller
#: ratio of its ends rules out all units but one; wider ranges are lengths of any car.
SAME_FACTOR, DECIDES_UNIT = 0.25, 13.0

#: 1-sigma of the logarithm of a gain: within a range that decides units, beyond the edges of such a range, and beyond
#: the edges of a range for any car.
LEAST_WIDTH, EDGE, WIDE_EDGE = 0.05, 0.15, 0.04
#: Largest energy of one relation (sensors fail and cars slide), and its energy if a wrong field is mapped.
MOST_ENERGY, _ANY_GAIN = 20.0, 2.0
#: Energies of hypotheses (negative logarithms of their prior odds), and signals by the frequency of their mistakes.
PRIORS: dict[str, float] = TABLE["priors"]
_OFTEN_WRONG: list[str] = TABLE["often_wrong"]["signals"]
#: Number of blocks of a drive with separate gains.
BLOCKS = 8


@dataclass(frozen=True, slots=True)
class Law:
    """A relation as data (``relations.toml``): the measured side is a plausible gain times the predicted side.

    Attributes
    ----------
    powers : exponents of the signals' scales in the gain. gains : range of plausible gains. typical : the likeliest.
    moves : a side that varies by more, 1-sigma, must vary with the other; with ``either`` False only the predicted side
        must. bias : 1-sigma of the offset between the sides. signless : one side has no sign.
    delay_s : plausible delay of the measured side. late : the late signals below and above it.
    exact : the vehicle adds no delay. least_correlation : below it the gain gives no information.
    most_energy : largest energy of a gain.
    """

    text: str
    powers: dict[str, int]
    gains: tuple[float, float]
    typical: float = 1.0
    moves: float = math.inf
    either: bool = True
    bias: float = math.inf
    signless: bool = False
    delay_s: tuple[float, float] | None = None
    late: tuple[str, ...] = ()
    exact: bool = False
    least_correlation: float = MIN_CORRELATION
    most_energy: float = MOST_ENERGY


@dataclass(frozen=True, slots=True, eq=False)
class Relation:
    """One relation with its measured gain.

    Attributes
    ----------
    samples : number of independent samples. moves : whether the signals vary by more than disturbances cause.
    blocks : gains of blocks of the drive, each without the block's means. sides : predicted and measured [N].
    """

    law: Law
    correlation: float
    gain: float
    samples: float
    moves: bool = False
    blocks: tuple[float, ...] = ()
    sides: tuple[FloatArray, FloatArray] | None = None

    @property
    def powers(self) -> dict[str, int]:
        """Exponents of the signals' scales in the gain."""
        return self.law.powers

    @property
    def decides_unit(self) -> bool:
        """Return whether the plausible range is narrow enough to exclude all other units."""
        return self.law.gains[1] < DECIDES_UNIT * self.law.gains[0] * self.correlation**2

    @property
    def tells(self) -> bool:
        """Return whether the drive excites the relation enough for a verdict."""
        bounded = min(abs(self.correlation), 1.0 - 1e-9)
        chance_z = math.atanh(bounded) * math.sqrt(max(self.samples - 3.0, 0.0))
        return abs(self.correlation) >= self.law.least_correlation and chance_z >= MIN_CHANCE_Z

    @property
    def unrelated(self) -> bool:
        """Return whether both sides move without being correlated."""
        return self.moves and self.samples >= 4.0 * MIN_SAMPLES and abs(self.correlation) < UNRELATED_CORRELATION

    def accepts(self, factor: float = 1.0) -> bool:
        """Return whether the gain times ``factor`` is plausible.

        The true gain is between the two regressions, correlation x gain and gain / correlation.
        """
        gain, size = self.gain * factor, abs(self.correlation)
        gain = abs(gain) if self.law.signless else gain
        return size > 0.0 and gain / size >= self.law.gains[0] and gain * size <= self.law.gains[1]

    def energies(self, factors: FloatArray) -> FloatArray:
        """Return the negative log likelihoods [N] of the blocks' gains times each factor [N].

        A NaN factor means a wrong field, for which any gain is possible.
        """
        gains = factors[:, None] * (self.blocks or (self.gain,))
        low, high = (math.log(max(e, LEAST_DIVISOR)) for e in self.law.gains)
        with np.errstate(divide="ignore"):
            size = np.log(np.abs(gains))
        room = -math.log(max(abs(self.correlation), 1e-3))  # between the two regressions
        # Blocks differ by sliding and by fast steering, which change during the drive; a wrong unit does not change.
        # A drive without blocks may slide throughout: half of the unexplained share is assumed as their difference.
        unknown = 0.5 * math.sqrt(max(0.0, 1.0 - self.correlation**2))
        apart = float(np.std(np.log(np.abs(self.blocks)))) if self.blocks and all(self.blocks) else unknown
        beyond = np.maximum(np.maximum(low - room - size, size - high - room), 0.0)
        energy = 0.5 * (beyond / math.hypot(EDGE if self.decides_unit else WIDE_EDGE, apart)) ** 2
        if self.decides_unit:
            middle = math.log(self.law.typical) if low < math.log(self.law.typical) < high else 0.5 * (low + high)
            off = np.maximum(np.abs(size - middle) - room, 0.0)
            energy += 0.5 * (off / math.hypot(max((high - low) / 6.0, LEAST_WIDTH), apart)) ** 2
        energy = np.minimum(energy, self.law.most_energy)
        mean = (energy if self.law.signless else np.where(gains > 0.0, energy, self.law.most_energy)).mean(axis=1)
        return np.where(np.isnan(factors), _ANY_GAIN, mean)

    @property
    def evidence(self) -> str:
        """The measured gain and correlation as text."""
        low, high = self.law.gains
        return (
            f"{self.law.text}: gain {self.gain:.3g} where {low:.3g} to {high:.3g} is plausible, correlation "
            f"{self.correlation:.2f}"
        )


@dataclass(frozen=True)
class Hypothesis:
    """A mapping error. ``factors`` correct it, by signal (NaN: not correctable). ``kind``: a key of :data:`PRIORS`."""

    factors: dict[str, float]
    words: str
    kind: str

    @property
    def is_exact(self) -> bool:
        """Whether the factors are exact units and signs, not a typical steering ratio or wheel radius."""
        return not any(abs(f) in _TYPICAL or math.isnan(f) for f in self.factors.values())

    @cached_property
    def energy(self) -> float:
        """Negative logarithm of the prior odds."""
        if self.kind.startswith("open"):
            return PRIORS[self.kind]
        names = {"wheels" if n.startswith("wheel_speed") else n for n in self.factors}
        rank = max(_OFTEN_WRONG.index(n) if n in _OFTEN_WRONG else len(_OFTEN_WRONG) for n in names)
        seldom = 0.0 if rank < 2 else (PRIORS["seldom"] + PRIORS["seldom step"] * rank)
        seldom *= 2.0 if self.kind == "foreign" else 1.0
        return PRIORS[self.kind] + seldom + 0.5 * (len(names) - 1) + (0.0 if self.is_exact else 0.5)

    def is_about(self, names: set[str]) -> bool:
        """Return whether all signals of the hypothesis (for an open sign: any) are among these names."""
        shared = len(self.factors.keys() & names)
        return shared == len(self.factors) or (self.kind == "open sign" and shared > 0)

    def acts_on(self, relation: Relation) -> float:
        """Return the factor on the relation's gain when the mistake is corrected."""
        return math.prod(f ** relation.powers[n] for n, f in self.factors.items() if n in relation.powers)


@dataclass(frozen=True, slots=True)
class Posterior:
    """Sets of mistakes with their probabilities, the likeliest first; the empty set means a correct mapping."""

    sets: tuple[tuple[float, tuple[Hypothesis, ...]], ...]

    def of(self, name: str) -> list[tuple[float, Hypothesis]]:
        """Return the mistakes of a signal with their probabilities, the likeliest first."""
        shares: dict[int, tuple[float, Hypothesis]] = {}
        for p, mistake in ((p, h) for p, chosen in self.sets for h in chosen if name in h.factors):
            shares[id(mistake)] = shares.get(id(mistake), (0.0, mistake))[0] + p, mistake
        return sorted(shares.values(), key=lambda x: -x[0])

    def turned(self, name: str) -> float:
        """Return the probability that an open sign is inverted."""
        return sum(p for p, c in self.sets if any(h.kind == "open sign" and name in h.factors for h in c))


def posterior(
    relations: Sequence[Relation], hypotheses: Sequence[Hypothesis], scales: Mapping[str, object] | None = None
) -> Posterior:
    """Return the probabilities of sets of at most two hypotheses, given the informative relations.

    ``scales``: known scales of the mapping, by signal.
    """
    telling = [r for r in relations if r.tells]
    touched = {n for r in telling for n in r.powers}
    # Mistakes of signals without a relation change no likelihood.
    useful = [h for h in hypotheses if h.is_about(touched)]
    priors = np.array([*(h.energy + _of_scales(h, scales or {}) for h in useful), 0.0])
    none = len(useful)
    # Factors of the mistakes by signal; the last one is of no mistake.
    factors = {name: np.ones(none + 1) for name in touched}
    for k, mistake in enumerate(useful):
        for name in mistake.factors.keys() & touched:
            factors[name][k] = mistake.factors[name]
    first, second = np.nonzero(np.triu(_compatible(useful)))
    first, second = np.append(np.arange(none + 1), first), np.append(np.full(none + 1, none), second)
    energy = np.zeros(len(first))
    for relation in telling:
        on_gain = np.prod([factors[name] ** power for name, power in relation.powers.items()], axis=0)
        single, index = np.unique(on_gain, return_inverse=True)
        table = relation.energies(np.outer(single, single).ravel()).reshape(len(single), len(single))
        energy += table[index[first], index[second]]
    energy += priors[first] + priors[second]
    least = float(energy.min())
    likely = np.flatnonzero(energy < least + 25.0)  # all others are less than 1e-10 times as likely
    weights = {tuple(sorted({int(first[i]), int(second[i])} - {none})): math.exp(least - energy[i]) for i in likely}
    total = sum(weights.values())
    ordered = sorted(weights.items(), key=lambda x: (-x[1], x[0]))
    return Posterior(tuple((w / total, tuple(useful[i] for i in k)) for k, w in ordered))


def _compatible(mistakes: Sequence[Hypothesis]) -> BoolArray:
    """Return bool [N, N], the pairs that can be true together: of different signals, neither of kind ``foreign``."""
    names = sorted({n for h in mistakes for n in h.factors})
    about = np.array([[n in h.factors for n in names] for h in mistakes], dtype=np.float32)
    about = about.reshape(len(mistakes), len(names))
    common = np.array([h.kind != "foreign" for h in mistakes], dtype=bool)
    return np.asarray(np.outer(common, common) & (about @ about.T == 0.0))


@lru_cache
def known_hypotheses(
    names: tuple[str, ...], together: tuple[tuple[str, ...], ...] = (), open_signs: tuple[tuple[str, ...], ...] = ()
) -> tuple[Hypothesis, ...]:
    """List the possible mapping errors of these signals.

    Parameters
    ----------
    together : signals of one sensor, which have wrong units or signs together.
    open_signs : groups of signals with an undocumented sign; each group has one sign, and a recorder may invert all.
    """
    groups = [[n for n in group if n in names] for group in together]
    parts = [part for group in groups for size in range(2, len(group) + 1) for part in combinations(group, size)]
    # The mean of the wheels is not a signal.
    alone = [(n,) for n in names if n != "wheel_speeds"]
    out = [h for part in (*alone, *dict.fromkeys(parts)) for h in _of_part(part)]
    every = tuple(n for group in open_signs for n in group)
    out = [h for h in out if h.kind != "sign" or not h.factors.keys() <= set(every)]
    for part in dict.fromkeys([*open_signs, *_sides(open_signs), *([every] if every else [])]):
        out.append(Hypothesis(dict.fromkeys(part, -1.0), f"{_together(part)} count to the right", "open sign"))
    wheels = [(*g,) for g in groups if g and all(n.startswith("wheel_speed") for n in g)]
    return (*out, *(Hypothesis(dict.fromkeys(part, math.nan), _together(part), "field") for part in (*alone, *wheels)))


def opened(mistake: Hypothesis, open_units: frozenset[str]) -> Hypothesis:
    """Return a mistake, as a likely one if it is another unit of signals with an assumed unit."""
    is_open = mistake.kind == "unit" and " is in " in mistake.words and mistake.factors.keys() <= open_units
    return replace(mistake, kind="open unit") if is_open else mistake


def _sides(groups: Sequence[tuple[str, ...]]) -> Iterator[tuple[str, ...]]:
    """Yield the signals of the sensors, then of the ground truth: the two recorders may use different conventions."""
    for is_true in (False, True):
        if names := tuple(n for g in groups if any(m.startswith("truth.") == is_true for m in g) for n in g):
            yield names


def _of_part(part: tuple[str, ...]) -> Iterator[Hypothesis]:
    """Yield the hypotheses of a wrong unit or sign that the signals share."""
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
    # Sensors are mounted upside down or backwards, and ground truth has other conventions; speeds are positive ahead.
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
    """Return names of signals as text, with one name for the wheel speeds and their mean."""
    wheels = [n for n in names if n.startswith("wheel_speed")]
    # The path does not show which of the two is wrong.
    shown = ["truth.x_m or truth.y_m (which may be exchanged)" if n == "truth.y_m" else n for n in names]
    return "wheel speeds" if len(wheels) == len(names) > 2 else " and ".join(shown)


@cache
def units_of(name: str) -> list[tuple[float, str]]:
    """Return the correction factors for the units in which a signal may be recorded, each with its text."""
    return [(factor, words) for unit in UNITS.get(kind_of(name), ()) for factor, words in FACTORS[unit]]


def kind_of(name: str) -> str:
    """Return the name of a signal, for all wheels the same."""
    wheels = "wheel_rad_s" if name.endswith("_rad_s") else "wheel_m_s"
    return wheels if name.startswith("wheel_speed") else name


def _of_scales(mistake: Hypothesis, scales: Mapping[str, object]) -> float:
    """Return the energy of correcting a mistake: the corrected scales should be unit factors."""
    energies = [
        PRIORS["odd scale"] * (is_odd(name, scale * factor) - is_odd(name, scale))
        for name, factor in mistake.factors.items()
        if isinstance(scale := scales.get(name), float | int) and not math.isnan(factor)
    ]
    return sum(energies) / max(len(energies), 1)


@lru_cache(maxsize=CACHED_NAMES)
def is_odd(name: str, scale: float) -> bool:
    """Return whether no unit of a signal has this scale."""
    of_units = units_of(name.removeprefix("truth."))
    units = (1.0, *(f for f, words in of_units if words.startswith("is in") and f not in _TYPICAL))
    return not any(abs(abs(scale) - unit) < 0.01 * unit for unit in units)


def block_gains(reference: FloatArray, measured: FloatArray, blocks: int) -> tuple[float, ...]:
    """Return the gains [at most ``blocks``] of moving blocks; each block's means are removed (bank, bias).

    Parameters
    ----------
    reference, measured : float64 [N], without NaN.
    """
    least, gains = 0.3 * float(reference.std()), []
    for a, b in zip(np.array_split(reference, blocks), np.array_split(measured, blocks), strict=True):
        spread_a, spread_b = float(a.std()), float(b.std())
        if a.size < 2 or min(spread_a - least, spread_b) <= LEAST_DIVISOR:
            continue
        correlation = float(np.mean((a - a.mean()) * (b - b.mean()))) / (spread_a * spread_b)
        if abs(correlation) >= MIN_CORRELATION:
            gains.append(math.copysign(spread_b / spread_a, correlation))
    return tuple(gains) if len(gains) >= 3 else ()
