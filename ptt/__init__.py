"""Precomputed-transfer relighting on torch.

scene = ptt.Scene.load("watch.toml")
model = ptt.compress(ptt.precompute(scene))
relighter = ptt.TransferRelighter(model)
radiance = relighter(ptt.Environment.load("uffizi.hdr"), scene.materials, scene.camera)
ptt.render(scene, scene.camera, radiance).save("watch.png")
"""

from ptt import reference
from ptt.assembly import assemble
from ptt.atlas import Atlas
from ptt.bumps import BumpMap
from ptt.clustering import Clusters, cluster
from ptt.compress import compress
from ptt.environment import Environment
from ptt.gbuffer import GBuffer
from ptt.hidden import without_hidden
from ptt.materials import Material, Mixed, blinn_phong, cook_torrance, ggx, lambert, ward
from ptt.measured import MERL, NeuralBRDF
from ptt.metrics import relative_rmse
from ptt.models.brdf_basis import BRDFBasis
from ptt.models.envmap_relighter import EnvMapRelighter
from ptt.models.light_rotation import LightRotation
from ptt.models.tensor_brdf import TensorBRDF
from ptt.models.transfer_model import TransferModel
from ptt.models.transfer_relighter import TransferRelighter
from ptt.models.triple_relighter import TripleProductRelighter
from ptt.occlusion import ambient_occlusion
from ptt.precompute import RawTransfer, precompute
from ptt.render import Image, render
from ptt.scene import Camera, Region, Scene
from ptt.shapes import GGX, Blend, BlinnPhong, CookTorrance, Named, Ward
from ptt.spaces import BRDFSpace, fitted
from ptt.tabulated import separate, tabulated

__all__ = [
    "GGX",
    "MERL",
    "Atlas",
    "BRDFBasis",
    "BRDFSpace",
    "Blend",
    "BlinnPhong",
    "BumpMap",
    "Camera",
    "Clusters",
    "CookTorrance",
    "EnvMapRelighter",
    "Environment",
    "GBuffer",
    "Image",
    "LightRotation",
    "Material",
    "Mixed",
    "Named",
    "NeuralBRDF",
    "RawTransfer",
    "Region",
    "Scene",
    "TensorBRDF",
    "TransferModel",
    "TransferRelighter",
    "TripleProductRelighter",
    "Ward",
    "ambient_occlusion",
    "assemble",
    "blinn_phong",
    "cluster",
    "compress",
    "cook_torrance",
    "fitted",
    "ggx",
    "lambert",
    "precompute",
    "reference",
    "relative_rmse",
    "render",
    "separate",
    "tabulated",
    "ward",
    "without_hidden",
]
