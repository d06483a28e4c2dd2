"""Compress a traced scene for a space of materials: the model that relight.py evaluates.

    python scripts/compress.py                                      # runs/default/raw.safetensors
    python scripts/compress.py --raw runs/bunny/raw.safetensors --coefficients 256
    python scripts/compress.py --space fitted --bytes 100e6         # metals; at most 100 MB of clusters

Writes model.safetensors and compress.json beside the raw file. Next: relight.py or evaluate.py.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import ptt
from ptt.cli import Space, chosen_space, configure, run, save_config


@dataclass
class Config:
    """Defaults; flags override them."""

    raw: Path = Path("runs/default/raw.safetensors")
    """The raw transfer that precompute.py wrote."""
    space: Space = "auto"
    """Materials that the model can show: blinn-phong (exponents 1..200), fitted (Cook-Torrance: the 86 of Ngan et al.
    2005 and what lies between), ward or ggx; auto: the space of the shapes that the scene's own materials have."""
    ranks: tuple[int, int, int] | None = None
    """BRDF, outgoing and incident factors of the BRDF tensor; storage grows with the last."""
    lobes: int = 3
    """Lobes, of 0, 7, 14 and 21 degrees, that are taken out of the tensor, for sharp highlights; 0..4."""
    highlights: Literal["lobes", "tensor"] = "lobes"
    """How points reflect glossily: narrow lobes made for each material, or the BRDF tensor and its lobes as in the
    paper, faster and less exact."""
    functions: int = 4
    """Specular functions by which light is reflected on its way."""
    coefficients: int = 96
    """Haar coefficients kept for each vertex and incident factor: 96 for a preview, 256 below 1 % of error."""
    points: int = 250
    """Points of a cluster, on average."""
    eigenvectors: int = 32
    """Eigenvectors of each cluster."""
    lighting: int = 64
    """Dimensions of indirect light in each cluster."""
    bytes: float | None = None
    """Size of all clusters together; --points follows from it."""
    error: float | None = None
    """Relative L2 error that clusters may leave of the transfer; --eigenvectors follows from it."""
    max_memory: float = 10.0
    """Memory that may be in use meanwhile, GB."""


def main() -> None:
    config = configure(Config, __doc__ or "")
    clusters = ptt.Clusters(config.points, config.eigenvectors, config.lighting, bytes=config.bytes, error=config.error)
    raw = ptt.RawTransfer.load(config.raw)
    space = chosen_space(config.space, raw.receivers.materials)

    start = time.perf_counter()
    brdf = ptt.TensorBRDF.fit(space, ranks=config.ranks or ptt.usual_ranks(space), separated=config.lobes)
    basis = ptt.BRDFBasis.fit(space, config.functions)
    fitted = time.perf_counter()
    memory = config.max_memory * 1e9
    model = ptt.compress(
        raw, config.coefficients, brdf, basis, clusters, highlights=config.highlights, max_memory=memory, progress=True
    )
    done = time.perf_counter()

    print("relative L2 error of each sample of the space, by the BRDF tensor and by the basis of indirect light")
    for shape, *errors in zip(space.samples, brdf.error.tolist(), basis.error.tolist(), strict=True):
        print("  {}: {:.4f} {:.4f}".format(shape, *errors))
    print(f"BRDF tensor {tuple(brdf.core.shape)} with {len(brdf.angles)} lobes, {config.functions} functions")
    print(f"T0, {config.coefficients} coefficients: relative L2 error {model.truncation_error:.4f}")
    for name, region in zip(model.receivers.names, model.clustered, strict=True):
        size = sum(buffer.nbytes for buffer in region.buffers())
        clusters_made = f"{len(region.columns)} clusters of {region.eigenvectors} eigenvectors, {size / 1e6:.1f} MB"
        lit_by = f"{len(region.slots)} slots and {len(region.pairs)} pairs"
        print(f"  {name}: {region.points} points, {clusters_made}, lit by {lit_by}")
    path = config.raw.with_name("model.safetensors")
    model.save(path)
    save_config(config, config.raw.with_name("compress.json"))
    print(f"fitted in {fitted - start:.1f} s, compressed in {done - fitted:.1f} s, {model.bounces} bounces")
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    run(main)
