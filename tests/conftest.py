"""Fixtures shared by the tests."""

from __future__ import annotations

import os
import warnings
from pathlib import Path

import pytest
import torch

import ptt
from ptt.ops import native


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real meshes and maps that PTT_DATA names; without it the test is skipped."""
    folder = os.environ.get("PTT_DATA")
    if not folder:
        pytest.skip("needs real meshes and maps: set PTT_DATA to their folder")
    return Path(folder)


@pytest.fixture(scope="session")
def small_scene() -> ptt.Scene:
    """A ball over a floor: 367 vertices, two regions, the floor fixed."""
    from ptt.ops import mesh
    from ptt.scene.parts import Part

    ball, faces = mesh.sphere_mesh(2, 0.5)
    parts = [
        Part("floor", *mesh.plane_mesh(4.0, 13), material=ptt.lambert(0.6), editable=False),
        Part("ball", ball + torch.tensor([0.0, 0.6, 0.0]), faces, material=ptt.blinn_phong(0.3, 0.4, 12.0)),
    ]
    return ptt.Scene.from_parts(parts, camera=ptt.Camera((1.5, 2.0, 3.0), (0.0, 0.4, 0.0), width=48, height=36))


@pytest.fixture(scope="session")
def small_raw(small_scene: ptt.Scene) -> ptt.RawTransfer:
    return ptt.precompute(small_scene, resolution=16)


@pytest.fixture(scope="session")
def small_model(small_raw: ptt.RawTransfer) -> ptt.TransferModel:
    return ptt.compress(
        small_raw,
        64,
        ptt.TensorBRDF.fit(ptt.BRDFSpace.blinn_phong(ptt.materials.spaces.MODERATE), ranks=(3, 10, 10), separated=0),
        clusters=None,
    )


@pytest.fixture(scope="session")
def small_bounced(small_scene: ptt.Scene) -> ptt.RawTransfer:
    return ptt.precompute(small_scene, 2, resolution=16, rays=128)


@pytest.fixture(scope="session")
def glossy() -> tuple[ptt.TensorBRDF, ptt.BRDFBasis]:
    """A small space with lobes: as points reflect, and as light is reflected on its way."""
    space = ptt.BRDFSpace.blinn_phong((2.0, 4.0, 8.0, 16.0, 32.0, 64.0))
    return ptt.TensorBRDF.fit(space, ranks=(3, 8, 8), separated=3), ptt.BRDFBasis.fit(space, 4)


@pytest.fixture(scope="session")
def clustered_model(small_bounced: ptt.RawTransfer, glossy: tuple[ptt.TensorBRDF, ptt.BRDFBasis]) -> ptt.TransferModel:
    """Two bounces and lobes; clusters of about 60 points with 8 eigen-points each; in float32, as exact as it gets."""
    return ptt.compress(small_bounced, 64, *glossy, ptt.Clusters(60, 8, 32, 128, torch.float32))


@pytest.fixture
def built() -> None:
    """For tests of the kernels: skipped where they cannot be built."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if not native.available("view"):
            pytest.skip("no C++ compiler")
