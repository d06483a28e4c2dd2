"""Names of 0.1.0 that moved: they answer as they did, and a warning says what they are called now."""

from __future__ import annotations

import functools
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from types import ModuleType
from typing import Any

from ptt.light import prefiltered
from ptt.light.environment import Environment
from ptt.scene import parts
from ptt.scene.default import default_scene
from ptt.scene.scene import Scene
from ptt.scene.scene_files import load_scene


def _warn(name: str, now: str) -> None:
    warnings.warn(f"{name} of ptt 0.1.0 is {now} now", DeprecationWarning, stacklevel=3)


def _moved(name: str, now: str, function: Callable[..., Any]) -> Callable[..., Any]:
    """The function, with a warning."""

    @functools.wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        _warn(name, now)
        return function(*arguments, **named)

    return call


class _Moved(ModuleType):
    """A module whose members are elsewhere now."""

    def __init__(self, name: str, now: str, members: Mapping[str, Any]) -> None:
        super().__init__(name, f"`{now}` now.")
        self._now, self._members = now, members

    def __getattr__(self, name: str) -> Any:
        if name not in self._members:
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")
        _warn(self.__name__, self._now)
        return self._members[name]


def _light_maps(environment: Environment, angles: Sequence[float]) -> prefiltered.LightMaps:
    """The maps of a light of one layer."""
    return prefiltered.light_maps(environment.map, angles).whole


def former_names() -> None:
    """Let `Scene.load`, `Scene.default`, `ptt.meshes` and `ptt.models.light_maps` answer."""
    functions: dict[str, Callable[..., Any]] = {"load": load_scene, "default": default_scene}
    for name, function in functions.items():
        setattr(Scene, name, staticmethod(_moved(f"Scene.{name}", f"ptt.{function.__name__}", function)))
    modules = {
        "ptt.meshes": ("ptt.scene.parts", vars(parts)),
        "ptt.models.light_maps": ("ptt.light.prefiltered", {"light_maps": _light_maps}),
    }
    for name, (now, members) in modules.items():
        sys.modules[name] = _Moved(name, now, {key: value for key, value in members.items() if key[0] != "_"})
