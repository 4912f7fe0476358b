"""The sideslip reference: a smoother over kinematics and the linear law of the rear axle, without tyre data."""
