"""Precomputed-transfer relighting on torch.

scene = ptt.load_scene("watch.toml")
model = ptt.compress(ptt.precompute(scene))
relighter = ptt.TransferRelighter(model)
radiance = relighter(ptt.Environment.load("uffizi.hdr"), scene.materials, scene.camera)
ptt.render(scene, scene.camera, radiance).save("watch.png")
"""

from ptt import threads as threads  # first: it is read when torch is imported

# isort: split
from ptt import reference
from ptt.imaging.atlas import Atlas
from ptt.imaging.gbuffer import GBuffer
from ptt.imaging.image import Image, render
from ptt.imaging.metrics import relative_rmse
from ptt.light.environment import Environment
from ptt.materials.material import Material, blinn_phong, cook_torrance, ggx, lambert, metal_rough, ward
from ptt.materials.measured import MERL, NeuralBRDF
from ptt.materials.shapes import GGX, Blend, BlinnPhong, CookTorrance, Named, Ward
from ptt.materials.spaces import BRDFSpace, fitted
from ptt.materials.tabulation import separate, separation_error, tabulated
from ptt.materials.textures import Texture
from ptt.materials.varying import MetalRough, Mixed
from ptt.models.brdf_basis import BRDFBasis
from ptt.models.light_rotation import LightRotation
from ptt.models.tensor_brdf import TensorBRDF, usual_ranks
from ptt.models.transfer_model import TransferModel
from ptt.relight.envmap_relighter import EnvMapRelighter
from ptt.relight.transfer_relighter import TransferRelighter
from ptt.relight.triple_relighter import TripleProductRelighter
from ptt.scene.bumps import BumpMap
from ptt.scene.camera import Camera
from ptt.scene.default import default_scene
from ptt.scene.former import former_names
from ptt.scene.gaps import finer_in_gaps
from ptt.scene.hidden import without_hidden
from ptt.scene.mitsuba_scenes import from_mitsuba
from ptt.scene.scene import Region, Scene
from ptt.scene.scene_files import load_scene
from ptt.transfer.assembly import assemble
from ptt.transfer.clustering import Clusters, cluster
from ptt.transfer.compression import compress
from ptt.transfer.occlusion import ambient_occlusion
from ptt.transfer.raw import RawTransfer, precompute

__version__ = "0.1.0"

former_names()

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
    "MetalRough",
    "Mixed",
    "Named",
    "NeuralBRDF",
    "RawTransfer",
    "Region",
    "Scene",
    "TensorBRDF",
    "Texture",
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
    "default_scene",
    "finer_in_gaps",
    "fitted",
    "from_mitsuba",
    "ggx",
    "lambert",
    "load_scene",
    "metal_rough",
    "precompute",
    "reference",
    "relative_rmse",
    "render",
    "separate",
    "separation_error",
    "tabulated",
    "usual_ranks",
    "ward",
    "without_hidden",
]
