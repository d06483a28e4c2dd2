"""Arguments of another kind are refused in one sentence that names what serves."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

import ptt

SKY = ptt.Environment.constant()
SPACE = ptt.BRDFSpace.blinn_phong([5.0, 20.0])


REFUSED: dict[str, tuple[Callable[[ptt.Scene], object], str]] = {
    "precompute": (lambda scene: ptt.precompute("bunny.ply"), "scene must be a ptt.Scene"),  # type: ignore[arg-type]
    "compress": (lambda scene: ptt.compress(scene), "raw must be a ptt.RawTransfer"),  # type: ignore[arg-type]
    "occlusion": (lambda scene: ptt.ambient_occlusion(None), "scene must be a ptt.Scene"),  # type: ignore[arg-type]
    "hidden": (lambda scene: ptt.without_hidden("a.obj"), "scene must be a ptt.Scene"),  # type: ignore[arg-type]
    "gaps": (lambda scene: ptt.finer_in_gaps("a.obj"), "scene must be a ptt.Scene"),  # type: ignore[arg-type]
    "tensor": (lambda scene: ptt.TensorBRDF.fit("ggx"), "space must be a ptt.BRDFSpace"),  # type: ignore[arg-type]
    "basis": (lambda scene: ptt.BRDFBasis.fit("ggx"), "space must be a ptt.BRDFSpace"),  # type: ignore[arg-type]
    "transfer": (lambda scene: ptt.TransferRelighter(scene), "model must be a ptt.TransferModel"),  # type: ignore[arg-type]
    "envmap": (lambda scene: ptt.EnvMapRelighter("a.obj"), "scene must be a ptt.Scene"),  # type: ignore[arg-type]
    "triple": (lambda scene: ptt.TripleProductRelighter("a.obj"), "scene must be a ptt.Scene"),  # type: ignore[arg-type]
    "pixels": (lambda scene: ptt.GBuffer.of(scene.camera, scene), "scene must be a ptt.Scene"),  # type: ignore[arg-type]
    "atlas": (lambda scene: ptt.Atlas.of("a.obj"), "scene must be a ptt.Scene"),  # type: ignore[arg-type]
    "picture": (lambda scene: ptt.render(scene, SKY, torch.ones(3)), "camera must be a ptt.Camera"),  # type: ignore[arg-type]
    "background": (
        lambda scene: ptt.render(scene, scene.camera, scene.vertices, scene.camera),  # type: ignore[arg-type]
        "environment must be a ptt.Environment",
    ),
    "reference": (
        lambda scene: ptt.reference.at_vertices(scene, scene.materials, SKY, scene.camera),  # type: ignore[arg-type]
        "environment must be a ptt.Environment",
    ),
    "materials": (
        lambda scene: ptt.reference.at_vertices(scene, SKY, ptt.lambert(), scene.camera),  # type: ignore[arg-type]
        "materials must map regions to materials",
    ),
    "shape": (lambda scene: ptt.Material(0.2, 0.5, torch.dot), r"shape must be .* Named\(name, f\) of a function"),  # type: ignore[arg-type]
    "picture of the reference": (
        lambda scene: ptt.reference.image(scene, SKY, scene.materials, None),  # type: ignore[arg-type]
        "camera must be a ptt.Camera",
    ),
}


@pytest.mark.parametrize("call", REFUSED)
def test_another_kind_is_refused_by_name(small_scene: ptt.Scene, call: str) -> None:
    refused, message = REFUSED[call]
    with pytest.raises(ValueError, match=message):
        refused(small_scene)


def test_settings_of_another_kind_are_refused_before_the_work(small_raw: ptt.RawTransfer) -> None:
    with pytest.raises(
        ValueError, match=r"clusters must be a ptt.Clusters \(such as ptt.Clusters\(points=1000\)\), got int"
    ):
        ptt.compress(small_raw, clusters=1000)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"brdf must be a ptt.TensorBRDF"):
        ptt.compress(small_raw, brdf=SPACE)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"basis must be a ptt.BRDFBasis"):
        ptt.compress(small_raw, basis=SPACE)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"transfer must be a ptt.Transfer"):
        ptt.cluster(small_raw)  # type: ignore[arg-type]
