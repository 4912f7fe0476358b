"""Pages of a finished run: whole files that need no network, drawn from the run's own outputs."""
