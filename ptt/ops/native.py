"""The view step by a kernel in C++ (`view.cpp`), compiled on first use; the plain one where the kernel does not fit.

`view` takes and gives what `ptt.ops.view.view` does. The kernel is for float32 on the CPU without gradients. It is
built by the compiler that `torch.compile` finds, once for each processor, in ~/.cache/ptt (XDG_CACHE_HOME).
"""

from __future__ import annotations

import ctypes
import hashlib
import math
import os
import subprocess
import tempfile
import warnings
from functools import cache
from pathlib import Path

import torch
from torch import Tensor
from torch.autograd.forward_ad import unpack_dual

from ptt.ops import view as plain
from ptt.ops.view import Gloss, Points

SOURCE = Path(__file__).with_name("view.cpp")
# not -ffast-math, with which GCC sets the process to flush denormals
FLAGS = "-std=c++17 -O3 -march=native -mprefer-vector-width=512 -fno-math-errno -fno-trapping-math -fopenmp -fPIC -w"
LANES = 16  # a multiple of those of the kernel
ORDERS = (0, 16)
LOBES = 4

POINTERS = ("position", "frame", "eye", "outgoing", "sent", "rho", "specular", "maps", "turn", "blurs", "cuts", "which")
LONGS = ("blocks", "width", "rows")
INTS = ("distant", "factors", "harmonics", "tilts", "disk", "cells", "map", "threads")


class _Arguments(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_void_p) for name in (*POINTERS, "out")),
        *((name, ctypes.c_int64) for name in LONGS),
        *((name, ctypes.c_int32) for name in INTS),
    )


def view(points: Points, eye: Tensor, outgoing: Tensor, sent: Tensor, gloss: Gloss | None) -> Tensor:
    """B (n, c), as `ptt.ops.view.view`; where a point is at the eye, its lobes are finite."""
    kernel = _kernel() if _fits(points, eye, outgoing, sent, gloss) else None
    if kernel is None:
        return plain.view(points, eye, outgoing, sent, gloss)
    b, c, rows, width = sent.shape
    outgoing, eye = outgoing.contiguous(), eye.contiguous()
    out = sent.new_empty(b * width, c)
    tensors = {"position": points.position, "frame": points.frame, "eye": eye, "outgoing": outgoing, "sent": sent}
    numbers = {"blocks": b, "width": width, "rows": rows, "threads": torch.get_num_threads()}
    numbers |= {"distant": eye.ndim == 2, "factors": 1 + outgoing.shape[1], "disk": _side(len(outgoing))}
    if gloss is not None:
        tensors |= {name: getattr(gloss, name).contiguous() for name in ("rho", "specular", "maps", "turn", "blurs")}
        tensors |= {"which": gloss.which.contiguous(), "cuts": points.cuts}
        numbers |= {"harmonics": rows - numbers["factors"], "tilts": gloss.tilts}
        numbers |= {"cells": _side(points.cuts.shape[1]), "map": _side(len(gloss.maps))}
    pointers = {name: tensor.data_ptr() for name, tensor in tensors.items()}
    arguments = _Arguments(out=out.data_ptr(), **pointers, **numbers)
    kernel.ptt_view(ctypes.byref(arguments), 0 if gloss is None else len(gloss.which))
    return out


def available() -> bool:
    """Whether the kernel can be built here; the first call builds it, or warns."""
    return _kernel() is not None


def _fits(points: Points, eye: Tensor, outgoing: Tensor, sent: Tensor, gloss: Gloss | None) -> bool:
    """Whether the kernel is for these arguments."""
    if torch.compiler.is_compiling():
        return False
    large = [points.position, points.frame, sent]
    small = [eye, outgoing]
    n = sent.shape[0] * sent.shape[-1]
    shapes = sent.ndim == 4 and sent.shape[1] == 3 and sent.shape[3] % LANES == 0 and eye.shape in ((3,), (3, n))
    shapes = shapes and points.position.shape == (3, n) and points.frame.shape == (3, 3, n) and _square(len(outgoing))
    if gloss is not None:
        small += [gloss.rho, gloss.specular, gloss.maps, gloss.turn, gloss.blurs]
        k, cuts = len(gloss.which), points.cuts
        shapes = shapes and 0 < k <= LOBES and gloss.rho.shape == (gloss.tilts, k) and gloss.specular.shape == (3,)
        shapes = shapes and gloss.turn.shape == (3, 3) and _square(len(gloss.maps)) and gloss.maps.shape[1] == 3 * k
        shapes = shapes and (sent.shape[2] - 1 - outgoing.shape[1]) in ORDERS and gloss.blurs.shape[0] == k
        shapes = shapes and (sent.shape[2] == 1 + outgoing.shape[1] or gloss.blurs.shape[1] == ORDERS[1])
        shapes = shapes and cuts.shape[0] == n and _square(cuts.shape[1]) and cuts.is_contiguous()
        shapes = shapes and cuts.dtype == torch.int32 and gloss.which.dtype == torch.int64
        shapes = shapes and cuts.device.type == gloss.which.device.type == "cpu"
    return (
        shapes
        and sent.shape[2] > outgoing.shape[1]
        and all(t.is_contiguous() for t in large)
        and all(t.dtype == torch.float32 and t.device.type == "cpu" for t in (*large, *small))
        and not any(_differentiated(t) for t in (*large, *small))
    )


def _differentiated(t: Tensor) -> bool:
    return (torch.is_grad_enabled() and t.requires_grad) or unpack_dual(t).tangent is not None


def _side(cells: int) -> int:
    return round(math.sqrt(cells))


def _square(cells: int) -> bool:
    return _side(cells) ** 2 == cells > 0


@cache
def _kernel() -> ctypes.CDLL | None:
    """The library, or None, with a warning, where it cannot be built."""
    try:
        return ctypes.CDLL(str(_build(_folder())))
    except subprocess.CalledProcessError as error:
        reason = error.stderr.strip() or str(error)
    except Exception as error:  # torch has a class of its own for a missing compiler, in a private place
        reason = str(error)
    warnings.warn(f"no C++ compiler, relighting stays eager: {reason}", UserWarning, stacklevel=3)
    return None


def _folder() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ptt"


def _build(folder: Path) -> Path:
    """The library in a folder, compiled if it is not there; safe with others that do the same at the same time."""
    from torch._inductor.cpp_builder import get_cpp_compiler

    compiler = get_cpp_compiler()
    flags = FLAGS.split()
    # what the compiler defines tells its version and the processor
    defined = _run(compiler, *flags, "-dM", "-E", "-x", "c++", os.devnull)
    key = hashlib.sha256("\0".join((compiler, *flags, defined, SOURCE.read_text())).encode()).hexdigest()[:16]
    library = folder / f"view-{key}.so"
    if not library.exists():
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder) as own:
            built = Path(own) / library.name
            _run(compiler, *flags, "-shared", "-o", str(built), str(SOURCE))
            built.replace(library)
    return library


def _run(*command: str) -> str:
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout
