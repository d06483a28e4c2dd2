"""The kernels in C++ of `ptt.ops.native`: compiled on first use, once for each processor, and kept.

Built by the compiler that `torch.compile` finds, in ~/.cache/ptt (XDG_CACHE_HOME).
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import subprocess
import tempfile
import warnings
from functools import cache
from pathlib import Path

NAMES = "light", "brdf", "view", "rotation", "shading", "near", "triple"
SOURCES = tuple(Path(__file__).with_name(f"{name}.cpp") for name in NAMES)
HEADER = Path(__file__).with_name("lanes.h")
# not -ffast-math, with which GCC sets the process to flush denormals
FLAGS = "-std=c++17 -O3 -march=native -mprefer-vector-width=512 -fno-math-errno -fno-trapping-math -fopenmp -fPIC -w"


@cache
def library() -> ctypes.CDLL | None:
    """The library, or None, with a warning, where it cannot be built."""
    try:
        return ctypes.CDLL(str(_build(_folder())))
    except subprocess.CalledProcessError as error:
        reason = error.stderr.strip() or str(error)
    except Exception as error:  # torch has a class of its own for a missing compiler, in a private place
        reason = str(error)
    warnings.warn(f"no C++ compiler, relighting stays eager: {reason}", UserWarning, stacklevel=4)
    return None


def available() -> bool:
    """Whether the kernels can be built here; the first call builds them, or warns."""
    return library() is not None


def _folder() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ptt"


def _build(folder: Path) -> Path:
    """The library in a folder, compiled if it is not there; safe with others that do the same at the same time."""
    from torch._inductor.cpp_builder import get_cpp_compiler

    compiler = get_cpp_compiler()
    flags = FLAGS.split()
    # what the compiler defines tells its version and the processor
    defined = _run(compiler, *flags, "-dM", "-E", "-x", "c++", os.devnull)
    code = [path.read_text() for path in (HEADER, *SOURCES)]
    key = hashlib.sha256("\0".join((compiler, *flags, defined, *code)).encode()).hexdigest()[:16]
    library = folder / f"kernels-{key}.so"
    if not library.exists():
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder) as own:
            built = Path(own) / library.name
            _run(compiler, *flags, "-shared", "-o", str(built), *map(str, SOURCES))
            built.replace(library)
    return library


def _run(*command: str) -> str:
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout
