"""Some vertices of an object that face the eye: their light by the reference, and errors; for bench/metals.py."""

from __future__ import annotations

import torch
from torch import Tensor

import ptt
from bench.table import Table

GRAZING = 0.34  # cosine of 70 degrees
NEGATIVE = -1e-3  # of the mean


def excess(radiance: Tensor, truth: ptt.reference.Estimate) -> float:
    """Relative RMSE of radiance (v, 3), the noise of what it is compared with taken out."""
    square = (radiance - truth.mean).square().mean() - truth.standard_error.square().mean()
    return float(square.clamp(min=0).sqrt() / truth.mean.square().mean().sqrt())


class Seen:
    """Some vertices of a scene's first region that face its eye."""

    def __init__(self, scene: ptt.Scene, count: int) -> None:
        self.scene = scene
        self.eye = torch.as_tensor(scene.camera.eye, dtype=torch.float32)
        self.own = scene.vertex_region == 0
        toward = self.everywhere = scene.camera.toward(scene.points)  # by directions, unseen points have highlights too
        cosine = (toward * scene.frames[:, 2]).sum(1)
        facing = torch.nonzero(self.own & (cosine > 0.05))[:, 0]
        some = torch.randperm(len(facing), generator=torch.Generator().manual_seed(0))[:count]
        self.rows = facing[some].sort().values
        self.toward = toward[self.rows]
        self.points = ptt.reference.vertex_points(scene).take(self.rows)
        self.steep = cosine[self.rows] > GRAZING

    def truth(
        self, light: ptt.Environment, materials: dict[str, ptt.Material], bounces: int, samples: int
    ) -> ptt.reference.Estimate:
        """Light at the vertices."""
        every = self.scene.materials | materials
        return ptt.reference.radiance(
            self.scene, light, every, self.points, self.toward, bounces=bounces, samples=samples
        )

    def unshadowed(
        self, light: ptt.Environment, materials: dict[str, ptt.Material], samples: int
    ) -> ptt.reference.Estimate:
        """Light at the vertices from which nothing hides it."""
        every = self.scene.materials | materials
        return ptt.reference.unshadowed(self.scene, light, every, self.points, self.toward, samples=samples)

    def errors(self, table: Table, what: str, radiance: Tensor, truth: ptt.reference.Estimate, goal: str) -> None:
        """Rows of one picture: steep and grazing views."""
        for name, rows, bound in (("steep", self.steep, goal), ("grazing", ~self.steep, goal and "<= 0.1")):
            own = ptt.reference.Estimate(truth.mean[rows], truth.standard_error[rows])
            how = f"{int(rows.sum())} vertices, noise of the reference {own.noise:.3f}, taken out"
            table.row(f"{what}, {name}", excess(radiance[self.rows][rows], own), "relative RMSE", how, bound)

    def negative(self, table: Table, what: str, radiance: Tensor, goal: str) -> None:
        """The share of vertices of the whole object with a negative value."""
        own = radiance[self.own]
        below = float((own < NEGATIVE * own.mean()).any(1).double().mean())
        table.row(f"{what}, negative", below, "of the vertices", f"below {NEGATIVE} of the mean", goal and "<= 0.001")
