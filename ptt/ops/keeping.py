"""The folder in which ptt keeps what it makes once: kernels, fits of spaces, models of scripts."""

from __future__ import annotations

import hashlib
import json
import os
import sys
import tempfile
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from torch import Tensor


@cache
def folder() -> Path:
    """~/.cache/ptt (XDG_CACHE_HOME/ptt); where it cannot be written, one of this process alone, and a line says so."""
    own = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ptt"
    try:
        own.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=own).close()
    except OSError as error:
        print(f"ptt: nothing is kept for the next time: {error}; set XDG_CACHE_HOME to a folder", file=sys.stderr)
        _temporary.append(tempfile.TemporaryDirectory(prefix="ptt-"))
        return Path(_temporary[-1].name)
    return own


_temporary: list[tempfile.TemporaryDirectory[str]] = []  # removed when the process ends


def place(kind: str, made_from: Mapping[str, Any]) -> Path:
    """The file in the folder that keeps a result: its name tells what it was made from.

    made_from: plain values and tensors, by name; the code of ptt is added
    """
    digest = hashlib.sha256(_code())
    for name, value in made_from.items():
        digest.update(name.encode())
        if isinstance(value, Tensor):
            digest.update(f"{value.dtype} {tuple(value.shape)}".encode() + value.contiguous().numpy().tobytes())
        else:
            digest.update(json.dumps(value, sort_keys=True, default=str).encode())
    return folder() / f"{kind.replace(' ', '-')}-{digest.hexdigest()[:16]}.safetensors"


@cache
def _code() -> bytes:
    """All of ptt: what other code made is made anew."""
    files = sorted(Path(__file__).parent.parent.glob("**/*.py"))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).digest()
