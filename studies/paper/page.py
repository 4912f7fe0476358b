"""The text of ``docs/paper.md`` and of its details: every number is computed or from :mod:`studies.paper.published`."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from studies.pages import table, table_rows
from studies.paper import published
from studies.paper.comparison import BOOTSTRAP_DRAWS, LEVEL, Improvement, Spread, spread
from studies.paper.experiment import BURST, BURST_S, GRAVITY_M_S2, A, B
from studies.paper.results import BASELINES, SCENARIOS, Results
from studies.paper.schemes import DRAWN, HYBRID, SCHEMES
from studies.paper.withheld import WITHHELD
from truthsim.manoeuvres import PATH_STEP_M, iso_3888_2_line_m
from truthsim.sensors import SensorNoise
from truthsim.suite import is_held_out

#: Ratios to the paper's figure within which ours counts as the same.
NEAR = (2.0 / 3.0, 1.5)
#: A validation loss at the end above this multiple of its smallest has diverged.
DIVERGED = 1.2
#: From this explained share on the network follows the residual.
FOLLOWED = 0.5
#: From this share on an overshoot counts as one, from this many milliseconds on a lag as another.
OVERSHOT, LATER_MS = 0.02, 5.0
TABLE: tuple[tuple[str, str, str | None], ...] = (
    ("sideslip, deg", "sideslip_deg", "sideslip_relative"),
    ("v_y, m/s", "vy_m_s", "vy_relative"),
    ("yaw rate, rad/s", "yaw_rate_rad_s", "yaw_rate_relative"),
    ("a_y, g", "ay_g", "ay_relative"),
    ("position, m", "position_m", None),
    ("lateral 1 s, m", "lateral_1s_m", None),
    ("lag of sideslip, ms", "sideslip_lag_ms", None),
    ("lag of yaw rate, ms", "yaw_rate_lag_ms", None),
)

#: Figures of the page; the details contain all.
PAGE_FIGURES = ("figure12_sideslip_a.png", "figure16_sideslip_b.png", "figure22_rmse.png")


def number(value: float) -> str:
    """Three significant digits, never in powers of ten."""
    if not math.isfinite(value):
        return "unknown"
    if value == 0.0:
        return "0"
    digits = max(0, 2 - math.floor(math.log10(abs(value))))
    return f"{value:.{digits}f}"


def signed(value: float) -> str:
    """Three significant digits with a sign that is a minus, not a dash."""
    return number(value).replace("-", "−")


def percent(share: float) -> str:
    """A share as a whole number of percent, one decimal below 10 %."""
    if not math.isfinite(share):
        return "unknown"
    return f"{100.0 * share:.{0 if abs(share) >= 0.1 else 1}f} %".replace("-", "−")


def ranged(s: Spread) -> str:
    """Median with smallest and largest."""
    if s.n == 1:
        return signed(s.median)
    return f"{signed(s.median)} ({signed(s.low)} … {signed(s.high)})"


def gain_text(gain: Improvement) -> str:
    """An improvement with its bounds and, with several networks, its range over them."""
    bounds = "" if math.isnan(gain.low) else f" [{percent(gain.low)}, {percent(gain.high)}]"
    networks = ""
    if gain.seeds_high - gain.seeds_low > 1e-9:
        networks = f"; by network {percent(gain.seeds_low)} … {percent(gain.seeds_high)}"
    return f"{percent(gain.value)}{bounds}{networks}"


def judged(gain: Improvement) -> str:
    """What the bounds of an improvement prove."""
    if math.isnan(gain.low):
        return "one drive proves nothing"
    return "better" if gain.proven else "worse" if gain.disproven else "not told apart"


def beside(ours: float, theirs: float) -> tuple[bool, str]:
    """Tell whether a figure is near the paper's, and how it stands to it in words."""
    ratio = ours / theirs
    if NEAR[0] <= ratio <= NEAR[1]:
        return True, f"near the paper's {theirs:.3g}"
    times = f"{number(ratio)} times" if ratio >= 1.0 else f"{percent(ratio)} of"
    return False, f"{times} the paper's {theirs:.3g}"


class Findings:
    """What one of the paper's figures agrees with here, and what does not or cannot."""

    def __init__(self) -> None:
        self.agrees: list[str] = []
        self.cannot: list[str] = []

    def say(self, agrees: bool, text: str) -> None:
        """Put a sentence on the side where it belongs."""
        (self.agrees if agrees else self.cannot).append(text)

    def gain(self, gain: Improvement | None, text: str) -> None:
        """Put an improvement, if there is one, on the side that its bounds prove."""
        if gain is not None:
            self.say(gain.proven, f"{text} {gain_text(gain)} ({judged(gain)})")

    def part(self, title: str, picture: str | None, facts: str) -> str:
        """Return a figure's section: picture, what we find, what agrees, what does not or cannot."""
        image = "" if picture is None else f"\n![{title}]({picture}.png)\n"
        return (
            f"### {title}\n{image}\n{facts}\n\n"
            f"- *Agrees with the paper:* {'; '.join(self.agrees) or 'nothing that can be compared'}.\n"
            f"- *Does not, or cannot:* {'; '.join(self.cannot) or 'nothing found'}.\n"
        )


def _nothing(title: str, facts: str, cannot: str) -> str:
    findings = Findings()
    findings.say(False, cannot)
    return findings.part(title, None, facts)


# ---- the figures ----


def _figure_9(r: Results) -> str:
    title = "Figure 9: convergence of the training"
    if not r.histories:
        return _nothing(title, "The model folders hold no training history.", "no history to compare")
    facts, found = [], Findings()
    ends = []
    for seed, h in sorted(r.histories.items()):
        best, last = float(h.validation_loss.min()), float(h.validation_loss[-1])
        ends.append((float(h.train_loss[-1]), best, last / best))
        facts.append(
            f"seed {seed}: {len(h.epoch)} epochs, training {number(ends[-1][0])}, smallest validation {number(best)}"
        )
    worst = max(e[2] for e in ends)
    if worst <= DIVERGED:
        falls = "the validation loss falls with the training loss and does not diverge"
        found.say(True, f"{falls} (it ends at {number(worst)} times its smallest, at most)")
    else:
        found.say(False, f"the validation loss ends at up to {number(worst)} times its smallest")
    theirs = published.VALIDATION_LOSS / published.TRAIN_LOSS
    ours = [e[1] / e[0] for e in ends]
    found.say(
        False,
        f"the level: the paper does not say what its loss is normalised by; its validation loss of "
        f"{published.VALIDATION_LOSS:g} is {number(theirs)} times its training loss of {published.TRAIN_LOSS:g}, which "
        f"its text calls no overfitting; ours at most {number(max(ours))} times",
    )
    told = "Mean square error over the residual's: " + "; ".join(facts) + "."
    return found.part(title, "figure09_convergence", told)


def _explained(r: Results, scenario: str) -> str:
    words = []
    for row, what in enumerate(("v_y", "yaw rate")):
        shares = [fit.explained(row) for fit in r.fits[scenario]]
        over = percent(shares[0]) if len(shares) == 1 else f"{percent(min(shares))} to {percent(max(shares))}"
        words.append(f"{over} of the residual of {what}")
    return " and ".join(words)


def _figure_10(r: Results) -> str:
    fit = r.fits[A.name][0]
    (target_v, output_v), (target_r, output_r) = fit.noise(0), fit.noise(1)
    facts = (
        f"Scenario A, training seed {r.first_seed}: the residual is what the nominal model misses at the true "
        f"state with the measured steering, bias and noise included (Eq 10). The networks explain "
        f"{_explained(r, A.name)} (1 − error over residual, mean squares)."
    )
    smooth = (
        f"sample-to-sample noise {number(target_v)} → {number(output_v)} m/s² in v_y, "
        f"{number(target_r)} → {number(output_r)} rad/s² in yaw rate"
    )
    found = Findings()
    if output_v < target_v and output_r < target_r:
        found.say(True, f"the network follows the trend and not the noise ({smooth})")
    else:
        found.say(False, f"the network, whose inputs are noisy, is not smoother than the residual ({smooth})")
    least = min(fit.explained(0), fit.explained(1))
    if least > FOLLOWED:
        found.say(True, "it finds the trend of the residual")
    if least <= 0.0:
        found.say(False, "a negative share means that the network is worse than none in this drive")
    found.say(False, "the paper gives no number here")
    return found.part("Figure 10: fit of the residual", "figure10_residual_fit", facts)


def _figure_position(r: Results, scenario: str, title: str, picture: str) -> str:
    lines = []
    for name in DRAWN:
        drift, side = r.spread(scenario, name, "position_m"), r.spread(scenario, name, "lateral_1s_m")
        if drift and side:
            lines.append(f"`{name}` {ranged(drift)} m, after 1 s {ranged(side)} m to the side")
    facts = f"Dead reckoning from the true pose at the start, RMSE of the distance: {'; '.join(lines)}."
    found = Findings()
    gain = r.improvement(scenario, HYBRID, "phy-ukf", "lateral_1s_m")
    found.gain(gain, "the lateral error after 1 s against `phy-ukf`:")
    if scenario == A.name:
        phy, paper = published.PHY_RMSE[scenario, "position_m"], published.RMSE[scenario, "position_m"]
        truth = r.experiment.drives[scenario].truth
        seconds = float(truth.stamps_ns[-1] - truth.stamps_ns[0]) * 1e-9
        bias = SensorNoise().yaw_rate_bias_rad_s
        drift_m = 0.5 * float(np.nanmean(truth.vx_m_s)) * bias * seconds**2
        found.say(
            False,
            f"{phy:g} → {paper:g} m cannot be dead reckoning with this class of gyro: its 1-sigma bias of "
            f"{bias:g} rad/s alone moves the car by {number(drift_m)} m to the side in {number(seconds)} s, which no "
            "filter without a position sensor sees",
        )
        text, own = f"{percent(published.POSITION_IMPROVEMENT)} in its text", percent(1.0 - paper / phy)
        found.say(False, f"the paper's own two figures make {own}, not the {text}")
    else:
        found.say(False, "the paper gives no number for the sweep")
    return found.part(title, picture, facts)


def _against_paper(r: Results, scenario: str, figure: str, unit: str, found: Findings) -> None:
    """Compare our hybrid and ``phy-ukf`` with what the paper says of its own."""
    for name, values in ((HYBRID, published.RMSE), ("phy-ukf", published.PHY_RMSE)):
        s, theirs = r.spread(scenario, name, figure), values.get((scenario, figure))
        if s is None or theirs is None:
            continue
        near, words = beside(s.median, theirs)
        found.say(near, f"`{name}` {number(s.median)} {unit} is {words}")


def _figure_state(
    r: Results, scenario: str, figure: str, unit: str, title: str, picture: str,
    more: Callable[[Results, str, Findings], None],
) -> str:  # fmt: skip
    lines = [f"`{n}` {ranged(s)} {unit}" for n in DRAWN if (s := r.spread(scenario, n, figure))]
    seed = r.experiment.drives[scenario].noise_seed
    facts = f"RMSE: {'; '.join(lines)}. Drawn: noise seed {seed}, training seed {r.first_seed}."
    found = Findings()
    found.gain(r.improvement(scenario, HYBRID, "phy-ukf", figure), f"`{HYBRID}` against `phy-ukf`")
    _against_paper(r, scenario, figure, unit, found)
    more(r, scenario, found)
    return found.part(title, picture, facts)


def _lags(r: Results, scenario: str, figure: str) -> str:
    return ", ".join(f"`{n}` {ranged(s)} ms" for n in DRAWN if (s := r.spread(scenario, n, figure)))


def _later(r: Results, scenario: str, figure: str) -> bool | None:
    """Tell whether ``phy-ukf`` lags more than our hybrid; None where one of them has no lag."""
    phy, ours = (r.spread(scenario, n, figure) for n in ("phy-ukf", HYBRID))
    return None if phy is None or ours is None else abs(phy.median) - abs(ours.median) >= LATER_MS


def _sideslip_notes(r: Results, scenario: str, found: Findings) -> None:
    later = _later(r, scenario, "sideslip_lag_ms")
    if later is not None and scenario == A.name:
        lags = _lags(r, scenario, "sideslip_lag_ms")
        found.say(later, f"the sideslip of `phy-ukf` lags {'' if later else 'hardly '}more: {lags}")
    over = r.spread(scenario, "phy-ukf", "sideslip_overshoot")
    if over and scenario == B.name:
        is_one = over.median > OVERSHOT
        words = "above the true one" if is_one else "from the true one: no overshoot"
        found.say(is_one, f"the largest sideslip of `phy-ukf` is {percent(over.median)} {words}")


def _yaw_rate_notes(r: Results, scenario: str, found: Findings) -> None:
    gyro = r.spread(scenario, "zero:no-lateral", "yaw_rate_rad_s")
    if gyro is not None and scenario == A.name:
        phy, paper = published.PHY_RMSE[scenario, "yaw_rate_rad_s"], published.RMSE[scenario, "yaw_rate_rad_s"]
        if gyro.high < min(phy, paper):
            whole = f"the gyro passed through, delay and all, has {ranged(gyro)} rad/s"
            found.say(False, f"{phy:g} → {paper:g} rad/s is implausible: {whole}")
    own = r.spread(scenario, HYBRID, "yaw_rate_rad_s")
    if gyro is not None and own is not None:
        better = own.median < gyro.median
        both = f"({number(own.median)} and {number(gyro.median)} rad/s)"
        found.say(better, f"`{HYBRID}` is {'' if better else 'no '}better than the gyro {both}")
    if scenario == A.name:
        later = _later(r, scenario, "yaw_rate_lag_ms")
        if later is not None:
            lags = _lags(r, scenario, "yaw_rate_lag_ms")
            found.say(later, f"the paper sees severe hysteresis in Phy-UKF; lag of yaw rate: {lags}")


def _ay_notes(r: Results, scenario: str, found: Findings) -> None:
    if scenario == A.name:
        lstm = r.spread(scenario, "pure-lstm", "ay_overshoot")
        if lstm is not None:
            text = f"the largest a_y of `pure-lstm` is {percent(lstm.median)} from the true one"
            found.say(lstm.median < -OVERSHOT, text)
        return
    over, size = r.spread(scenario, "open-loop", "ay_overshoot"), r.spread(scenario, "open-loop", "ay_relative")
    if over is not None and size is not None:
        text = (
            f"the open-loop nominal model's largest a_y is {percent(over.median)} from the true one and its RMSE "
            f"{percent(size.median)} of the true RMS, where the paper claims offsets above "
            f"{percent(published.OPEN_LOOP_AY_OFFSET)}"
        )
        found.say(max(abs(over.median), size.median) > published.OPEN_LOOP_AY_OFFSET, text)
    gyro = r.spread(scenario, "zero:no-lateral", "ay_g")
    if gyro is not None:
        found.say(False, f"the accelerometer passed through, which reads body roll too, has {ranged(gyro)} g")


def _figure_19(r: Results) -> str:
    fits = r.fits[B.name]
    low, high = min(f.increments(1)[0] for f in fits), max(f.increments(1)[1] for f in fits)
    low_a = min(f.increments(1)[0] for f in r.fits[A.name])
    high_a = max(f.increments(1)[1] for f in r.fits[A.name])
    step = fits[0].step_s
    truth = r.experiment.drives[A.name].truth
    largest = float(np.nanmax(np.abs(np.gradient(truth.yaw_rate_rad_s, truth.stamps_ns * 1e-9))))
    asked = max(abs(v) for v in published.NETWORK_OUTPUT_RAD_S) / step
    facts = (
        f"Scenario B, training seed {r.first_seed}; the networks explain {_explained(r, B.name)}, and in A "
        f"{_explained(r, A.name)}. Increments of yaw rate over a {1e3 * step:.0f} ms step: {signed(low)} … "
        f"{signed(high)} rad/s in B, {signed(low_a)} … {signed(high_a)} rad/s in A; as rates "
        f"{signed(low_a / step)} … {signed(high_a / step)} rad/s² in A."
    )
    lags = [f.lag_ms(1) for f in fits if math.isfinite(f.lag_ms(1))]
    found = Findings()
    if min(f.explained(1) for f in fits) > FOLLOWED:
        found.say(True, "the output is no random noise but follows the residual")
    else:
        found.say(False, "the output explains less than half of the yaw-rate residual")
    if lags:
        middle = f"its lag behind the residual is {signed(float(np.median(lags)))} ms (median over the networks)"
        found.say(max(map(abs, lags)) <= 1e3 * step, middle)
    theirs_low, theirs_high = published.NETWORK_OUTPUT_RAD_S
    text = (
        f"−{-theirs_low:g} … {theirs_high:g} rad/s as an increment of one step would be a missing yaw "
        f"acceleration of {number(asked)} rad/s²; the largest true yaw acceleration in A is {number(largest)} rad/s²"
    )
    found.say(False, text if asked > 0.5 * largest else text.replace("; the", ", possible as the"))
    return found.part("Figure 19: verification of the learned residual", "figure19_residual_verification", facts)


def _figure_20(r: Results) -> str:
    title = "Figure 20: bottom layer, adaptation of R in a noise burst"
    shown = [n for n in ("phy-ukf", "pd-hef:fixed-r", "pd-hef-paper", "pd-hef") if n in r.ran]
    pairs = [
        f"`{n}` {ranged(clean)} → {ranged(burst)}"
        for n in shown
        if (clean := r.spread(A.name, n, "sideslip_deg")) and (burst := r.spread(BURST.name, n, "sideslip_deg"))
    ]
    facts = (
        f"Scenario A with {BURST.faults[0].split(':')[0].removeprefix('burst')} times the noise on the whole IMU from "
        f"{BURST_S[0]:g} to {BURST_S[1]:g} s. Sideslip RMSE without → with the burst, deg: {'; '.join(pairs)}."
    )
    theirs = published.R_NORM[1] / published.R_NORM[0]
    found = Findings()
    for name, i in r.inflations.items():
        rise = i.within / i.before
        text = f"R of a_y in `{name}` rises by a factor of {number(rise)} (paper: {number(theirs)})"
        found.say(rise > 3.0, text)
        rest = f"at the same time of the drive without a burst it reaches {number(i.without_burst)} times R_0"
        quiet = i.without_burst <= 1.5
        found.say(quiet, rest + (", quiet where there is no noise" if quiet else ": model error is read as noise"))
    for name in (n for n in ("pd-hef-paper", HYBRID) if n in r.inflations):
        gain = r.improvement(BURST.name, name, "pd-hef:fixed-r")
        found.gain(gain, f"sideslip of `{name}` in the burst against fixed R:")
    if not r.inflations:
        found.say(False, "no scheme of this run adapts R")
    return found.part(title, "figure20_noise_adaptation", facts)


def _figure_21(r: Results) -> str:
    title = "Figure 21: top layer, trust in the network over |a_y|"
    if not any(r.curves.values()):
        return _nothing(title, "No scheme of this run moves its trust.", "nothing to compare")
    low, high = published.TRUST
    facts, found = [], Findings()
    for scenario, curves in r.curves.items():
        for name, c in curves.items():
            facts.append(
                f"`{name}` in {scenario}: median β {number(float(c.median[0]))} in the lowest bin, "
                f"{number(float(c.median[-1]))} in the highest, mean {number(float(c.trust.mean()))}, "
                f"{number(float(c.trust.min()))} … {number(float(c.trust.max()))} overall"
            )
            if name != "pd-hef-paper":
                continue
            bottom, top = float(c.median[0]), float(c.median[-1])
            rises = top > bottom
            rising = f"β {'rises' if rises else 'does not rise'} with |a_y|"
            found.say(rises, f"{rising} in {scenario} ({number(bottom)} → {number(top)})")
            if top < high - 0.1:
                rule = published.TRUST_BY_INTENSITY
                why = f"; {rule:g} is Table 2's for a large I_dyn with a small E_ay" if abs(top - rule) < 0.05 else ""
                found.say(False, f"it does not come to {high:g} in {scenario}{why}")
    found.say(False, f"the paper shows {low:g} → {high:g} without saying where its membership functions lie")
    return found.part(title, "figure21_trust", "; ".join(facts) + ".")


def _figure_22(r: Results) -> str:
    found = Findings()
    for scenario in (A.name, B.name):
        for baseline in ("phy-ukf", "phy-ukf:tuned", "physics"):
            gain = r.improvement(scenario, HYBRID, baseline)
            if gain is not None:
                text = f"sideslip in {scenario} against `{baseline}` {gain_text(gain)}"
                found.say(gain.low > published.IMPROVEMENT, text)
    facts = (
        "Bars: median over all seeds; thin lines: smallest and largest; dotted: the paper's PD-HEF where it gives one. "
        f"The paper claims more than {percent(published.IMPROVEMENT)} against traditional observers; here that counts "
        "as met only where the lower bound is above it."
    )
    return found.part("Figure 22: RMSE", "figure22_rmse", facts)


def _figure_23(r: Results) -> str:
    title = "Figure 23: time of a step"
    head = ("scheme", "µs a step, median", "fastest … slowest round")
    rows = [(f"`{n}`", number(t.median_us), f"{number(t.low_us)} … {number(t.high_us)}") for n, t in r.times.items()]
    found = Findings()
    own, phy = r.times.get(HYBRID), r.times.get("phy-ukf")
    if own is not None:
        share = own.median_us / (1e3 * published.CYCLE_MS)
        found.say(share < 1.0, f"`{HYBRID}` takes {percent(share)} of a {published.CYCLE_MS:g} ms cycle")
    if own is not None and phy is not None:
        theirs = published.STEP_MS["pd-hef"] / published.STEP_MS["phy-ukf"]
        near, words = beside(own.median_us / phy.median_us, theirs)
        text = f"the hybrid costs {number(own.median_us / phy.median_us)} times `phy-ukf`, {words}"
        found.say(near, text)
    found.say(
        False,
        f"{published.STEP_MS['phy-ukf']:g} and {published.STEP_MS['pd-hef']:g} ms are MATLAB on another processor, one "
        "step at a time; ours is compiled code over a whole log, the network in one pass",
    )
    facts = (
        "Processor seconds of one thread over the steps of scenario B, all schemes in turns in one run. These numbers "
        "are the only ones in this page that change when it is made again.\n\n" + table(head, rows)
    )
    return found.part(title, "figure23_step_time", facts)


# ---- the page ----


def _result_table(r: Results, scenario: str) -> str:
    rows = []
    for scheme in r.ran:
        cells = [f"`{scheme}`"]
        for _, figure, relative in TABLE:
            s = r.spread(scenario, scheme, figure)
            share = None if relative is None else r.spread(scenario, scheme, relative)
            cells.append("–" if s is None else ranged(s) + ("" if share is None else f" · {percent(share.median)}"))
        rows.append(cells)
    return table(("scheme", *(head for head, _, _ in TABLE)), rows)


def _withheld(r: Results) -> str:
    """Say what training held, and what is left where it held neither manoeuvre."""
    if r.withheld is None or r.without is None:
        return ""
    held = ", ".join(f"{n} {m}" for m, n in sorted(r.withheld.drives.items(), key=lambda item: -item[1]))
    rows = []
    unseen = f"`{HYBRID}`, its network trained without them"
    for shown, scheme, source in (
        ("`physics`", "physics", r.experiment),
        (f"`{HYBRID}`", HYBRID, r.experiment),
        (unseen, HYBRID, r.without),
    ):
        found = [spread(source, s.name, scheme, "sideslip_deg") for s in (A, B)]
        rows.append([shown, *("–" if s is None else ranged(s) for s in found)])
    return f"""### What training held

The figures of this page are of networks that saw the shipped car, on other drives: {held}. The same training
without {", ".join(f"`{m}`" for m in WITHHELD)} (trust {r.withheld.car.allowed_trust.cap:g} by the same evidence)
gives, sideslip in degrees:

{table(("scheme", "A", "B"), rows)}

"""


def _gain_table(r: Results) -> str:
    rows = []
    for scenario in SCENARIOS:
        for baseline in BASELINES:
            cells = [scenario.name, f"`{baseline}`"]
            wanted = ("sideslip_deg", "yaw_rate_rad_s", "ay_g", "lateral_1s_m")
            gains = [r.improvement(scenario.name, HYBRID, baseline, f) for f in wanted]
            if baseline != HYBRID and any(gains):
                rows.append([*cells, *("–" if g is None else f"{gain_text(g)} · {judged(g)}" for g in gains)])
    return table(("scenario", "against", "sideslip", "yaw rate", "a_y", "lateral 1 s"), rows)


def _conditions(r: Results) -> str:
    lines = []
    for s in SCENARIOS:
        facts = [f for f in r.experiment.facts if f["scenario"] == s.name]
        peak, slip = (max(float(str(f[k])) for f in facts) for k in ("peak_ay_g", "peak_sideslip_deg"))
        fault = f", with `{', '.join(s.faults)}`" if s.faults else ""
        held = "" if not is_held_out(s.manoeuvre, s.speed_km_h, s.friction) else ", a cell held out of training suites"
        lines.append(
            f"- **{s.name}**: {s.title} (`{s.manoeuvre}`), {s.speed_km_h:g} km/h, μ {s.friction:g}{fault}; "
            f"{facts[0]['duration_s']:g} s, |a_y| up to {number(peak)} g, sideslip up to {number(slip)}°{held}."
        )
    return "\n".join(lines)


def _trust_note(r: Results) -> str:
    """Say at which trust the hybrid filters with a fixed one ran: a vehicle file may cap it."""
    track = r.experiment.tracks.get((A.name, "pd-hef:fixed-r"))
    if track is None:
        return "No hybrid filter with fixed trust ran."
    return f"`pd-hef:fixed-r` ran at a trust of {float(np.nanmax(track.network_trust)):g} in the network."


def _impossible_course() -> str:
    line = np.array(iso_3888_2_line_m())
    curvature = float(np.abs(np.diff(line, n=2)).max()) / PATH_STEP_M**2
    speed = published.DLC_SPEED_KM_H / 3.6
    return number(curvature * speed**2 / GRAVITY_M_S2)


def _sensors() -> str:
    n = SensorNoise()
    return (
        f"white noise (Student-t, 4 degrees of freedom) of {n.acceleration_m_s2:g} m/s², {n.yaw_rate_rad_s:g} rad/s, "
        f"{n.steer_rad:g} rad at the wheels and {n.wheel_speed_m_s:g} m/s; biases, drawn for each drive, of 1-sigma "
        f"{n.acceleration_bias_m_s2:g} m/s², {n.yaw_rate_bias_rad_s:g} rad/s and {n.steer_bias_rad:g} rad, and "
        f"{percent(n.wheel_scale)} in the scale of wheel speeds; a slow walk; {1e3 * n.can_delay_s:g} ms delay on "
        "everything."
    )


#: Figure of the tables, unit, name, part of the picture's file name, and what else there is to say.
_STATES = (
    ("sideslip_deg", "deg", "sideslip", "sideslip", _sideslip_notes),
    ("yaw_rate_rad_s", "rad/s", "yaw rate", "yaw_rate", _yaw_rate_notes),
    ("ay_g", "g", "lateral acceleration", "ay", _ay_notes),
)


def write_details(r: Results) -> str:
    """Return what was run, all tables, and each figure of the paper beside ours."""
    seeds = sorted({run.noise_seed for run in r.experiment.runs})
    latency = max(abs(float(str(f["truth_latency_ms"]))) for f in r.experiment.facts)
    missing = [f"- `{name}`: {reason}." for name, reason in r.experiment.missing.items()]
    networks = "; ".join(
        f"seed {seed} `{n.sha256[:12]}` ({len(n.feature_names)} features, {n.layers} × {n.hidden})"
        for seed, n in r.networks.items()
    )
    figures = [_figure_9(r), _figure_10(r)]
    for scenario, letter, first, words in ((A.name, "a", 11, "double lane change"), (B.name, "b", 15, "sine sweep")):
        place = f"figure{first}_position_{letter}"
        figures.append(_figure_position(r, scenario, f"Figure {first}: position, {words}", place))
        for i, (figure, unit, name, file, notes) in enumerate(_STATES, start=first + 1):
            title, place = f"Figure {i}: {name}, {words}", f"figure{i}_{file}_{letter}"
            figures.append(_figure_state(r, scenario, figure, unit, title, place, notes))
    figures += [_figure_19(r), _figure_20(r), _figure_21(r), _figure_22(r), _figure_23(r)]
    what = "\n".join(f"- `{n}`: {SCHEMES[n]}." for n in r.ran)
    left_out = "\nNot in this run:\n\n" + "\n".join(missing) + "\n" if missing else ""
    return f"""# Details of the paper's experiment

Written by `make paper` (`python -m studies.paper`). `results.json` contains the numbers.

## What was run

{_conditions(r)}

The paper calls A an ISO 3888-2 course at {published.DLC_SPEED_KM_H:g} km/h. There even the line of least curvature
through the lanes asks for {_impossible_course()} g, so A is the ISO 3888-1 course with its offset scaled to
{published.DLC_PEAK_G:g} g.

Sensors: {_sensors()} {len(seeds)} noise {"seed" if len(seeds) == 1 else "seeds"} ({seeds[0]} to {seeds[-1]}),
{len(r.cars)} training {"seed" if len(r.cars) == 1 else "seeds"}. The latency taken off the truth is what the gyro
says: at most {number(latency)} ms.

**Friction is known**: each scheme gets the friction of the drive through the car's file. Vehicle: {r.car.vehicle.name}.
Networks: {networks}.

Schemes:

{what}
{left_out}
{_trust_note(r)}

## Results

Median (smallest … largest) over noise seeds and, where a network is at work, training seeds; after the dot, RMSE over
the RMS of the truth. `position` is dead reckoning over the whole drive, `lateral 1 s` the lateral error one second
after the true pose; a lag above 0 is late.

### A: {A.title}

{_result_table(r, A.name)}

### B: {B.title}

{_result_table(r, B.name)}

### A with a noise burst

{_result_table(r, BURST.name)}

{_withheld(r)}### `{HYBRID}` against the others

By how much its RMSE, pooled over the seeds, is lower; in brackets the {percent(LEVEL)} bounds of a bootstrap that
draws noise seeds in pairs ({BOOTSTRAP_DRAWS} draws of {len(seeds)}; so few make the bounds rather too narrow). Each
scenario is one manoeuvre with other sensor errors: this says nothing about other manoeuvres.

{_gain_table(r)}

## The paper's figures

Time histories show `phy-ukf`, `pure-lstm` and `{HYBRID}`, where this version has them. A figure counts as the paper's
where it lies within {percent(NEAR[0])} and {percent(NEAR[1])} of it; a scheme as better where both bounds say so.

{chr(10).join(figures)}"""


def write_page(details: str) -> str:
    """Return the page: the scenarios and the sideslip errors of the details, and three figures."""
    tables = table_rows(details)
    scenarios = [name for name in tables if name.startswith(("A", "B"))]
    errors = [{row[0]: row[1] for row in tables[name]} for name in scenarios]
    body = [[scheme, *(column.get(scheme, "–") for column in errors)] for scheme in errors[0]]
    gains = next(rows for name, rows in tables.items() if name.endswith("against the others"))
    run = details[details.index("- **A**") : details.index("Sensors:")].rstrip()
    return PAGE.format(
        run=run,
        errors=table(["scheme", *scenarios], body),
        gains=table(["scenario", "against", "lower sideslip RMSE"], [row[:3] for row in gains]),
    )


PAGE = """# The paper's experiment

This page shows the experiment of the paper, repeated with our estimators on our simulator. Command: `make paper`.

Paper: Zhou et al., *Physics-Driven Hybrid Framework for Vehicle State Estimation Using Residual Learning and Adaptive
UKF*, Appl. Sci. 2026, 16(9), 4230. The paper uses CarSim and MATLAB, this page uses `truthsim`
([simulated car](truthsim.md)). Therefore the order of the schemes is comparable, the level of the errors is not.

{run}

Sideslip RMSE in degrees: median (smallest … largest) over noise seeds and training seeds; after the dot, relative to
the RMS of the true sideslip. All schemes get the true friction.

{errors}

![Sideslip, double lane change](paper/figure12_sideslip_a.png)

![Sideslip, sine sweep](paper/figure16_sideslip_b.png)

Reduction of the sideslip RMSE by `pd-hef`, pooled over seeds, with the 95 % CI of a bootstrap over noise seeds, and the
range over networks:

{gains}

![RMSE](paper/figure22_rmse.png)

`studies/results/paper/details.md` compares each figure of the paper with ours, and contains yaw rate, lateral
acceleration, position, lags and step times. `results.json` in the same folder contains all numbers.
"""
