"""Triangle meshes: normals, tangents, subdivision, textures and shapes against what geometry says."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from ptt.ops import mesh

SHAPES = {
    "sphere": (mesh.sphere_mesh(3, 2.0), 4 / 3 * math.pi * 8, 0.02),
    "box": (mesh.box_mesh((1.0, 2.0, 3.0), 4), 6.0, 1e-6),
    "torus": (mesh.torus_mesh(1.0, 0.4, 96, 48), 2 * math.pi**2 * 0.16, 0.01),
}


def volume(vertices: Tensor, faces: Tensor) -> float:
    """Signed: positive where the faces look outwards (divergence theorem)."""
    a, b, c = vertices.double()[faces].unbind(1)
    return float((a * torch.linalg.cross(b, c)).sum() / 6)


@pytest.mark.parametrize("name", SHAPES)
def test_shapes_are_closed_face_outwards_and_hold_their_volume(name: str) -> None:
    """Inscribed polyhedra hold a little less than the smooth body; a box holds all of it."""
    (vertices, faces), expected, tolerance = SHAPES[name]
    assert -tolerance * expected <= volume(vertices, faces) - expected <= 1e-6 * expected
    assert mesh.face_crosses(vertices, faces).sum(0).abs().max() < 1e-5  # a closed surface's area vector is zero


def test_plane_faces_up_and_has_its_area() -> None:
    vertices, faces = mesh.plane_mesh(2.0, 5)
    assert vertices.shape == (36, 3) and faces.shape == (50, 3)
    torch.testing.assert_close(mesh.face_crosses(vertices, faces).sum(0) / 2, torch.tensor([0.0, 4.0, 0.0]).double())


def test_sphere_normals_point_along_the_radius() -> None:
    """By symmetry within 0.01 rad at 2562 vertices, and on the spot at the icosahedron's corners."""
    vertices, faces = mesh.sphere_mesh(4)
    error = (mesh.vertex_normals(vertices, faces) - vertices).norm(dim=1)
    assert error.max() < 0.01
    assert error[:12].max() < 1e-6


def test_normals_are_weighted_by_angle_not_by_number_of_faces() -> None:
    """At a cube's corner each side has 90 degrees, in one triangle or in two: the normal is the diagonal."""
    box, faces = mesh.box_mesh((1.0, 1.0, 1.0), 1)
    vertices, joined, _ = mesh.weld(box, faces)
    normals = mesh.vertex_normals(vertices, joined)
    torch.testing.assert_close(normals, vertices.double() * 2 / math.sqrt(3))
    counts = torch.bincount(joined.reshape(-1))
    assert int(counts.min()) < int(counts.max())  # weighting by count would have skewed them


def test_corner_angles_sum_to_pi() -> None:
    vertices, faces = mesh.torus_mesh()
    torch.testing.assert_close(
        mesh.corner_angles(vertices, faces).sum(1), torch.full((len(faces),), math.pi, dtype=torch.float64)
    )


def test_normals_do_not_depend_on_scale_or_place() -> None:
    vertices, faces = mesh.torus_mesh()
    v = vertices.double()
    torch.testing.assert_close(mesh.vertex_normals(v * 1e-6 + 3e-4, faces), mesh.vertex_normals(v, faces))


def test_collapsed_triangles_are_found_and_thin_ones_kept() -> None:
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1e-5, 0], [0, 0, 0]])
    faces = torch.tensor([[0, 1, 2], [0, 0, 1], [0, 4, 1], [0, 1, 3]])
    assert mesh.sound_faces(vertices, faces).tolist() == [False, False, False, True]
    assert mesh.sound_faces(vertices * 1e-8, faces).tolist() == [False, False, False, True]


def test_missing_normals_come_from_the_nearest_vertex() -> None:
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0.9, 0, 0]])
    normals = torch.tensor([[0.0, 1, 0], [1, 0, 0], [0, 0, 0]])
    assert mesh.fill_normals(vertices, normals).tolist() == [[0, 1, 0], [1, 0, 0], [1, 0, 0]]
    with pytest.raises(ValueError, match="give a vertex a normal"):
        mesh.fill_normals(vertices, torch.zeros(3, 3))


def test_tangents_are_unit_and_orthogonal_at_every_normal() -> None:
    random = torch.randn(500, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    normals = torch.nn.functional.normalize(random, dim=1)
    normals[:2] = torch.tensor([[0.0, 1, 0], [0, -1, 0]])
    tangents = mesh.tangents(normals, torch.tensor([[0, 1, 2]]), normals)
    assert (tangents.norm(dim=1) - 1).abs().max() < 1e-12
    assert (tangents * normals).sum(1).abs().max() < 1e-12
    assert tangents[:2].tolist() == [[1, 0, 0]] * 2
    assert tangents[2:, 1].abs().max() < 1e-12  # level: world up x normal


def test_level_tangent_at_z_is_x() -> None:
    """(0, 1, 0) x (0, 0, 1) = (1, 0, 0), so that the bitangent is up."""
    z = torch.tensor([[0.0, 0, 1]] * 3)
    assert mesh.tangents(z, torch.tensor([[0, 1, 2]]), z).tolist() == [[1, 0, 0]] * 3


@pytest.mark.parametrize("mirrored", [False, True])
def test_tangents_follow_u(mirrored: bool) -> None:
    """On a plane with u along (1, 0, 1) the tangent is that direction, whichever way v runs."""
    vertices, faces = mesh.plane_mesh(1.0, 3)
    v = vertices[:, 0] - vertices[:, 2]
    uv = torch.stack([vertices[:, 0] + vertices[:, 2], -v if mirrored else v], 1)
    up = torch.tensor([0.0, 1, 0]).expand(16, 3)
    expected = torch.tensor([math.sqrt(0.5), 0, math.sqrt(0.5)], dtype=torch.float64).expand(16, 3)
    torch.testing.assert_close(mesh.tangents(vertices, faces, up, uv), expected)


def test_constant_uv_falls_back_to_the_level_tangent() -> None:
    vertices, faces = mesh.sphere_mesh(2)
    normals = vertices.double()
    flat = mesh.tangents(vertices, faces, normals, torch.zeros(len(vertices), 2))
    torch.testing.assert_close(flat, mesh.tangents(vertices, faces, normals))


def test_subdivision_keeps_the_surface_and_shares_middles() -> None:
    """Euler: a closed sphere has v - e + f = 2 before and after; the volume stays."""
    vertices, faces = mesh.sphere_mesh(2)
    finer, edges = mesh.subdivide(faces, len(vertices))
    points = torch.cat([vertices, vertices[edges].mean(1)])
    assert len(finer) == 4 * len(faces) and len(edges) == len(faces) * 3 // 2
    assert len(points) - len(finer) * 3 // 2 + len(finer) == 2
    assert volume(points, finer) == pytest.approx(volume(vertices, faces), rel=1e-6)


def test_some_edges_cut_leave_the_surface_closed() -> None:
    """Faces with none, one, two and three cut edges meet without a gap, wound as before."""
    vertices, faces = mesh.sphere_mesh(1)
    vertices = vertices * torch.tensor([1.0, 2.0, 0.5])
    corners = vertices[faces]
    cut = (corners - corners.roll(-1, 1)).norm(dim=2) > 0.75
    assert cut.sum(1).unique().tolist() == [0, 1, 2, 3]
    finer, edges = mesh.subdivide(faces, len(vertices), cut)
    points = torch.cat([vertices, vertices[edges].mean(1)])
    directed = torch.stack([finer, finer.roll(-1, 1)], -1).reshape(-1, 2)
    there, back = (set(map(tuple, pairs.tolist())) for pairs in (directed, directed.flip(1)))
    assert there == back and len(there) == len(directed) == 3 * (len(finer))
    assert len(edges) == int(cut.sum()) // 2 and len(finer) == len(faces) + int(cut.sum())
    assert volume(points, finer) == pytest.approx(volume(vertices, faces), rel=1e-6)


def test_weld_joins_equal_positions_only() -> None:
    vertices, faces = mesh.box_mesh((1.0, 1.0, 1.0), 2)
    joined, new, index = mesh.weld(vertices, faces)
    assert len(vertices) == 54 and len(joined) == 26
    assert torch.equal(joined[index], vertices) and torch.equal(joined[new], vertices[faces])


def test_texture_gives_texels_at_their_centres_and_repeats() -> None:
    """Row 0 is v = 1; texel (r, c) of an h x w image has its centre at ((c + .5) / w, 1 - (r + .5) / h)."""
    texture = torch.rand(3, 5, 3)
    row, column = torch.meshgrid(torch.arange(3), torch.arange(5), indexing="ij")
    uv = torch.stack([(column + 0.5) / 5, 1 - (row + 0.5) / 3], -1).reshape(-1, 2)
    for shift in ([0.0, 0.0], [1.0, 0.0], [0.0, -2.0], [-3.0, 4.0]):
        got = mesh.sample_texture(texture, uv + torch.tensor(shift))
        torch.testing.assert_close(got, texture.reshape(-1, 3), atol=1e-5, rtol=0)


def test_texture_is_bilinear_across_the_seam() -> None:
    texture = torch.rand(2, 4, 3)
    uv = torch.tensor([[0.0, 0.75], [0.25, 0.75], [0.125, 0.0]])
    expected = torch.stack(
        [(texture[0, 3] + texture[0, 0]) / 2, (texture[0, 0] + texture[0, 1]) / 2, texture[:, 0].mean(0)]
    )
    torch.testing.assert_close(mesh.sample_texture(texture, uv), expected)


def test_texture_lookup_is_differentiable() -> None:
    texture = torch.rand(3, 3, 3, dtype=torch.float64, requires_grad=True)
    uv = torch.rand(10, 2, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda t: mesh.sample_texture(t, uv), texture)


V, F = mesh.plane_mesh(1.0, 1)
BAD = {
    "vertices must be \\(v, 3\\) floats, got \\(4, 2\\)": (V[:, :2], F),
    "vertices must be \\(v, 3\\) floats.*int64": (V.long(), F),
    "at least one triangle, got \\(0, 3\\)": (V, F[:0]),
    "faces must be \\(f, 3\\) integers, got \\(2, 2\\)": (V, F[:, :2]),
    "faces must be \\(f, 3\\) integers.*float32": (V, F.float()),
    "must index vertices: max index 4 >= 4": (V, F + 1),
    "must index vertices: min index -1 < 0": (V, F - 1),
    "must be finite.*: 2 of 4": (torch.where(torch.arange(4)[:, None] < 2, torch.nan, V), F),
}


@pytest.mark.parametrize("message", BAD)
def test_bad_meshes_are_refused(message: str) -> None:
    with pytest.raises(ValueError, match=message):
        mesh.check_mesh(*BAD[message])


@pytest.mark.parametrize("name", [*SHAPES, "bent"])
def test_dips_leave_out_no_vertex_that_is_seen(name: str) -> None:
    """From any eye, each vertex of a triangle that is turned to it is above the lowest place from where it is seen;
    and so is not much else: of a closed body half is turned away, more where normals are far from the triangles'."""
    if name == "bent":  # a box whose corners have one normal for all three sides
        vertices, faces, _ = mesh.weld(*mesh.box_mesh((1.0, 2.0, 3.0), 4))
    else:
        vertices, faces = SHAPES[name][0]
    normals = mesh.vertex_normals(vertices, faces).float()
    dips = mesh.dips(vertices, faces, normals)
    a = vertices[faces][:, 0]
    flat = mesh.face_crosses(vertices, faces).float()
    shares = []
    for eye in 5 * torch.randn(20, 3, generator=torch.Generator().manual_seed(0)):
        front = ((eye - a) * flat).sum(1) > 0
        height = (torch.nn.functional.normalize(eye - vertices, dim=1) * normals).sum(1)
        seen = height > -dips
        assert bool(seen[faces[front]].all())
        shares.append(float(seen.float().mean()))
    assert sum(shares) / 20 < (0.85 if name == "bent" else 0.6)


def test_dips_where_a_triangle_faces_away_from_its_normals() -> None:
    """It may be seen from anywhere."""
    vertices, faces = mesh.plane_mesh(1.0, 1)
    assert bool((mesh.dips(vertices, faces, -mesh.vertex_normals(vertices, faces).float()) > 1).all())
