"""The same light change by other means, in the same run: scipy.sparse, torch.sparse, and spherical harmonics."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.sparse import csr_matrix
from scipy.spatial.transform import Rotation
from torch import Tensor

import ptt
from bench.table import Table, median_seconds, setting
from ptt.ops import haar, rotation
from ptt.ops.octahedral import HemiOctahedral, Octahedral
from ptt.ops.rotation import Quantised, Resampling

if TYPE_CHECKING:
    from bench.rotation_errors import Body

ORDERS = (6, 8, 12, 16, 20, 24, 28, 32, 40, 48, 56, 64)


def compare(table: Table, body: Body, light: ptt.Environment, n: int, normals: int) -> None:
    """Light changes a second of every peer, three channels, and its ratio to ours."""
    lit = haar.analyse(light.project(Octahedral(n)).movedim(-1, 0))
    how = f"N {n}^2, {normals} x {normals} normals, three channels; {setting()}"
    ours = ptt.LightRotation.build(n, normals)
    padded = torch.nn.functional.pad(lit, (0, 0, 0, 0, 0, 1))
    seconds = median_seconds(lambda: ours(padded))
    table.row("peer, ours (factored)", 1 / seconds, "1/s", how)
    matrix = ptt.LightRotation.build(n, normals, operator="matrix")
    csr = Quantised(matrix.starts, matrix.columns, matrix.numbers, float(matrix.unit)).to_csr(n * n)
    vector = lit.flatten(1).T.contiguous()

    def report(name: str, took: float, note: str) -> None:
        table.row(
            f"peer, {name}", 1 / took, "1/s", f"{note}; {how}", peer=f"{took / seconds:.3g} times as long as ours"
        )

    report("torch.sparse, R", median_seconds(lambda: csr @ vector, 3), "float32 CSR, int32 indices")
    parts = (x.numpy() for x in (csr.values(), csr.col_indices(), csr.crow_indices()))
    same = csr_matrix(tuple(parts), shape=tuple(csr.shape))
    dense = vector.numpy()
    report("scipy.sparse, R", median_seconds(lambda: same @ dense, 3), "float32 CSR, one thread")
    plain = ptt.LightRotation.build(n, normals, compiled=False)
    report("torch, S and Haar", median_seconds(lambda: plain(lit), 3), "the plain functions of ops.rotation")
    s = Resampling(plain.starts, plain.reads, plain.samples).to_csr(n * n, torch.float32)
    maps = haar.synthesise(lit).flatten(1).T.contiguous()
    report("torch.sparse, S alone", median_seconds(lambda: s @ maps, 3), "float32 CSR, without the transforms")
    harmonics(table, body, light, ours, seconds, how)


def harmonics(
    table: Table, body: Body, light: ptt.Environment, ours: ptt.LightRotation, seconds: float, how: str
) -> None:
    """Rotation of spherical harmonics by pyshtools, at the order whose image error is that of ours."""
    from pyshtools.rotate import SHRotateRealCoef, djpi2

    for material in ("nickel", "gold-metallic-paint"):
        error = body.error(ptt.EnvMapRelighter(body.scene, ours), light, material)
        order, reached = next(
            ((k, e) for k in ORDERS if (e := band_limited_error(body, light, material, k)) <= error), (0, math.inf)
        )
        if not order:
            table.row(f"peer, harmonics, {material}", math.inf, "1/s", f"no order up to {ORDERS[-1]} is as good; {how}")
            continue
        coefficients = np.random.default_rng(0).random((3, 2, order, order))
        quarter = djpi2(order - 1)
        angles = Rotation.from_matrix(ours.frames.double().numpy()).as_euler("ZYZ")

        def rotate_all(c: np.ndarray = coefficients, dj: np.ndarray = quarter, angles: np.ndarray = angles) -> None:
            for angle in angles:
                for channel in c:
                    SHRotateRealCoef(channel, angle, dj)

        took = median_seconds(rotate_all, 3)
        note = f"order {order}, {order**2} coefficients, image error {reached:.4f} beside {error:.4f}; one thread"
        peer = f"{took / seconds:.3g} times as long as ours"
        table.row(f"peer, harmonics (pyshtools), {material}", 1 / took, "1/s", f"{note}; {how}", peer=peer)


def band_limited_error(body: Body, light: ptt.Environment, material: str, order: int) -> float:
    """Image error of a light that has only the harmonics below an order, all else by a fine quadrature."""
    from pyshtools.expand import MakeGridDH, SHExpandDH

    camera = body.scene.camera
    at = body.index[:200]
    given = ptt.fitted(material)
    assert camera is not None
    size = 256
    texels = sampled(light, size)
    spectra = (SHExpandDH(c, sampling=2, lmax_calc=order - 1) for c in texels)
    limited = np.stack([MakeGridDH(c, sampling=2, lmax=size // 2 - 1) for c in spectra])
    grid = HemiOctahedral(96)
    wi = grid.directions().reshape(-1, 3).float()
    weight = (grid.solid_angles() * grid.directions()[..., 2]).flatten().float()
    frames = rotation.frames_of(body.scene.normals[at])
    wo = torch.einsum("vax,vx->va", frames, camera.toward(body.scene.points[at]))
    images = []
    for maps in (texels, limited):
        rows = []
        for frame, out in zip(frames, wo, strict=True):
            f = given.evaluate(wi, out.expand_as(wi)) * weight[:, None]
            rows.append((f * read(torch.from_numpy(maps).float(), wi @ frame)).sum(0))
        images.append(torch.stack(rows))
    return ptt.relative_rmse(images[1], images[0])


def sampled(light: ptt.Environment, size: int) -> np.ndarray:
    """(3, size, 2 size): the light on the grid of Driscoll and Healy, z up; smoothed to its spacing."""
    theta = torch.arange(size).double() * (math.pi / size)
    phi = torch.arange(2 * size).double() * (math.pi / size)
    t, p = torch.meshgrid(theta, phi, indexing="ij")
    directions = torch.stack((t.sin() * p.cos(), t.sin() * p.sin(), t.cos()), -1)
    fine = light.project(Octahedral(256)).reshape(-1, 3)
    return fine[Octahedral(256).cell(directions)].movedim(-1, 0).double().numpy()


def read(maps: Tensor, directions: Tensor) -> Tensor:
    """Nearest values (n, 3) of maps (3, size, 2 size) in world directions (n, 3)."""
    size = maps.shape[1]
    row = (directions[:, 2].clamp(-1, 1).acos() * (size / math.pi)).round().long().clamp(max=size - 1)
    column = (torch.atan2(directions[:, 1], directions[:, 0]) * (size / math.pi)).round().long() % (2 * size)
    return maps[:, row, column].T
