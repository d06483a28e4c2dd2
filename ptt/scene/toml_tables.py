"""Tables of scene files: their keys, their values, and the files that they name."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

T = TypeVar("T")


def find(name: str, folder: Path) -> Path:
    """The file `name` in `folder`, else under $PTT_DATA.

    Raises:
        ValueError: it is in neither.
    """
    tried = [folder / name]
    if "PTT_DATA" in os.environ:
        tried.append(Path(os.environ["PTT_DATA"]) / name)
    for path in tried:
        if path.is_file():
            return path
    raise ValueError(f"no file {name!r}, beside the TOML file or in $PTT_DATA: {', '.join(map(str, tried))}")


def value_of(table: Mapping[str, Any], key: str, kind: type[T], default: T) -> T:
    """The value at a key, which must be of a kind."""
    value = table.get(key, default)
    if type(value) is not kind:
        raise ValueError(f"{key} must be of type {kind.__name__}, got {value!r}")
    return value


def check_keys(place: str, keys: Iterable[str], valid: Iterable[str]) -> None:
    """Refuse keys that are not valid."""
    names = list(valid)
    if unknown := [key for key in keys if key not in names]:
        raise ValueError(f"{place}: unknown {', '.join(map(repr, unknown))}; valid are {', '.join(names)}")
