"""The kernels in C++ of `ptt.ops.native`, called by ctypes with the structures of signatures.h."""

from __future__ import annotations

import ctypes
import re
import warnings
from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import torch
from torch import Tensor

from ptt.ops.native import building
from ptt.ops.native.building import CannotBuildError

TYPES: dict[str, type[ctypes._SimpleCData[int]] | type[ctypes._SimpleCData[float]]] = {
    "int32_t": ctypes.c_int32,
    "int64_t": ctypes.c_int64,
    "float": ctypes.c_float,
    "double": ctypes.c_double,
}


class Kernel(NamedTuple):
    """A function of a library, the structure that it takes, and the names of its members."""

    function: Callable[..., int]
    structure: type[ctypes.Structure]
    names: frozenset[str]


@cache
def library(source: str) -> ctypes.CDLL | None:
    """The library of a source, or None, with one warning, where it cannot be built."""
    try:
        return building.library(source)
    except CannotBuildError as error:
        _warn(str(error))
        return None


@cache
def _warn(reason: str) -> None:
    warnings.warn(f"no C++ kernels, relighting stays eager: {reason}", UserWarning, stacklevel=5)


def prepare(*sources: str) -> None:
    """Build what is missing of the kernels in some sources, at the same time; where it cannot be, `available` warns."""
    try:
        building.build([source for source in sources if source not in _prepared])
    except CannotBuildError:
        return
    _prepared.update(sources)


_prepared: set[str] = set()


def available(kernel: str | None = None) -> bool:
    """Whether a kernel, or without a name each of them, can be built here; the first call builds, or warns."""
    sources = building.SOURCES if kernel is None else [source_of(kernel)]
    return all(library(source) is not None for source in sources)


@cache
def source_of(kernel: str) -> str:
    """The source that has a kernel."""
    found = [name for name, path in building.SOURCES.items() if f" ptt_{kernel}(" in path.read_text()]
    return found[0]


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
    built = library(source_of(name))
    if built is None:
        raise RuntimeError(f"kernel {name} cannot be built here")
    structure = structures()["".join(word.capitalize() for word in name.split("_"))]
    names = frozenset(member[0] for member in structure._fields_) - {"threads"}
    return Kernel(built[f"ptt_{name}"], structure, names)


@cache
def structures() -> dict[str, type[ctypes.Structure]]:
    """The structures of signatures.h that end with `threads`, as those of ctypes."""
    text = re.sub(r"//.*", "", (building.FOLDER / "signatures.h").read_text())
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
