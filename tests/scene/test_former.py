"""What 0.1.0 had under other names."""

from __future__ import annotations

import importlib

import pytest
import torch

import ptt
from ptt.light import prefiltered
from ptt.scene.parts import Part


def test_scenes() -> None:
    with pytest.warns(DeprecationWarning, match=r"Scene\.default of ptt 0\.1\.0 is ptt\.default_scene now"):
        scene = ptt.Scene.default()  # type: ignore[attr-defined]
    assert torch.equal(scene.vertices, ptt.default_scene().vertices)
    with (
        pytest.warns(DeprecationWarning, match=r"Scene\.load of ptt 0\.1\.0 is ptt\.load_scene now"),
        pytest.raises(ValueError, match=r"nothing\.glb"),
    ):
        ptt.Scene.load("nothing.glb")  # type: ignore[attr-defined]


def test_modules() -> None:
    meshes = importlib.import_module("ptt.meshes")
    with pytest.warns(DeprecationWarning, match=r"ptt\.meshes of ptt 0\.1\.0 is ptt\.scene\.parts now"):
        assert meshes.Part is Part
    with pytest.raises(AttributeError, match=r"module 'ptt\.meshes' has no attribute 'nothing'"):
        _ = meshes.nothing
    light = ptt.Environment(torch.rand(16, 32, 3))
    maps = importlib.import_module("ptt.models.light_maps")
    with pytest.warns(DeprecationWarning, match=r"is ptt\.light\.prefiltered now"):
        found = maps.light_maps(light, ())
    assert torch.equal(found.fine, prefiltered.light_maps(light.map, ()).whole.fine)
