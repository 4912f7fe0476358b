"""Published estimators of sideslip, one per file, with the constants of their publications; ``--estimators peers``."""
