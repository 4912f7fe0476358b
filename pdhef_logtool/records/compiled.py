"""The one ``njit`` of the package: machine code is kept where this user can keep it, and no cache can end a run.

Numba looks for a folder when a function is decorated and refuses where it finds none; a file in its cache that is cut
short, or a full disk, ends the call. Here the first folder that can be written takes the code: that of
``NUMBA_CACHE_DIR``, the installation's, the user's, a private temporary one; else none, and every run compiles. What
lies in the installation is used where nobody can write it, too.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import inspect
import os
import stat
import sys
import tempfile
from pathlib import Path
from typing import Any

import numba
from numba.core import caching, config
from numba.extending import overload
from numba.misc.appdirs import AppDirs
from numba.np import arrayobj, linalg

from pdhef_logtool.records import processes
from pdhef_logtool.records.shown import shown

#: What the first run with all estimators compiles on one core, in seconds; told to the user as a rough figure.
COMPILING_S = 45


def _without_blas() -> None:
    """Let numba load without SciPy's BLAS, which takes longer than a short log: nothing compiled here asks for it.

    What needs LAPACK, such as the repair of a covariance, loads that when it is called.
    """

    def none() -> None:
        raise ImportError

    found = linalg.ensure_blas
    linalg.ensure_blas = none
    try:
        from numba.np import arraymath
    finally:
        linalg.ensure_blas = found
    arraymath.ensure_blas = found


def _sizes_differ(_given: Any, _expected: Any) -> None:
    """Stand for what numba calls where an array is assigned to a slice of another shape."""


@overload(_sizes_differ)  # type: ignore[untyped-decorator]
def _raise_that_sizes_differ(_given: Any, _expected: Any) -> Any:
    def raising(_given: Any, _expected: Any) -> None:
        raise ValueError("cannot assign slice from input of different size")

    return raising


_without_blas()
# Numba's own writes both shapes into the message, and compiles its text functions for that: a sixth of all compiling.
arrayobj.raise_with_shape_context = _sizes_differ


def njit(function: Any = None, *, cache: bool = False, **options: Any) -> Any:
    """Compile a function as ``numba.njit`` does; ``cache`` keeps its machine code as said above."""
    if function is None:
        return functools.partial(njit, cache=cache, **options)
    compiled = numba.njit(function, **options)
    if cache and not config.DISABLE_JIT:
        compiled._cache = _Cache(function)
        _kept.append(compiled)
    return compiled


#: The functions of the modules imported so far whose machine code is kept.
_kept: list[Any] = []


def load_kept() -> bool:
    """Load all machine code that is kept for them, for the processes that are forked from this one; tell if any is."""
    for function in _kept:
        codegen = function.targetctx.codegen()
        for signature in function._cache.signatures(codegen):
            function.compile(signature)
    return any(function.signatures for function in _kept)


@functools.cache
def kept_in(folder: Path) -> Path | None:
    """Return where the machine code of the modules in ``folder`` is kept; None: nowhere."""
    # The name is numba's own, so that what lies there already serves.
    name = f"{folder.name}_{hashlib.sha1(os.fsencode(folder)).hexdigest()}"  # noqa: S324
    user = AppDirs(appname="numba", appauthor=False).user_cache_dir
    given = [Path(config.CACHE_DIR) / name] if config.CACHE_DIR else []
    for place in (*given, folder / "__pycache__", Path(user) / name):
        if _writable(place):
            return place
    private = _private_folder()
    return private / name if private and _writable(private / name) else None


def _private_folder() -> Path | None:
    """Return a temporary folder that this user alone can write, for what lies in it is executed; None if there is none.

    It has the same name in every process of the user: workers and later runs find what is there.
    """
    if not hasattr(os, "getuid"):  # such systems have a temporary folder a user
        return Path(tempfile.gettempdir()) / "pdhef-compiled"
    with contextlib.suppress(OSError):
        folder = Path(tempfile.gettempdir()) / f"pdhef-compiled-{os.getuid()}"
        with contextlib.suppress(FileExistsError):
            folder.mkdir(mode=0o700)
        found = folder.lstat()
        if stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o077:
            return folder
    return None


def _writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True


class _Cache:
    """What a compiled function asks for its machine code: the installation's, and what this user keeps."""

    def __init__(self, function: Any) -> None:
        folder = Path(inspect.getfile(function)).absolute().parent
        installed, kept = folder / "__pycache__", kept_in(folder)
        self.cache_path = None if kept is None else str(kept)
        self._kept = None if kept is None else _Place(function, kept)
        self._places = [self._kept] if self._kept else []
        if kept != installed and installed.is_dir():
            self._places.insert(0, _Place(function, installed))

    def load_overload(self, signature: Any, context: Any) -> Any:
        for place in self._places:
            try:
                found = place.load_overload(signature, context)
            except Exception:  # noqa: BLE001 (whatever a pickle that was cut short may raise)
                with contextlib.suppress(OSError):
                    place.flush()
                continue
            if found is not None:
                return found
        _announce(self.cache_path)
        return None

    def signatures(self, codegen: Any) -> list[Any]:
        """Return for which arguments there is code for this processor."""
        return list(dict.fromkeys(s for place in self._places for s in place.signatures(codegen)))

    def save_overload(self, signature: Any, result: Any) -> None:
        with contextlib.suppress(OSError):  # a full disk: the next run compiles again
            if self._kept is not None:
                self._kept.save_overload(signature, result)

    def flush(self) -> None:
        if self._kept is not None:
            self._kept.flush()


class _Place(caching.FunctionCache):  # type: ignore[misc]
    """Numba's cache of one function in one folder."""

    def __init__(self, function: Any, folder: Path) -> None:
        self._impl_class = functools.partial(_Code, folder=folder)
        super().__init__(function)

    def signatures(self, codegen: Any) -> list[Any]:
        try:
            index = self._cache_file._load_index()
        except Exception:  # noqa: BLE001 (whatever a pickle that was cut short may raise)
            return []
        return [key[0] for key in index if key == self._index_key(key[0], codegen)]


class _Code(caching.CompileResultCacheImpl):  # type: ignore[misc]
    def __init__(self, function: Any, folder: Path) -> None:
        self._locator_classes = [_Locator(folder)]
        super().__init__(function)


class _Locator(caching._CacheLocator):  # type: ignore[misc]
    """Tells numba the folder that was chosen above."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def from_function(self, function: Any, file: str) -> _Locator:
        self._file, self._line = file, function.__code__.co_firstlineno
        return self

    def get_cache_path(self) -> str:
        return str(self._folder)

    def get_source_stamp(self) -> bytes:
        return _stamp(self._file)

    def get_disambiguator(self) -> str:
        return str(self._line)


@functools.cache
def _stamp(file: str) -> bytes:
    return hashlib.sha256(Path(file).read_bytes()).digest()


_announced: list[str | None] = []


def _announce(folder: str | None) -> None:
    """Say on stderr, once, that compiling begins; of the workers of a command the first one does."""
    if _announced or processes.worker_number > 1:
        return
    _announced.append(folder)
    if folder is None:
        told = f"compiling, about {COMPILING_S} s in every run: there is no folder to keep the code in"
    else:
        told = f"compiling, once, about {COMPILING_S} s; the code is kept in {shown(folder)}"
    sys.stderr.write(f"{told}\n")
    sys.stderr.flush()
