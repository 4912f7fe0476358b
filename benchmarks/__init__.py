"""Speed against peers in the same run: ``python -m benchmarks``; the tables behind frozen settings stand here too."""
