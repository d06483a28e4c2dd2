"""Atlas: every point finds its own texel; overlaps and strays are refused; a texture of visibility against vertices."""

from __future__ import annotations

import pytest
import torch

import ptt
from ptt.imaging.atlas import Atlas
from ptt.ops import mesh, near


@pytest.fixture(scope="module")
def ball() -> ptt.Scene:
    return ptt.Scene.from_mesh(*mesh.sphere_mesh(2), name="ball")


def square() -> ptt.Scene:
    """Two triangles, uv in their own plane."""
    vertices, faces = mesh.plane_mesh(2.0, 1)
    return ptt.Scene.from_mesh(vertices, faces, uv=(vertices[:, [0, 2]] + 1) / 2)


def test_texels_show_their_own_place() -> None:
    """On a square whose uv is its plane, positions at texels are the texels' centres."""
    scene = square()
    assert scene.uv is not None
    atlas = Atlas.of(scene, 8, scene.uv[scene.faces])
    assert len(atlas.triangle) == 64 and atlas.rows.tolist() == list(range(64))
    centre = (torch.arange(8) + 0.5) / 4 - 1
    z, x = torch.meshgrid(centre, centre, indexing="ij")
    wanted = torch.stack((x.flatten(), torch.zeros(64), z.flatten()), 1)
    torch.testing.assert_close(atlas.interpolated(scene, scene.vertices), wanted, rtol=0, atol=1e-5)


def test_lookup_is_linear_between_texels() -> None:
    """A linear function held by texels comes back at any point that is not within half a texel of the border."""
    scene = square()
    assert scene.uv is not None
    atlas = Atlas.of(scene, 16, scene.uv[scene.faces])
    values = atlas.interpolated(scene, scene.vertices)
    g = torch.Generator().manual_seed(0)
    barycentric = torch.distributions.Dirichlet(torch.ones(3)).sample((200,))
    triangle = torch.randint(2, (200,), generator=g)
    rows, weights = near.of_texels(atlas.corner_uv, triangle, barycentric, atlas.rows)
    got = (values[rows.long()] * weights[..., None]).sum(1)
    wanted = (scene.vertices[scene.faces[triangle]] * barycentric[..., None]).sum(1)
    inside = (wanted.abs() < 1 - 1 / 16).all(1)
    assert int(inside.sum()) > 100
    torch.testing.assert_close(got[inside], wanted[inside], rtol=0, atol=1e-5)


def test_xatlas_unwraps_any_mesh(ball: ptt.Scene) -> None:
    """Positions held by texels come back at any point of the surface, to about a texel."""
    atlas = Atlas.of(ball, 128)
    assert 0.3 < len(atlas.triangle) / 128**2 <= 1
    triangle = torch.arange(len(ball.faces)).repeat(3)
    barycentric = torch.distributions.Dirichlet(torch.ones(3)).sample((len(triangle),))
    rows, weights = near.of_texels(atlas.corner_uv, triangle, barycentric, atlas.rows)
    values = atlas.interpolated(ball, ball.vertices)
    got = (values[rows.long()] * weights[..., None]).sum(1)
    wanted = (ball.vertices[ball.faces[triangle]] * barycentric[..., None]).sum(1)
    off = (got - wanted).norm(dim=1)
    assert float(off.median()) < 0.01 and float(off.max()) < 0.2


def test_refuses(ball: ptt.Scene) -> None:
    scene = square()
    assert scene.uv is not None
    uv = scene.uv[scene.faces]
    with pytest.raises(ValueError, match="must not overlap"):
        Atlas.of(scene, 16, uv[:1].expand(2, 3, 2))
    with pytest.warns(UserWarning, match="texels show two triangles"):
        corner = torch.tensor([[0.5, 0.5], [0.54, 0.5], [0.5, 0.54]])  # a sliver of the second over the first
        Atlas.of(scene, 128, torch.stack((torch.tensor([[0.0, 0], [1, 0], [1, 1]]), corner)))
    with pytest.raises(ValueError, match=r"must lie in 0\.\.1: 2 triangles"):
        Atlas.of(scene, 16, uv + 0.5)
    with pytest.raises(ValueError, match=r"corner_uv must be finite \(2, 3, 2\)"):
        Atlas.of(scene, 16, uv[:1])
    with pytest.raises(ValueError, match="no texel"):
        Atlas.of(scene, 4, uv * 0.01)
    with pytest.raises(ValueError, match="size"):
        Atlas.of(scene, 0, uv)


def test_visibility_texture_on_a_coarse_mesh() -> None:
    """A floor of two triangles under a ball has, with a texture, the shadow of a fine floor; without, none."""
    from ptt.scene.parts import Part

    body, faces = mesh.sphere_mesh(2, 0.5)
    ball = Part("ball", body + torch.tensor([0.0, 0.6, 0.0]), faces, material=ptt.lambert(0.5))
    camera = ptt.Camera((1.5, 2.5, 3.0), (0.0, 0.2, 0.0), width=96, height=72)

    def scene(cells: int) -> ptt.Scene:
        floor = Part("floor", *mesh.plane_mesh(4.0, cells), material=ptt.lambert(0.6))
        return ptt.Scene.from_parts([floor, ball], camera=camera)

    sky = ptt.Environment.sun_sky(radius=20.0)

    def picture(of: ptt.Scene, atlas: Atlas | None) -> torch.Tensor:
        relighter = ptt.TripleProductRelighter(of, 2, normals=8, twists=8, source=16, views=8, atlas=atlas)
        pixels = ptt.GBuffer.of(of, camera)
        return pixels.image(relighter(sky, {}, pixels)).pixels

    fine = scene(64)
    coarse = scene(1)
    wanted = picture(fine, None)
    textured = picture(coarse, Atlas.of(coarse, 256))
    plain = picture(coarse, None)
    assert ptt.relative_rmse(textured, wanted) < 0.04
    assert ptt.relative_rmse(plain, wanted) > 3 * ptt.relative_rmse(textured, wanted)


def test_uv_without_area_leave_nothing_undefined() -> None:
    """A triangle that no texel shows reads what the texels next to it hold."""
    scene = square()
    assert scene.uv is not None
    uv = scene.uv[scene.faces].clone()
    uv[1] = uv[1, :1]
    atlas = Atlas.of(scene, 16, uv)
    assert bool((atlas.triangle == 0).all())
    relighter = ptt.TripleProductRelighter(scene, 1, normals=4, twists=4, source=8, views=8, atlas=atlas)
    pixels = ptt.GBuffer.of(scene, ptt.Camera((0.0, 3.0, 0.01), (0.0, 0.0, 0.0), width=16, height=16))
    assert set(pixels.triangle.tolist()) == {0, 1}
    white = {scene.regions[0].name: ptt.lambert(1.0)}
    radiance = relighter(ptt.Environment.constant(), white, pixels)
    torch.testing.assert_close(radiance, torch.ones_like(radiance), rtol=0, atol=0.03)
