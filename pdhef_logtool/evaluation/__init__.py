"""Ground truth, metrics, segments and consistency; sees state tracks, never an estimator."""
