"""The commented example of a validation plan."""

from __future__ import annotations

import textwrap

from pdhef_logtool.evaluation.segments import SEGMENTS
from pdhef_logtool.evaluation.units import SIGNALS

EXAMPLE = f"""\
# Validation plan of pdhef. Use: pdhef run LOGS -o OUT --plan plan.toml
# Each requirement gets PASS, FAIL or INCONCLUSIVE by the confidence interval of its value over drives
# (below five drives: over blocks of 10 s within them). Exit code 4: a requirement failed.
# signal: {", ".join(SIGNALS)}
{textwrap.fill(", ".join(SEGMENTS), 110, initial_indent="# segment: ", subsequent_indent="# ", break_on_hyphens=False)}
title = "Sideslip of the sedan"

[[requirement]]
id = "SR-1"                        # unique
title = "Sideslip in all driving"
signal = "sideslip_rad"
metric = "rmse"                    # also mae, bias, coverage95, availability, p95_abs, max_abs, ...
limit_deg = 0.5                    # or limit (SI unit), or limit_deg_s for rates
exposure_minutes = 1.0             # less scored driving is INCONCLUSIVE; also exposure_drives, exposure_km
# estimator = "pd-hef"             # default: the selected estimate
# confidence = 0.95                # of the two-sided interval that decides
# exposure = [{{ speed_m_s = [20.0, 35.0], minutes = 10.0 }}]  # conditions: also ay_m_s2, friction, car; drives

[[requirement]]
id = "SR-2"
title = "Sideslip at the limit"
signal = "sideslip_rad"
segment = "nonlinear"              # or manoeuvre = "slalom"
limit_deg = 1.0

[[requirement]]
id = "SR-3"
title = "Better than zero sideslip"
signal = "sideslip_rad"
baseline = "zero"                  # or "physics"; "run": run A of pdhef compare A B --plan; "../before": an output
max_ratio = 0.5                    # the error is at most half of the baseline's

[[requirement]]
id = "SR-4"
title = "No bad drive"
signal = "sideslip_rad"
metric = "p95_abs"
statistic = "worst drive"          # or "quantile 0.9" (of the drives), or "pooled" (default)
limit_deg = 2.0

[[requirement]]
id = "SR-5"
title = "The stated interval contains the ground truth"
signal = "sideslip_rad"
metric = "coverage95"
limit = 0.90                       # a minimum
"""
