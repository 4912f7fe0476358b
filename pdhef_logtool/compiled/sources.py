"""Digest of all inputs of machine code: sources, compiler and processor, computed without the compiler.

Numba's own cache identifies a function by its file and ignores the files of the functions that it calls. Here all
compiled code is kept under one digest, so that code of other sources is never loaded.
"""

import hashlib
import os
import re
import sys
from collections.abc import Mapping
from functools import cache
from importlib.metadata import version
from pathlib import Path

#: The folder that contains the packages: a checkout or ``site-packages``.
ROOT = Path(__file__).parents[2]
PACKAGES = ("pdhef_logtool", "truthsim")
_COMPILED = (b"compiled.cache import", b"numba.extending import")
_IMPORT = re.compile(rb"^from ((?:pdhef_logtool|truthsim)[\w.]*) import (?:\(([^)]*)\)|(.*))", re.MULTILINE)


def compiled_sources(root: Path = ROOT) -> Mapping[Path, bytes]:
    """Return the modules with compiled functions and the modules that these import, which contain their constants."""
    texts = {path: path.read_bytes() for package in PACKAGES for path in sorted((root / package).rglob("*.py"))}
    sources = {path for path, text in texts.items() if any(mark in text for mark in _COMPILED)}
    for path in tuple(sources):
        for module, in_brackets, on_the_line in _IMPORT.findall(texts[path]):
            place = root.joinpath(*module.decode().split("."))
            names = re.findall(r"\w+", (in_brackets or on_the_line).decode()) if place.is_dir() else []
            sources |= {f for f in (place.with_suffix(".py"), *(place / f"{n}.py" for n in names)) if f in texts}
    return {path: texts[path] for path in sorted(sources)}


def sources_digest(root: Path = ROOT) -> str:
    """Return the digest of the sources, and of the versions of the compiler."""
    digest = hashlib.sha256(f"numba {version('numba')}, llvmlite {version('llvmlite')}\n".encode())
    for path, text in compiled_sources(root).items():
        digest.update(f"{path.relative_to(root).as_posix()}\n".encode() + hashlib.sha256(text).digest())
    return digest.hexdigest()[:16]


@cache
def compiled_digest() -> str:
    """Return the name of the folder that keeps the machine code: digest of sources and compiler, digest of processor.

    The second part lets processors of several kinds, and several versions of Python, share a place.
    """
    from llvmlite import binding

    name = os.environ.get("NUMBA_CPU_NAME") or binding.get_host_cpu_name()
    features = os.environ.get("NUMBA_CPU_FEATURES") or binding.get_host_cpu_features().flatten()
    processor = f"{sys.implementation.cache_tag}, {name}, {features}"
    return f"{sources_digest()}-{hashlib.sha256(processor.encode()).hexdigest()[:8]}"
