"""Published values, with their section; the only figures in the page that are not computed here."""

from __future__ import annotations

#: RMSE of the paper's PD-HEF by scenario and figure (section 5.5.1).
RMSE = {
    ("A", "sideslip_deg"): 0.033,
    ("A", "yaw_rate_rad_s"): 0.026,
    ("A", "position_m"): 0.008,
    ("B", "sideslip_deg"): 0.08,
    ("B", "ay_g"): 0.025,
}
#: RMSE of the paper's Phy-UKF (section 5.5.1).
PHY_RMSE = {("A", "yaw_rate_rad_s"): 0.068, ("A", "position_m"): 0.025, ("B", "sideslip_deg"): 0.26}
#: "reduces the root mean square error by over 60 % compared to traditional observers" (abstract).
IMPROVEMENT = 0.60
#: Milliseconds a step (section 5.5.2): Phy-UKF from "increased by about 2.1 ms".
STEP_MS = {"phy-ukf": 1.9, "pd-hef": 4.0}
#: β from the linear region to the limit (section 5.4.3).
TRUST = (0.1, 0.9)
#: Norm of R before and in the disturbance (section 5.4.2).
R_NORM = (0.1, 3.5)
#: Network output in rad/s (section 5.4.1).
NETWORK_OUTPUT_RAD_S = (-0.03, 0.04)
#: Training and validation loss after 150 epochs (section 5.2), and the cycle of a controller (section 5.5.2).
LOSSES, CYCLE_MS = (1e-3, 0.05), 10.0
#: Peak |a_y| of the double lane change (section 5.3.1), and its speed.
DLC_PEAK_G, DLC_SPEED_KM_H = 0.7, 100.0
