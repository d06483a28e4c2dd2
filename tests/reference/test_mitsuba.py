"""The reference against Mitsuba 3: an independent path tracer, the same mesh, light and rays."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

import ptt
from ptt.light.environment import Environment
from ptt.materials.textures import Texture
from ptt.scene.scene import Region

mi = pytest.importorskip("mitsuba", reason="mitsuba is not installed: pip install mitsuba")

from bench import mitsuba_check  # noqa: E402 (imports mitsuba)


def noise_map() -> Environment:
    return Environment(torch.rand(16, 32, 3, generator=torch.Generator().manual_seed(0))).rotated(x=40, y=70, z=-20)


def test_mitsuba_is_given_the_same_light() -> None:
    """Even white noise: 2 H + 1 rows hold the knots of our interpolant; float32 lookups are accurate to 1e-4."""
    environment = noise_map()
    light = mi_load(mitsuba_check.mitsuba_light(environment))
    directions = torch.randn(300, 3, generator=torch.Generator().manual_seed(1))
    directions = torch.nn.functional.normalize(directions, dim=1)
    for direction, expected in zip(directions, environment.radiance(directions), strict=True):
        at = mi.SurfaceInteraction3f()
        at.wi = -mi.Vector3f(direction.tolist())
        assert list(light.eval(at)) == pytest.approx(expected.tolist(), abs=3e-4)


def mi_load(description: dict[str, Any]) -> Any:
    mi.set_variant("scalar_rgb")
    return mi.load_dict(description)


@pytest.mark.parametrize("bounces", [0, 1, 2])
@pytest.mark.parametrize("light", ["constant", "sky", "noise"])
def test_radiance_is_that_of_mitsuba(light: str, bounces: int) -> None:
    """z = difference / standard error over 300 camera rays and three colours.

    Both right: 0.3 % outside 3 (colours go together, so allow 1.5 %: four sigmas of 300 rays are 1.3 %), mean square 1,
    and the mean over all rays within 3.5 of its own error, which is 0.3 % of the radiance.
    """
    environment = {
        "constant": Environment.constant((1.0, 2.0, 0.5)),
        "sky": Environment.gradient_sky().rotated(x=60, y=20),
        "noise": noise_map(),
    }[light]
    result = mitsuba_check.compare(ptt.default_scene(), environment, bounces, rays=300, samples=256, seed=7 + bounces)
    assert result["within_3"] > 0.985
    assert 0.8 < result["z_rms"] < 1.2
    assert result["bias_z"] < 3.5
    assert result["noise"] < 0.08 and abs(result["bias"]) < 0.015


def test_textures_are_refused() -> None:
    scene = ptt.default_scene()
    textured = Region("cloth", texture=Texture(torch.ones(2, 2, 3)))
    with pytest.raises(ValueError, match="no textures"):
        mitsuba_check.mitsuba_scene(replace(scene, regions=(textured, *scene.regions[1:])), Environment.constant())
