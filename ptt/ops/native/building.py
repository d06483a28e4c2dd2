"""Kernels are built on first use, each source by itself, and kept in ~/.cache/ptt (XDG_CACHE_HOME).

Environment variables:
    CXX         the compiler, with arguments if need be; else c++, g++ or clang++
    PTT_MARCH   the processor to build for, as the compiler's -march names it; else the one that is there
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cache
from pathlib import Path

from ptt.ops import constants
from ptt.ops.keeping import folder

FOLDER = Path(__file__).parent
SOURCES = {path.stem: path for path in sorted(FOLDER.glob("*.cpp"))}
HEADERS = (FOLDER / "signatures.h", FOLDER / "lanes.h", FOLDER / "hemispheres.h")
COMPILERS = ("c++", "g++", "clang++")
# not -ffast-math, with which GCC sets the process to flush denormals
FLAGS = (
    "-std=c++17",
    "-O3",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-mprefer-vector-width=512",
    "-fopenmp",
    "-fPIC",
)
DIGEST = hashlib.sha256().digest_size  # bytes that end a library's file: of all that stands before them


class CannotBuildError(Exception):
    """Kernels cannot be built here; the message says why."""


def library(source: str) -> ctypes.CDLL:
    """The library of a source, loaded; built first where it is not kept, or was damaged.

    Raises:
        CannotBuildError: there is no compiler, or it fails.
    """
    path = build([source])[0]
    try:
        return ctypes.CDLL(str(path))
    except OSError as error:
        raise CannotBuildError(f"{path} cannot be loaded: {error}") from error


def build(sources: Sequence[str]) -> list[Path]:
    """The libraries of some sources, those that are not kept built at the same time; safe with others that do the same.

    Raises:
        CannotBuildError: there is no compiler, or it fails.
    """
    paths = [kept(source) for source in sources]
    missing = [(source, path) for source, path in zip(sources, paths, strict=True) if not whole(path)]
    if missing:
        names = ", ".join(source for source, _ in missing)
        print(f"ptt: building C++ kernels for this processor, once, about 15 s: {names}", file=sys.stderr, flush=True)
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            list(pool.map(lambda each: _compile(*each), missing))
    return paths


def kept(source: str) -> Path:
    """Where the library of a source is kept: its name tells the compiler, the processor and the code."""
    compiler, flags, defined = toolchain()
    code = [header(), *(path.read_text() for path in (*HEADERS, SOURCES[source]))]
    key = hashlib.sha256("\0".join((*compiler, *flags, defined, *code)).encode()).hexdigest()[:16]
    return folder() / f"kernels-{source}-{key}.so"


def whole(path: Path) -> bool:
    """Tell whether a library is there, undamaged: its last bytes are the digest of the others."""
    try:
        content = path.read_bytes()
    except OSError:
        return False
    return hashlib.sha256(content[:-DIGEST]).digest() == content[-DIGEST:]


@cache
def toolchain() -> tuple[list[str], list[str], str]:
    """The compiler, the flags of ours that it knows, and what it defines, which tells its version and the processor.

    Raises:
        CannotBuildError: there is no compiler, or it does not run.
    """
    compiler = _compiler()
    wanted = [*FLAGS, f"-march={os.environ.get('PTT_MARCH') or 'native'}"]
    try:
        return compiler, wanted, _defined(compiler, wanted)
    except CannotBuildError:
        _defined(compiler, [])  # raises where it is not a flag's fault
    flags = []
    for flag in wanted:
        with suppress(CannotBuildError):
            _defined(compiler, [flag])
            flags.append(flag)
    return compiler, flags, _defined(compiler, flags)


def _compiler() -> list[str]:
    given = shlex.split(os.environ.get("CXX", ""))
    if given:
        return given
    for name in COMPILERS:
        if shutil.which(name):
            return [name]
    raise CannotBuildError(f"there is none of {', '.join(COMPILERS)}; install one, or name it in CXX")


def _defined(compiler: list[str], flags: list[str]) -> str:
    return _run(*compiler, *flags, "-dM", "-E", "-x", "c++", os.devnull)


def header() -> str:
    """The text of constants.h: the numbers of `ptt.ops.constants`."""
    numbers = {name: value for name, value in vars(constants).items() if isinstance(value, int | float)}
    lines = [
        f"constexpr {'int' if isinstance(value, int) else 'float'} {name} = {value!r};"
        for name, value in numbers.items()
    ]
    return "\n".join(("#pragma once", *lines, ""))


def _compile(source: str, path: Path) -> None:
    """Build a library apart from where it is kept, and put it there whole."""
    compiler, flags, _ = toolchain()
    with tempfile.TemporaryDirectory(prefix="ptt-") as own:
        Path(own, "constants.h").write_text(header())
        built = Path(own, path.name)
        _run(*compiler, *flags, "-I", own, "-shared", "-o", str(built), str(SOURCES[source]))
        content = built.read_bytes()
    whole = Path(f"{path}.{os.getpid()}.{threading.get_ident()}")
    try:
        whole.write_bytes(content + hashlib.sha256(content).digest())
        whole.replace(path)
    finally:
        whole.unlink(missing_ok=True)


def _run(*command: str) -> str:
    try:
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout
    except OSError as error:
        raise CannotBuildError(f"{command[0]} cannot be run: {error}") from error
    except subprocess.CalledProcessError as error:
        said = error.stderr.strip().splitlines()
        raise CannotBuildError(f"{command[0]} fails: {' '.join(said[:3]) or error}") from error
