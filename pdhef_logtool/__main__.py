"""``python -m pdhef_logtool`` is ``pdhef``."""

from __future__ import annotations

import sys
from typing import NoReturn

from pdhef_logtool.cli import stopping


def main() -> NoReturn:
    """Run the command line; Ctrl-C is in order from here on, also while its modules are imported."""
    stopping.watch()
    try:
        from pdhef_logtool.cli import app
    except BaseException as error:
        if (stop := stopping.came()) is None:
            raise
        sys.exit(stopping.tell(stop, error))
    app.main()


if __name__ == "__main__":
    main()
