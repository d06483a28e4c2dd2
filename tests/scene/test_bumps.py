"""Bump maps: what they bend, and what they repair and refuse."""

from __future__ import annotations

import math

import pytest
import torch

import ptt
from ptt.ops import mesh
from ptt.scene.parts import Part


def floor(uv: bool = True) -> ptt.Scene:
    """A level square whose u grows along x, v against z."""
    vertices, faces = mesh.plane_mesh(2.0, 1)
    coordinates = torch.stack((vertices[:, 0] / 2 + 0.5, 0.5 - vertices[:, 2] / 2), 1)
    camera = ptt.Camera((0.0, 3.0, 0.01), (0.0, 0.0, 0.0), width=24, height=24)
    return ptt.Scene.from_parts([Part("floor", vertices, faces, uv=coordinates if uv else None)], camera=camera)


def test_a_flat_map_changes_nothing() -> None:
    scene = floor()
    flat = ptt.BumpMap(torch.tensor([0.0, 0.0, 2.0]).expand(4, 4, 3))
    plain, bent = (ptt.GBuffer.of(scene, scene.camera, bumps) for bumps in (None, {"floor": flat}))
    torch.testing.assert_close(bent.frames, plain.frames, rtol=0, atol=1e-6)


@pytest.mark.parametrize(("axis", "local"), [(0, (1.0, 0.0)), (2, (0.0, -1.0))])
def test_normals_follow_u_and_v(axis: int, local: tuple[float, float]) -> None:
    """Leaned by 30 degrees along u (world x) or against v (world z), everywhere."""
    leaned = torch.tensor([0.5 * local[0], 0.5 * local[1], math.cos(math.pi / 6)])
    scene = floor()
    frames = ptt.GBuffer.of(scene, scene.camera, {"floor": ptt.BumpMap(leaned.expand(2, 2, 3))}).frames
    wanted = torch.zeros(3)
    wanted[1], wanted[axis] = math.cos(math.pi / 6), 0.5
    torch.testing.assert_close(frames[:, 2], wanted.expand(len(frames), 3), rtol=0, atol=1e-5)
    torch.testing.assert_close(frames @ frames.mT, torch.eye(3).expand(len(frames), 3, 3), rtol=0, atol=1e-5)


@pytest.mark.parametrize(("axis", "local"), [(0, (-1.0, 0.0)), (2, (0.0, -1.0))])
def test_normals_follow_mirrored_u_and_v(axis: int, local: tuple[float, float]) -> None:
    """The same with u against world x: the bitangent then points against v."""
    leaned = torch.tensor([0.5 * local[0], 0.5 * local[1], math.cos(math.pi / 6)])
    plain = floor()
    assert plain.uv is not None
    vertices, faces = mesh.plane_mesh(2.0, 1)
    uv = plain.uv * torch.tensor([-1.0, 1.0])
    part = Part("floor", vertices, faces, uv=uv, bumps=ptt.BumpMap(leaned.expand(2, 2, 3)))
    scene = ptt.Scene.from_parts([part], camera=plain.camera)
    normals = ptt.GBuffer.of(scene, scene.camera).frames[:, 2]
    wanted = torch.zeros(3)
    wanted[1], wanted[axis] = math.cos(math.pi / 6), 0.5
    torch.testing.assert_close(normals, wanted.expand(len(normals), 3), rtol=0, atol=1e-5)


def test_a_scene_has_bumps_of_its_own() -> None:
    """Unless others are given."""
    vertices, faces = mesh.plane_mesh(2.0, 1)
    plain = floor()
    own, other = (ptt.BumpMap(torch.rand(4, 4, 3, generator=torch.Generator().manual_seed(k)) + 0.2) for k in (0, 1))
    scene = ptt.Scene.from_parts([Part("floor", vertices, faces, uv=plain.uv, bumps=own)], camera=plain.camera)
    for bumps, expected in ((None, own), ({"floor": other}, other)):
        found = ptt.GBuffer.of(scene, scene.camera, bumps).frames
        torch.testing.assert_close(found, ptt.GBuffer.of(plain, plain.camera, {"floor": expected}).frames)


def test_heights() -> None:
    """A wave along u: its slope is the derivative, 2 pi depth cos; v has none."""
    u = (torch.arange(256) + 0.5) / 256
    bump = ptt.BumpMap.of_heights(torch.sin(2 * math.pi * u).expand(8, 256), 0.02)
    slope = -bump.normals[..., 0] / bump.normals[..., 2]
    torch.testing.assert_close(slope, (0.04 * math.pi * torch.cos(2 * math.pi * u)).expand(8, 256), rtol=0, atol=1e-4)
    assert not bool(bump.normals[..., 1].any())
    up = ptt.BumpMap.of_heights(torch.tensor([[0.0], [1.0], [0.0], [0.0]]), 0.1)  # row 1 is high: v grows upwards
    assert float(up.normals[0, 0, 1]) > 0 > float(up.normals[2, 0, 1])


def test_saved_map_is_read_back(tmp_path: object) -> None:
    normals = ptt.BumpMap(torch.rand(8, 8, 3, generator=torch.Generator().manual_seed(0)) + 0.2).normals
    path = f"{tmp_path}/bump.png"
    from ptt.io.colour import from_srgb
    from ptt.io.images import write_image

    write_image(path, from_srgb((normals + 1) / 2))
    torch.testing.assert_close(ptt.BumpMap.load(path).normals, normals, rtol=0, atol=0.01)


def test_below_the_surface_is_raised_and_counted() -> None:
    normals = torch.tensor([[[0.0, 0.0, 1.0], [1.0, 0.0, -1.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]])
    with pytest.warns(UserWarning, match="3 of 4 normals lie below"):
        bump = ptt.BumpMap(normals)
    assert bool((bump.normals[..., 2] >= 0.0499).all())
    torch.testing.assert_close(bump.normals.norm(dim=2), torch.ones(1, 4))
    scene = floor()
    with pytest.warns(UserWarning, match="lie below"):
        steep = ptt.BumpMap(torch.tensor([1.0, 0.0, -0.2]).expand(2, 2, 3))  # along the tangent, but for 3 degrees
    pixels = ptt.GBuffer.of(scene, scene.camera, {"floor": steep})
    relighter = ptt.TripleProductRelighter(scene, 1, normals=4, twists=4, source=8, views=8)
    radiance = relighter(ptt.Environment.constant(), {"floor": ptt.blinn_phong(0.3, 0.3, 9.0)}, pixels)
    assert bool(radiance.isfinite().all()) and bool((radiance > 0).all())


def test_frames_that_interpolation_leaves_none_are_repaired_and_counted() -> None:
    normals = torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    tangents = torch.tensor([[0.0, 2.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    frames, repaired = mesh.frames(normals, tangents, lambda rows: torch.tensor([[0.0, 0.0, 1.0]]).expand(len(rows), 3))
    assert repaired == 2
    torch.testing.assert_close(frames @ frames.mT, torch.eye(3).expand(3, 3, 3), rtol=0, atol=1e-6)
    torch.testing.assert_close(frames.det(), torch.ones(3))
    assert torch.equal(frames[1], torch.eye(3)) and torch.equal(frames[0, 2], normals[0])
    vertices, faces = mesh.plane_mesh(2.0, 1)
    opposed = torch.tensor([0.0, 1.0, 0.0]) * torch.tensor([1.0, 1.0, 1.0, -1.0])[:, None]
    scene = ptt.Scene.from_mesh(vertices, faces, normals=opposed)
    halfway = ((faces[0] == 3) | (faces[0] == 0)).float() / 2
    with pytest.warns(UserWarning, match="1 of 2 frames between vertices"):
        got = scene.frames_at(torch.tensor([0, 0]), torch.stack((halfway, (faces[0] == 0).float())))
    assert bool(got.isfinite().all())


def test_refuses() -> None:
    for normals, message in (
        (torch.ones(4, 4), r"\(h, w, 3\)"),
        (torch.zeros(2, 2, 3), "4 of 4 are not"),
        (torch.full((1, 1, 3), math.nan), "1 of 1 are not"),
    ):
        with pytest.raises(ValueError, match=message):
            ptt.BumpMap(normals)
    with pytest.raises(ValueError, match=r"\(h, w\)"):
        ptt.BumpMap.of_heights(torch.ones(3))
    flat = ptt.BumpMap(torch.tensor([[[0.0, 0.0, 1.0]]]))
    with pytest.raises(ValueError, match="no region 'lid'"):
        ptt.GBuffer.of(floor(), floor().camera, {"lid": flat})
    with pytest.raises(ValueError, match="needs uv"):
        ptt.GBuffer.of(floor(uv=False), floor().camera, {"floor": flat})
