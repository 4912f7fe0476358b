"""The paper's fuzzy scheduler: residual gain from two indicators of model error (Eq 24, 25, Table 2).

Inputs are E_ay = |a_y,m − a_y,nom| and I_dyn = |a_y,m| / (μ g), each with three overlapping sets. The paper provides
only Table 2; docs/method.md#paper-adaptation defines the sets: triangles with shoulders, between the tops that the
caller chooses. The strength of a rule is the smaller of its two memberships (Mamdani's AND); the output is the mean of
the rules' singletons weighted by strength, which is the centre of gravity of singletons.
"""

import math

from pdhef_logtool.compiled.cache import njit

#: Table 2: rows I_dyn small, medium, large; columns E_ay small, medium, large.
RULES = ((0.1, 0.2, 0.3), (0.3, 0.5, 0.7), (0.5, 0.8, 0.9))
#: Residual gain without inputs: the rule for undisturbed driving.
NOMINAL_TRUST = RULES[0][0]


@njit(cache=True)
def memberships(value, tops):  # type: ignore[no-untyped-def]
    """Return the memberships of ``value`` in small, medium and large, each in [0, 1] with sum 1."""
    low, middle, high = tops
    small = min(1.0, max(0.0, (middle - value) / (middle - low)))
    large = min(1.0, max(0.0, (value - middle) / (high - middle)))
    return small, 1.0 - small - large, large


@njit(cache=True)
def fuzzy_trust(deviation_m_s2, intensity, deviation_tops_m_s2, intensity_tops):  # type: ignore[no-untyped-def]
    """Return β in [0.1, 0.9] for non-negative E_ay in m/s² and I_dyn; NaN for NaN.

    The tops are those of the sets small, medium and large of both inputs.
    """
    if not (math.isfinite(deviation_m_s2) and math.isfinite(intensity)):
        return math.nan
    columns = memberships(deviation_m_s2, deviation_tops_m_s2)
    rows = memberships(intensity, intensity_tops)
    total = strengths = 0.0
    for i in range(3):
        for j in range(3):
            strength = min(rows[i], columns[j])
            total += strength * RULES[i][j]
            strengths += strength
    return total / strengths
