"""``python -m pdhef_logtool`` is ``pdhef``."""

from __future__ import annotations

from pdhef_logtool.cli.app import main

if __name__ == "__main__":
    main()
