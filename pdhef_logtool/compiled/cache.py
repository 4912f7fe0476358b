"""The ``njit`` of the package: machine code is cached where this user can write, and a cache error never ends a run.

Numba searches a cache folder when a function is decorated and raises an error if there is none; a truncated cache file
or a full disk also ends the call. Here the code goes to the first folder that can be written: ``NUMBA_CACHE_DIR``, the
installation, the user's cache, a private temporary folder; if there is none, every run compiles. Code that the
installation contains is also used if the installation is read-only.

In each place the code lies in a folder that is named after the digest of all sources (:mod:`~.sources`). The
first process that uses a new digest removes the folders of other sources of this same installation; those of other
installations lie elsewhere, and those of other processors and versions of Python stay.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import hashlib
import os
import re
import shutil
import stat
import sys
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numba
from numba.core import caching, config, event
from numba.extending import overload
from numba.misc.appdirs import AppDirs
from numba.np import arrayobj, linalg

from pdhef_logtool.compiled import sources
from pdhef_logtool.records import processes
from pdhef_logtool.records.printable import printable

#: How long the first run compiles, in seconds; a rough figure for the user.
COMPILING_S = 40


def _without_blas() -> None:
    """Let numba load without SciPy's BLAS, which takes longer than a short log: no function here needs it.

    What needs LAPACK, such as the repair of a covariance, loads that when it is called.
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
# Numba's own writes both shapes into the message, and compiles its text functions for that: a sixth of all compiling.
arrayobj.raise_with_shape_context = _sizes_differ


def njit(function: Any = None, *, cache: bool = False, **options: Any) -> Any:
    """Compile a function as ``numba.njit`` does; ``cache`` keeps its machine code as described above."""
    if function is None:
        return functools.partial(njit, cache=cache, **options)
    options |= {"no_cfunc_wrapper": True}
    compiled = numba.njit(function, **options)
    if cache and not config.DISABLE_JIT:
        compiled._cache = _Cache(function)
        _kept.append(compiled)
    return compiled


class _RareCollection(event.Listener):  # type: ignore[misc]
    """Collects garbage less often while numba compiles: its objects live on, and to look at them takes a fifth more."""

    def __init__(self) -> None:
        self._depth, self._usual = 0, gc.get_threshold()

    def on_start(self, _: Any) -> None:
        if self._depth == 0:
            self._usual = gc.get_threshold()
            gc.set_threshold(100_000, 20, 100)
        self._depth += 1

    def on_end(self, _: Any) -> None:
        self._depth -= 1
        if self._depth == 0:
            gc.set_threshold(*self._usual)


event.register("numba:compile", _RareCollection())

#: The functions of the modules imported so far whose machine code is kept.
_kept: list[Any] = []


def load_kept() -> bool:
    """Load all cached machine code, for the processes that are forked from this one; return whether there is any."""
    for function in _kept:
        codegen = function.targetctx.codegen()
        for signature in function._cache.signatures(codegen):
            function.compile(signature)
    return any(function.signatures for function in _kept)


def _installed() -> Path:
    """Return the folder in which this installation may bring its machine code along."""
    return sources.ROOT / "pdhef_logtool/__pycache__/compiled" / sources.compiled_digest()


def _places() -> Iterator[Path]:
    """Yield the places of this installation, in the order in which they are taken."""
    # Several installations may share all places but their own.
    name = f"pdhef_logtool_{hashlib.sha256(os.fsencode(sources.ROOT)).hexdigest()[:16]}"
    if config.CACHE_DIR:
        yield Path(config.CACHE_DIR) / name
    yield _installed().parent
    yield Path(AppDirs(appname="numba", appauthor=False).user_cache_dir) / name
    if private := _private_folder():
        yield private / name


@functools.cache
def kept_in() -> Path | None:
    """Return the folder that keeps the machine code; None: nowhere."""
    for place in _places():
        folder = place / sources.compiled_digest()
        new = not folder.is_dir()
        if _writable(folder):
            if new:
                _remove_stale({place, _installed().parent})
            return folder
    return None


def _remove_stale(places: Iterable[Path]) -> None:
    """Remove, as far as it can be written, the code of other sources."""
    digest = sources.compiled_digest().partition("-")[0]
    with contextlib.suppress(OSError):
        for folder in [f for place in places if place.is_dir() for f in place.iterdir()]:
            if re.fullmatch("[0-9a-f]{16}-[0-9a-f]{8}", folder.name) and not folder.name.startswith(digest):
                shutil.rmtree(folder, ignore_errors=True)


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


class _Cache:
    """Cache of a compiled function: machine code of the installation and of this user."""

    def __init__(self, function: Any) -> None:
        kept = kept_in()
        installed = _installed()
        self.cache_path = None if kept is None else str(kept)
        self._kept = None if kept is None else _Place(function, kept)
        self._places = [self._kept] if self._kept else []
        if kept != installed and installed.is_dir():
            self._places.insert(0, _Place(function, installed))

    def load_overload(self, signature: Any, context: Any) -> Any:
        for place in self._places:
            try:
                overload = place.load_overload(signature, context)
            except Exception:  # noqa: BLE001 (any error of a pickle that was cut short)
                with contextlib.suppress(OSError):
                    place.flush()
                continue
            if overload is not None:
                return overload
        announce()
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
        locator = self._impl.locator
        self._cache_file = _File(self._cache_path, self._impl.filename_base, locator.get_source_stamp())

    def signatures(self, codegen: Any) -> list[Any]:
        try:
            index = self._cache_file._load_index()
        except Exception:  # noqa: BLE001 (any error of a pickle that was cut short)
            return []
        return [key[0] for key in index if key == self._index_key(key[0], codegen)]


class _File(caching.IndexDataCacheFile):  # type: ignore[misc]
    """Numba's files of one function, which several processes may write at once.

    Numba numbers the files of machine code by the index that it has read: two processes could give one number to the
    code for different arguments. Here the name depends on these; what one process misses in the index of another is
    compiled again.
    """

    def save(self, key: Any, data: Any) -> None:
        name = f"{Path(self._index_name).stem}.{hashlib.sha256(repr(key).encode()).hexdigest()[:12]}.nbc"
        self._save_data(name, data)
        self._save_index({**self._load_index(), key: name})


class _Code(caching.CompileResultCacheImpl):  # type: ignore[misc]
    def __init__(self, function: Any, folder: Path) -> None:
        self._locator_classes = [_Locator(folder)]
        super().__init__(function)


class _Locator(caching._CacheLocator):  # type: ignore[misc]
    """Gives numba the folder that was chosen above."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def from_function(self, function: Any, file: str) -> _Locator:
        self._file, self._module, self._line = file, function.__module__, function.__code__.co_firstlineno
        return self

    def get_cache_path(self) -> str:
        return str(self._folder)

    def get_source_stamp(self) -> bytes:
        return _stamp(self._file)

    def get_disambiguator(self) -> str:
        # Modules of one name may lie in several packages.
        return f"{hashlib.sha256(self._module.encode()).hexdigest()[:8]}-{self._line}"


@functools.cache
def _stamp(file: str) -> bytes:
    """Return the digest of a file that is not part of the digest in the folder's name."""
    path = Path(file)
    return b"" if path in sources.compiled_sources() else hashlib.sha256(path.read_bytes()).digest()


#: Whether the note that compiling begins was printed.
announced = False


def announce() -> None:
    """Print a note on stderr, once, that compiling begins; of several workers only the first prints it."""
    global announced
    if announced or processes.worker_number > 1:
        return
    announced, folder = True, kept_in()
    if folder is None:
        text = f"compiling, about {COMPILING_S} s in every run: there is no folder to keep the code in"
    else:
        text = f"compiling, once, about {COMPILING_S} s; the code is kept in {printable(str(folder))}"
    sys.stderr.write(f"{text}\n")
    sys.stderr.flush()
