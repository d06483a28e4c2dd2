"""Raw transfer -> compressed model: the part of T0, T1 and T2 that a scene, its materials and the accuracy require."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import get_args

from ptt.materials.spaces import BRDFSpace
from ptt.materials.varying import SurfaceMaterial
from ptt.models.brdf_basis import BRDFBasis
from ptt.models.tensor_brdf import TensorBRDF, usual_ranks
from ptt.models.transfer_model import Highlights, SparseTransfer, TransferModel
from ptt.ops import kinds
from ptt.ops.haar import Truncated
from ptt.ops.sphere import Cube
from ptt.transfer.assembly import assemble, direct_light
from ptt.transfer.clustering import Clusters, cluster
from ptt.transfer.raw import RawTransfer

SEPARATED_LOBES = 3  # lobes of the default tensor, of 0, 7 and 14 degrees; each costs time and storage at every point


def compress(
    raw: RawTransfer,
    coefficients: int | None = 96,
    brdf: TensorBRDF | None = None,
    basis: BRDFBasis | None = None,
    clusters: Clusters | None = Clusters(),  # noqa: B008 (frozen)
    *,
    editable: Sequence[SurfaceMaterial | BRDFSpace] = (),
    highlights: Highlights | None = None,
    max_memory: float = 10e9,
    progress: bool = False,
) -> TransferModel:
    """Transfer to every point, as far as the scene and the accuracy require.

    coefficients: Haar coefficients of T0 kept, on average over a point's factors; None keeps all, the paper keeps 96
    brdf: the materials that the model can show, as they reflect at the points; default: all of the models of the
        scene's own materials and of `editable` (`BRDFSpace.holding`), Blinn-Phong where there are none, at
        `usual_ranks`
    basis: the same space as it reflects light on its way; default: four functions and the diffuse one
    clusters: how points share eigen-points; None keeps every point's own T0, for direct light alone and without lobes:
        exact, but 10 to 100 times as large and as slow to light anew
    editable: materials and spaces that shall be shown too; printing the model tells what it shows
    highlights: how points reflect glossily: "lobes", narrow ones made for each material, which hold for plastics and
        metals alike (docs/metals.md); or "tensor", the BRDF tensor and its lobes, as in the paper, three to five times
        as fast. Default: lobes; the tensor where `brdf` is given, and where there are no clusters. A saved model lacks
        the functions of BRDFs of your own: lobes ask for them when it relights, the tensor holds what it needs
    max_memory: bytes that may be in use
    progress: show bars with the rate and the time left

    To try several `clusters` on the same transfer: `ptt.assemble` once, then `ptt.cluster`.

    Raises:
        ValueError: coefficients are out of range, basis and brdf have different spaces, indirect light or lobes have no
            clusters, there is too little memory, or `brdf` does not show the material of a fixed region, or `editable`.

    Sun et al. 2007, sections 3.3 and 4.3; Ng et al. 2003 for the weighting by area.
    """
    kinds.check("raw", raw, RawTransfer)
    kinds.check("brdf", brdf, (TensorBRDF, type(None)))
    kinds.check("basis", basis, (BRDFBasis, type(None)))
    kinds.check("clusters", clusters, (Clusters, type(None)))
    if highlights not in (*get_args(Highlights), None):
        raise ValueError(f"highlights must be one of {', '.join(get_args(Highlights))}, got {highlights!r}")
    if clusters is None and highlights == "lobes":
        raise ValueError('highlights="lobes" needs clusters, got None')
    if clusters is None and raw.bounces:
        raise ValueError("light that bounces needs clusters, got None")
    own = raw.receivers
    highlights = highlights or ("lobes" if brdf is None and clusters is not None else "tensor")
    if brdf is None:
        space = BRDFSpace.holding([*own.materials.values(), *editable])
        _check_shown(space, own.materials)
        brdf = TensorBRDF.fit(space, usual_ranks(space), separated=SEPARATED_LOBES if clusters else 0)
    elif editable:
        raise ValueError("editable is for the brdf that is made here: fit the given one to BRDFSpace.holding(...)")
    _check_shown(brdf.space, {n: own.materials[n] for n, may in zip(own.names, own.editable, strict=True) if not may})
    if clusters is not None:
        basis = basis or BRDFBasis.fit(brdf.space)
        transfer = assemble(
            raw, brdf, basis, coefficients, highlights=highlights, max_memory=max_memory, progress=progress
        )
        return cluster(transfer, clusters, progress=progress)
    if brdf.angles:
        raise ValueError("brdf must be fitted with separated=0: without clusters no lobes are shown")
    direct = direct_light(raw, brdf, coefficients, progress)
    largest = Truncated(direct.indices, direct.values)
    sparse = SparseTransfer.of(largest, direct.coarse.shape[1], Cube(raw.resolution).cells)
    return TransferModel(raw.receivers, brdf, None, raw.resolution, 0, sparse, [], direct.error)


def _check_shown(space: BRDFSpace, materials: Mapping[str, SurfaceMaterial]) -> None:
    """Refuse materials of regions that a space does not hold, before anything takes long."""
    for name, material in materials.items():
        try:
            for layer in material.layers:
                space.coloured(layer)
        except ValueError as error:
            raise ValueError(f"region {name!r}: {error}") from None
