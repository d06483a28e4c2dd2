"""Pictures: the right way up and round, interpolated, with a background."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

import ptt
from ptt.io.images import read_image
from ptt.ops import mesh


def square() -> ptt.Scene:
    """A wall facing +z, seen from the front: its vertex colours are their own positions."""
    vertices = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    return ptt.Scene.from_mesh(vertices, torch.tensor([[0, 1, 2], [0, 2, 3]]))


CAMERA = ptt.Camera((0.0, 0.0, 4.0), (0.0, 0.0, 0.0), fov=20.0, width=64, height=64)


def test_red_grows_to_the_right_green_upwards() -> None:
    scene = square()
    pixels = ptt.render(scene, CAMERA, (scene.vertices + 1) / 2).pixels
    assert pixels[32, 56, 0] > pixels[32, 32, 0] > pixels[32, 8, 0]
    assert pixels[8, 32, 1] > pixels[32, 32, 1] > pixels[56, 32, 1]
    half = 4 * torch.tan(torch.deg2rad(torch.tensor(10.0)))
    x = ((torch.arange(64) + 0.5) / 32 - 1) * half
    assert torch.allclose(pixels[32, :, 0], (x + 1) / 2, atol=1e-4)


def test_constant_radiance_stays_constant_and_misses_see_the_background() -> None:
    scene = ptt.Scene.from_mesh(*mesh.sphere_mesh(3, 0.5))
    light = ptt.Environment.constant((0.2, 0.3, 0.4))
    pixels = ptt.render(scene, CAMERA, torch.full_like(scene.vertices, 0.7), light).pixels
    assert torch.allclose(pixels[32, 32], torch.tensor([0.7, 0.7, 0.7]))
    assert torch.allclose(pixels[0, 0], torch.tensor([0.2, 0.3, 0.4]))
    assert (ptt.render(scene, CAMERA, torch.ones_like(scene.vertices)).pixels[0, 0] == 0).all()


def test_back_faces_are_black() -> None:
    scene = square()
    behind = ptt.Camera((0.0, 0.0, -4.0), (0.0, 0.0, 0.0), fov=20.0, width=8, height=8)
    assert (ptt.render(scene, behind, torch.ones(4, 3)).pixels == 0).all()


def test_antialias_covers_edges_in_part() -> None:
    """The rim of a ball has pixels between black and white; with one ray a pixel it has none."""
    scene = ptt.Scene.from_mesh(*mesh.sphere_mesh(3, 0.5))
    one, four = (ptt.render(scene, CAMERA, torch.ones_like(scene.vertices), antialias=k).pixels for k in (1, 4))
    assert set(one.unique().tolist()) <= {0.0, 1.0} or (one - one.round()).abs().max() < 1e-6
    assert ((four > 0.1) & (four < 0.9)).any()
    assert float(four.mean()) == pytest.approx(float(one.mean()), abs=0.01)


def test_save(tmp_path: Path) -> None:
    image = ptt.Image(torch.full((4, 6, 3), 0.25))
    image.save(tmp_path / "a.exr")
    image.save(tmp_path / "b.exr", exposure=2.0)
    assert torch.equal(read_image(tmp_path / "a.exr"), image.pixels)
    assert torch.allclose(read_image(tmp_path / "b.exr"), torch.ones(4, 6, 3))


def test_exposure_brings_the_brightest_twentieth_to_white() -> None:
    pixels = torch.linspace(0.01, 8.0, 400).reshape(20, 20, 1).expand(-1, -1, 3)
    image = ptt.Image(pixels)
    share = float((pixels * 2.0 ** image.exposure() >= 1 - 1e-6).double().mean())
    assert share == pytest.approx(0.05, abs=0.005)
    assert ptt.Image(torch.zeros(4, 4, 3)).exposure() == 0


def test_refusals() -> None:
    scene = square()
    with pytest.raises(ValueError, match=r"radiance must be finite, \(4, 3\), got \(5, 3\)"):
        ptt.render(scene, CAMERA, torch.zeros(5, 3))
    with pytest.raises(ValueError, match="radiance must be finite"):
        ptt.render(scene, CAMERA, torch.full((4, 3), torch.nan))
    with pytest.raises(ValueError, match="antialias must be at least 1, got 0"):
        ptt.render(scene, CAMERA, torch.zeros(4, 3), antialias=0)
