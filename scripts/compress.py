"""Compress a traced scene for a space of materials: the model that relight.py evaluates.

    python scripts/compress.py                                      # runs/default/raw.safetensors
    python scripts/compress.py --raw runs/bunny/raw.safetensors --coefficients 256

Writes model.safetensors and compress.json beside the raw file. Next: relight.py or evaluate.py.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import ptt
from ptt.cli import configure, run, save_config


@dataclass
class Config:
    """Defaults; flags override them."""

    raw: Path = Path("runs/default/raw.safetensors")
    """What precompute.py wrote."""
    coefficients: int = 96
    """Haar coefficients kept for each vertex and incident factor: 96 for a preview, 256 below 1 % of error."""
    ranks: tuple[int, int, int] = (4, 24, 24)
    """BRDF, outgoing and incident factors of the BRDF tensor; storage grows with the last."""


def main() -> None:
    config = configure(Config, __doc__ or "")
    raw = ptt.RawTransfer.load(config.raw)

    start = time.perf_counter()
    brdf = ptt.TensorBRDF.fit(ptt.BRDFSpace.blinn_phong(ptt.spaces.MODERATE), ranks=config.ranks, separated=0)
    model = ptt.compress(raw, config.coefficients, brdf, progress=True)
    seconds = time.perf_counter() - start

    print(f"BRDF tensor {tuple(model.brdf.core.shape)}: relative L2 error of each sample of the space")
    for shape, error in zip(model.brdf.space.samples, model.brdf.error.tolist(), strict=True):
        print(f"  {shape}: {error:.4f}")
    print(f"T0, {config.coefficients} coefficients: relative L2 error {model.truncation_error:.4f}")
    path = config.raw.with_name("model.safetensors")
    model.save(path)
    save_config(config, config.raw.with_name("compress.json"))
    print(f"compressed in {seconds:.1f} s; {path}: {path.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    run(main)
