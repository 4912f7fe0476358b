"""The sideslip reference: a smoother with kinematics and the linear rear-axle compliance model, without tyre data."""
