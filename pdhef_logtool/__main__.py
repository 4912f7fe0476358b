"""``python -m pdhef_logtool`` is ``pdhef``."""

import atexit
import gc
import os
import sys
import threading
from typing import NoReturn

from pdhef_logtool.cli import stopping


def main() -> NoReturn:
    """Run the command line; Ctrl-C is in order from here on, also while its modules are imported."""
    stopping.watch()
    # The objects of modules stay; to search them for cycles after every 700 new ones takes longer than to load some.
    gc.set_threshold(250_000, 20)
    # Otherwise pydantic searches all installed packages for its plug-ins.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "1")
    try:
        from pdhef_logtool.cli import app
    except BaseException as error:
        if (stop := stopping.came()) is None:
            raise
        sys.exit(stopping.tell(stop, error))
    try:
        app.main()
    except SystemExit as end:
        if threading.active_count() > 1 or not isinstance(end.code, int) or sys.getprofile() is not None:
            raise
        # To take all modules apart, as the interpreter does at its end, takes a tenth of a short command.
        atexit._run_exitfuncs()
        sys.stderr.flush()
        os._exit(end.code)


if __name__ == "__main__":
    main()
