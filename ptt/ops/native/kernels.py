"""The kernels in C++ of `ptt.ops.native`: compiled on first use, once for each processor, and kept.

They are built by the compiler that `torch.compile` finds, in ~/.cache/ptt (XDG_CACHE_HOME).
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import re
import subprocess
import tempfile
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from ptt.ops import constants

FOLDER = Path(__file__).parent
NAMES = ("light", "brdf", "view", "rotation", "shading", "near", "triple")
SOURCES = tuple(FOLDER / f"{name}.cpp" for name in NAMES)
HEADERS = (FOLDER / "signatures.h", FOLDER / "lanes.h")
# not -ffast-math, with which GCC sets the process to flush denormals
FLAGS = "-std=c++17 -O3 -march=native -mprefer-vector-width=512 -fno-math-errno -fno-trapping-math -fopenmp -fPIC"
TYPES: dict[str, type[ctypes._SimpleCData[int]] | type[ctypes._SimpleCData[float]]] = {
    "int32_t": ctypes.c_int32,
    "int64_t": ctypes.c_int64,
    "float": ctypes.c_float,
    "double": ctypes.c_double,
}


class Kernel(NamedTuple):
    """A function of the library, the structure that it takes, and the names of its members."""

    function: Callable[..., int]
    structure: type[ctypes.Structure]
    names: frozenset[str]


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


def run(name: str, **values: Tensor | float | None) -> None:
    """Call a kernel with the members of its structure; tensors by their addresses, which must be contiguous.

    Raises:
        RuntimeError: the kernel has no case for these arguments, or a member is missing or unknown: a fault of ptt.
    """
    kernel = _kernel(name)
    if kernel.names != values.keys():
        raise RuntimeError(f"kernel {name} takes {sorted(kernel.names)}, got {sorted(values)}")
    members = {key: value.data_ptr() if isinstance(value, Tensor) else value for key, value in values.items()}
    arguments = kernel.structure(**members, threads=torch.get_num_threads())
    if status := kernel.function(ctypes.byref(arguments)):
        raise RuntimeError(f"kernel {name} has no case for its arguments (status {status})")


@cache
def _kernel(name: str) -> Kernel:
    built = library()
    if built is None:
        raise RuntimeError(f"kernel {name} cannot be built here")
    structure = structures()["".join(word.capitalize() for word in name.split("_"))]
    names = frozenset(member[0] for member in structure._fields_) - {"threads"}
    return Kernel(built[f"ptt_{name}"], structure, names)


@cache
def structures() -> dict[str, type[ctypes.Structure]]:
    """The structures of signatures.h that end with `threads`, as those of ctypes."""
    text = re.sub(r"//.*", "", (FOLDER / "signatures.h").read_text())
    bodies = dict(re.findall(r"struct (\w+) \{(.*?)\};", text, re.DOTALL))
    return {
        name: type(name, (ctypes.Structure,), {"_fields_": _members(body)})
        for name, body in bodies.items()
        if "threads" in body
    }


def _members(body: str) -> list[tuple[str, type]]:
    found: list[tuple[str, type]] = []
    for line in filter(str.strip, body.split(";")):
        match = re.fullmatch(r"\s*(?:const )?(\w+) (.+?)\s*", line, re.DOTALL)
        assert match is not None, line
        for member in match[2].split(","):
            pointer = member.strip().startswith("*")
            found.append((member.strip(" *\n"), ctypes.c_void_p if pointer else TYPES[match[1]]))
    return found


def header() -> str:
    """The text of constants.h: the numbers of `ptt.ops.constants`."""
    numbers = {name: value for name, value in vars(constants).items() if isinstance(value, int | float)}
    lines = [
        f"constexpr {'int' if isinstance(value, int) else 'float'} {name} = {value!r};"
        for name, value in numbers.items()
    ]
    return "\n".join(("#pragma once", *lines, ""))


def _folder() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ptt"


def _build(folder: Path) -> Path:
    """The library in a folder, compiled if it is not there; safe with others that do the same at the same time."""
    from torch._inductor.cpp_builder import get_cpp_compiler

    compiler = get_cpp_compiler()
    flags = FLAGS.split()
    # what the compiler defines tells its version and the processor
    defined = _run(compiler, *flags, "-dM", "-E", "-x", "c++", os.devnull)
    code = [header(), *(path.read_text() for path in (*HEADERS, *SOURCES))]
    key = hashlib.sha256("\0".join((compiler, *flags, defined, *code)).encode()).hexdigest()[:16]
    library = folder / f"kernels-{key}.so"
    if not library.exists():
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder) as own:
            Path(own, "constants.h").write_text(header())
            built = Path(own) / library.name
            _run(compiler, *flags, "-I", own, "-shared", "-o", str(built), *map(str, SOURCES))
            built.replace(library)
    return library


def _run(*command: str) -> str:
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout
