"""The ``njit`` of the package: machine code is cached in a writable folder, and a cache error never ends a run.

Numba raises an error if no folder is writable, if a cache file is truncated and if the disk is full. This cache uses
the first writable folder of ``NUMBA_CACHE_DIR``, the installation, the user's cache and a private temporary folder;
without any, every run compiles. The code of a read-only installation is copied to that folder.

In each place, the code is in a folder that is named after the digest of all sources (:mod:`~.sources`). The first
process with a new digest removes the folders of other sources of this installation.
"""

import contextlib
import functools
import hashlib
import os
import re
import shutil
import stat
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numba
from numba.core import caching, config
from numba.core.runtime import rtsys
from numba.core.types.misc import unliteral
from numba.extending import overload
from numba.misc.appdirs import AppDirs
from numba.np import arrayobj, linalg

from pdhef_logtool.compiled import sources
from pdhef_logtool.records import processes
from pdhef_logtool.records.printable import printable

#: Typical time to compile everything, s, for the note to the user.
COMPILING_S = 40


def _without_blas() -> None:
    """Let numba load without SciPy's BLAS, which takes longer than a short log and is not needed here.

    Functions that need LAPACK, such as the repair of a covariance, load it when they are called.
    """

    def none() -> None:
        raise ImportError

    original = linalg.ensure_blas
    linalg.ensure_blas = none
    try:
        from numba.np import arraymath
    finally:
        linalg.ensure_blas = original
    arraymath.ensure_blas = original


def _sizes_differ(_given: Any, _expected: Any) -> None:
    """Placeholder of the function that numba calls if an array is assigned to a slice of another shape."""


@overload(_sizes_differ)  # type: ignore[untyped-decorator]
def _raise_that_sizes_differ(_given: Any, _expected: Any) -> Any:
    def raising(_given: Any, _expected: Any) -> None:
        raise ValueError("cannot assign slice from input of different size")

    return raising


_without_blas()
# Numba's function writes both shapes into the message: compiling its text functions takes a sixth of all compiling.
arrayobj.raise_with_shape_context = _sizes_differ


def njit(function: Any = None, *, cache: bool = False, **options: Any) -> Any:
    """Compile a function as ``numba.njit`` does; ``cache`` keeps its machine code as described above.

    Functions that compiled code alone calls need no wrapper for Python (``no_cpython_wrapper``), which takes long to
    compile for records of numbers.
    """
    if function is None:
        return functools.partial(njit, cache=cache, **options)
    options.setdefault("no_cpython_wrapper", bool(options.get("forceinline")))
    # Estimators run side by side in threads (runs/estimating.py).
    compiled = numba.njit(function, no_cfunc_wrapper=True, nogil=True, **options)
    if cache and not config.DISABLE_JIT:
        # A call with a constant is one with a number: numba would compile the function for each value again.
        resolve = compiled.get_call_template
        compiled.get_call_template = lambda args, named: resolve([unliteral(a) for a in args], named)
        if (folder := kept_in()) is None:
            announce()
        else:
            compiled._cache = _Cache(function, folder)
            _kept.append(compiled)
    return compiled


# Without reference counts, which are slow: these functions create no arrays. Divisors are not checked, which would be a
# branch; a·b + c may be one instruction.
_without_arrays = functools.partial(njit, error_model="numpy", fastmath={"contract"}, _nrt=False)
kernel = _without_arrays(cache=True)
#: A kernel that compiled code alone calls.
inner_kernel = _without_arrays(cache=True, no_cpython_wrapper=True)
inline = _without_arrays(forceinline=True)

#: The cached functions of the modules imported so far.
_kept: list[Any] = []


def load_kept() -> bool:
    """Load all cached machine code, for forked processes; return whether there is any."""
    for function in _kept:
        for signature in function._cache.signatures(function.targetctx.codegen()):
            function.compile(signature)
    return any(function.signatures for function in _kept)


def _installed() -> Path:
    """Return the folder for machine code within the installation."""
    return sources.ROOT / "pdhef_logtool/__pycache__/compiled" / sources.compiled_digest()


def _places() -> Iterator[Path]:
    """Yield the cache folders of this installation, in the order of preference."""
    # Several installations may share the other places.
    name = f"pdhef_logtool_{hashlib.sha256(os.fsencode(sources.ROOT)).hexdigest()[:16]}"
    if config.CACHE_DIR:
        yield Path(config.CACHE_DIR) / name
    yield _installed().parent
    yield Path(AppDirs(appname="numba", appauthor=False).user_cache_dir) / name
    if private := _private_folder():
        yield private / name


@functools.cache
def kept_in() -> Path | None:
    """Return the folder of the machine code; None without a writable one."""
    for place in _places():
        folder = place / sources.compiled_digest()
        is_new = not folder.is_dir()
        if _writable(folder):
            if is_new:
                _remove_stale(place)
                if _installed().is_dir() and folder != _installed():
                    shutil.copytree(_installed(), folder, dirs_exist_ok=True)
            return folder
    return None


def _remove_stale(place: Path) -> None:
    """Remove the code of other sources in a place and in the installation, as far as these are writable."""
    digest = sources.compiled_digest().partition("-")[0]
    for folder in [*place.glob("*"), *_installed().parent.glob("*")]:
        if re.fullmatch("[0-9a-f]{16}-[0-9a-f]{8}", folder.name) and not folder.name.startswith(digest):
            shutil.rmtree(folder, ignore_errors=True)


def _private_folder() -> Path | None:
    """Return a temporary folder that only this user can write, because its code is executed; None if that fails.

    It has the same name in every process of the user, so that workers and later runs find it.
    """
    if not hasattr(os, "getuid"):  # such systems have one temporary folder per user
        return Path(tempfile.gettempdir()) / "pdhef-compiled"
    with contextlib.suppress(OSError):
        folder = Path(tempfile.gettempdir()) / f"pdhef-compiled-{os.getuid()}"
        with contextlib.suppress(FileExistsError):
            folder.mkdir(mode=0o700)
        status = folder.lstat()
        if stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid() and not status.st_mode & 0o077:
            return folder
    return None


def _writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True


class _Cache(caching.FunctionCache):  # type: ignore[misc]
    """Numba's cache of one function in a folder."""

    def __init__(self, function: Any, folder: Path) -> None:
        usual, config.CACHE_DIR = config.CACHE_DIR, str(folder)
        try:
            super().__init__(function)
        finally:
            config.CACHE_DIR = usual
        # The folder names the digest of all sources: their place and time do not matter.
        self._impl.locator._cache_path = self._cache_path = str(folder / function.__module__)
        self._cache_file = caching.IndexDataCacheFile(self._cache_path, self._impl.filename_base, "")

    def load_overload(self, signature: Any, context: Any) -> Any:
        overload = None
        try:
            # Numba's method declares every function that new code can call; cached code needs its runtime only.
            rtsys.initialize(context)
            overload = self._load_overload(signature, context)
        except Exception:  # noqa: BLE001 (any error of a pickle that was cut short)
            with contextlib.suppress(OSError):
                self.flush()
        if overload is None:
            announce()
        return overload

    def save_overload(self, signature: Any, result: Any) -> None:
        # Two processes may use one number for the code of different arguments: the name contains the process id, too.
        self._cache_file._data_name_pattern = f"{self._impl.filename_base}.{os.getpid()}-{{number}}.nbc"
        with contextlib.suppress(OSError):  # a full disk: the next run compiles again
            super().save_overload(signature, result)

    def signatures(self, codegen: Any) -> list[Any]:
        """Return the signatures with cached code for this processor."""
        try:
            index = self._cache_file._load_index()
        except Exception:  # noqa: BLE001 (any error of a pickle that was cut short)
            return []
        return [key[0] for key in index if key == self._index_key(key[0], codegen)]


#: Whether the note about compiling was printed.
announced = False


def announce() -> None:
    """Print a note on stderr, once, that compiling begins; of several workers only the first, none with ``--quiet``."""
    global announced
    if announced or processes.worker_number > 1 or processes.quiet:
        return
    announced, folder = True, kept_in()
    if folder is None:
        text = f"compiling, about {COMPILING_S} s in every run: there is no folder to keep the code in"
    else:
        text = f"compiling, once, about {COMPILING_S} s; the code is kept in {printable(str(folder))}"
    sys.stderr.write(f"{text}\n")
    sys.stderr.flush()
