"""``python -m pdhef_logtool`` is ``pdhef``."""

from __future__ import annotations

import gc
import os
import sys
from typing import NoReturn

from pdhef_logtool.cli import stopping


def main() -> NoReturn:
    """Run the command line; Ctrl-C is in order from here on, also while its modules are imported."""
    stopping.watch()
    # The objects of modules stay; to search them for cycles after every 700 new ones takes longer than to load some.
    gc.set_threshold(50_000, 20)
    # Otherwise pydantic searches all installed packages for its plug-ins.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "1")
    try:
        from pdhef_logtool.cli import app
    except BaseException as error:
        if (stop := stopping.came()) is None:
            raise
        sys.exit(stopping.tell(stop, error))
    app.main()


if __name__ == "__main__":
    main()
