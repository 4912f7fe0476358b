"""What looks at signals and estimates beside the estimators: faults, slip, divergence, intervals."""
