"""Saved models: a safetensors file whose header holds the config as JSON. Nothing is ever unpickled."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

SCHEMA = 7  # of the files; it grows when files written before can no longer be read
Shapes = Mapping[str, tuple[torch.dtype, tuple[int, ...]]]


def save(path: str | PathLike[str], kind: str, config: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> None:
    """Write tensors, with the kind of thing they are and the config that made them.

    The file appears whole or not at all: it is written beside its place first.

    Raises:
        ValueError: the file cannot be written.
    """
    path = Path(path)
    check_folder(path)
    header = {"ptt": json.dumps({"schema": SCHEMA, "kind": kind, "config": config})}
    ready = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    partial = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        save_file(ready, str(partial), metadata=header)
        partial.replace(path)
    except (OSError, SafetensorError) as error:
        partial.unlink(missing_ok=True)
        raise ValueError(f"cannot write {path}: {error}") from error


def check_folder(path: Path) -> None:
    """Refuse a file that is to be written into a folder that is not there.

    Raises:
        ValueError: the message names the folder.
    """
    if not path.parent.is_dir():
        raise ValueError(f"cannot write {path}: make the folder {path.parent} first")


def load(path: str | PathLike[str], kind: str) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """The config and the tensors of a saved file.

    Raises:
        ValueError: the file is missing, cut short, not safetensors, or of another kind or schema; the message names it.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"no file {path}")
    try:
        with safe_open(str(path), framework="pt") as file:
            header = json.loads((file.metadata() or {}).get("ptt", "{}"))
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a mapping)
    except (SafetensorError, OSError, json.JSONDecodeError) as error:
        raise ValueError(f"{path} is not a whole safetensors file: {error}") from error
    with describing(path):
        if header.get("kind") != kind:
            raise ValueError(f"must hold a {kind}, got {header.get('kind', 'a file that ptt did not write')}")
        if header.get("schema") != SCHEMA:
            raise ValueError(f"has schema {header.get('schema')}, this version of ptt reads {SCHEMA}")
        return header["config"], tensors


@contextmanager
def describing(path: str | PathLike[str]) -> Iterator[None]:
    """Name the file in every error about what it holds, and turn the errors of a damaged config into ValueErrors."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{path} {error}") from error
    except (KeyError, TypeError, IndexError, AttributeError) as error:
        raise ValueError(f"{path} has a damaged config: {error!r}") from error


def check(tensors: Mapping[str, Tensor], expected: Shapes) -> None:
    """Refuse tensors that are not exactly the expected ones, of the expected types and shapes, and finite.

    Raises:
        ValueError: the message names the tensor and what is wrong with it; `describing` adds the file.
    """
    if missing := sorted(set(expected) - set(tensors)):
        raise ValueError(f"lacks the tensor {', '.join(missing)}")
    if extra := sorted(set(tensors) - set(expected)):
        raise ValueError(f"holds unknown tensors: {', '.join(extra)}")
    for name, (dtype, shape) in expected.items():
        tensor = tensors[name]
        if tensor.dtype != dtype or tuple(tensor.shape) != shape:
            got = f"{tensor.dtype} {tuple(tensor.shape)}"
            raise ValueError(f"holds a wrong tensor: {name} must be {dtype} {shape}, got {got}")
        if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
            raise ValueError(f"holds a wrong tensor: {name} holds values that are not finite")
