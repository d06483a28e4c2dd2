"""The installed wheel alone: its version, its data, a ball over a floor relit. To be run outside of the checkout."""

import sys
from pathlib import Path

import torch

import ptt
from ptt.ops import mesh
from ptt.scene.parts import Part

folder = Path(ptt.__file__).parent
print(f"ptt {ptt.__version__} in {folder}")
if not folder.is_relative_to(sys.prefix):
    raise SystemExit(f"ptt must come from {sys.prefix}")
sources = {path.suffix for path in (folder / "ops" / "native").iterdir()}
if not {".cpp", ".h"} <= sources or not (folder / "py.typed").exists():
    raise SystemExit("the wheel lacks the sources of the kernels, or py.typed")

ball, faces = mesh.sphere_mesh(2, 0.5)
parts = [
    Part("floor", *mesh.plane_mesh(4.0, 13), material=ptt.lambert(0.6)),
    Part("ball", ball + torch.tensor([0.0, 0.6, 0.0]), faces, material=ptt.fitted("gold-metallic-paint")),
]
scene = ptt.Scene.from_parts(parts)
brdf = ptt.TensorBRDF.fit(ptt.BRDFSpace.fitted(), ranks=(3, 8, 8), separated=0)
model = ptt.compress(ptt.precompute(scene, 0, resolution=16), 64, brdf, clusters=None)
radiance = ptt.TransferRelighter(model)(ptt.Environment.sun_sky(), scene.materials, scene.camera)
shadow, sunlit = radiance[scene.vertex_region == 0].sum(1).aminmax()
print(f"{len(radiance)} vertices relit, the floor from {shadow:.3f} to {sunlit:.3f}")
if not (radiance.isfinite().all() and 0 < 2 * shadow < sunlit):
    raise SystemExit("the ball casts no shadow")
