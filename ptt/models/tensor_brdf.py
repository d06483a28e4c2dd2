"""A BRDF space as one Tucker tensor over (BRDF, outgoing, incident) on the disk grid (Sun et al. 2007, section 3.2)."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from ptt.materials.material import Material
from ptt.materials.shapes import Shape
from ptt.materials.spaces import BRDF, BRDFSpace
from ptt.models import kept
from ptt.ops import kinds, lobes, separation, transfer, tucker
from ptt.ops.sphere import Disk

RESOLUTION = 32  # texels across the disk; 48 lower the error of exponent 20 from 7.9 to 7.7 %
TRIAL = 16  # texels across the disk on which the number of lobes is decided
IN_MEMORY = 2e9  # bytes of a dense tensor; a larger one is decomposed slice by slice
SPANNED = 1e-4  # of a sample's norm, that other incident factors may leave out
ENOUGH = 1.05, 1e-3  # the fewest lobes whose error is within a twentieth of the least, or below 0.1 %, are chosen


def usual_ranks(space: BRDFSpace) -> tuple[int, int, int]:
    """BRDF, outgoing and incident factors: 4 BRDF factors a model, 16 of either direction."""
    models = {sample.model for sample in space.samples}
    return min(len(space.samples), 4 * len(models)), 16, 16


class TensorBRDF(nn.Module):
    """f(h, wi, wo) ~ sum over h', o, i of core[h', o, i] u_h[h, h'] u_o[o, wo] u_i[i, wi]  +  lobes   (equation 2).

    space: the samples h, and what lies between them
    core (h', o, i), u_h (h, h'), u_o (o, n, n), u_i (i, n, n)
    peaks (h, k, p, t): reflectances of the Gaussian lobes over outgoing directions (`ops.lobes`); k may be 0
    axes (2, k, t): where the lobes point, those of all BRDFs of the space
    error (h,): |what the tensor misses| / |f| of every sample, in L2 by projected solid angle. Lobes
        reflect as much light as the peaks they stand for, from about there; what their round shape misses is not in it

    The fit weighs every sample of the space alike: each is scaled to norm 1 first.

    Example:
        >>> brdf = TensorBRDF.fit(BRDFSpace.blinn_phong((5.0, 10.0, 20.0)), ranks=(3, 12, 12), resolution=24)
        >>> up = torch.tensor([[0.0, 0.0, 1.0]])
        >>> brdf.evaluate(BlinnPhong(10.0), up, up)
    """

    core: Tensor
    u_h: Tensor
    u_o: Tensor
    u_i: Tensor
    peaks: Tensor
    axes: Tensor
    error: Tensor

    def __init__(self, space: BRDFSpace, **parts: Tensor) -> None:
        super().__init__()
        self.space = space
        for name in ("core", "u_h", "u_o", "u_i", "peaks", "axes", "error"):
            self.register_buffer(name, parts[name])

    @classmethod
    def fit(
        cls,
        space: BRDFSpace,
        ranks: Sequence[int] | None = None,
        error: float | None = None,
        separated: int | None = None,
        resolution: int = RESOLUTION,
    ) -> TensorBRDF:
        """Sample the space, separate its lobes and decompose the remainder.

        ranks (h', o, i), or error: the bound on the root mean square of `error`
        separated: how many of the lobes of 0, 7, 14 and 21 degrees are taken out, 0..4. None takes the fewest that
            come near the least error: none for a diffuse space, all for the papers' two

        It takes seconds, once: the result is kept, and found again by the space and the settings, but for a space of
        functions of the user's own.

        Raises:
            ValueError: not exactly one of ranks and error is given, or one is out of range.
        """
        kinds.check("space", space, BRDFSpace)
        settings = {"ranks": ranks, "error": error, "separated": separated, "resolution": resolution}
        parts = kept.fit(
            "BRDF tensor", space, settings, lambda: cls._fitted(space, ranks, error, separated, resolution)
        )
        return cls(space, **parts)

    @classmethod
    def _fitted(
        cls,
        space: BRDFSpace,
        ranks: Sequence[int] | None,
        error: float | None,
        separated: int | None,
        resolution: int,
    ) -> dict[str, Tensor]:
        """The parts of `fit`."""
        if separated is None:
            separated = _fewest_lobes(space, ranks, error)
        samples = Remainders(space.samples, lobes.ANGLES[:separated], resolution)
        fit, missed = samples.decompose(ranks, error)
        u_h, u_o, u_i = fit.factors
        peaks, axes = separation.tables([shape.evaluate for shape in space.samples], space.isotropic, samples.angles)
        return {
            "core": fit.core.contiguous(),
            "u_h": u_h * torch.tensor([samples.norms[h] for h in range(len(samples))], dtype=torch.float32)[:, None],
            "u_o": samples.texels.table(u_o),
            "u_i": samples.texels.table(u_i),
            "peaks": peaks,
            "axes": axes,
            "error": missed,
        }

    @property
    def angles(self) -> tuple[float, ...]:
        """The angles that the lobes cover, in degrees."""
        return lobes.ANGLES[: self.peaks.shape[1]]

    @property
    def bytes(self) -> int:
        """Size of all buffers."""
        return sum(buffer.numel() * buffer.element_size() for buffer in self.buffers())

    def with_brdf(self, name: str, brdf: BRDF | Material) -> TensorBRDF:
        """More samples in the space, a function f(wi, wo) or the shapes of a material's highlights, by name.

        The outgoing and incident factors stay, so transfer that was compressed with them does too; the core gains a
        slice for each, the best there is for these factors. Look at the last of `error`: factors of smooth shapes show
        no sharp one.
        """
        space = self.space.with_brdf(name, brdf)
        new = space.samples[len(self.space.samples) :]
        sampled = Remainders(new, self.angles, self.u_i.shape[-1])
        _, u_o, u_i = self._tucker().factors
        values = torch.stack([sampled[k] for k in range(len(new))]).to(self.core)
        norms = [sampled.norms[k] for k in range(len(new))]
        slices = u_o.T @ values @ u_i
        missed = (values - u_o @ slices @ u_i.T).flatten(1).norm(dim=1)
        polar = lobes.tilts_and_turns(space.isotropic).to(self.peaks)
        axes = lobes.lookup(self.axes.flatten(0, 1)[:, None], polar[0]).unflatten(0, self.axes.shape[:2])
        functions = [sample.evaluate for sample in new]
        peaks, _ = separation.tables(functions, space.isotropic, self.angles, axes)
        parts = {
            "core": torch.cat((self.core, slices)),
            "u_h": torch.block_diag(self.u_h, torch.diag(self.u_h.new_tensor(norms))),
            "u_o": self.u_o,
            "u_i": self.u_i,
            "peaks": torch.cat((torch.stack([lobes.lookup(table, polar) for table in self.peaks]), peaks)),
            "axes": axes,
            "error": torch.cat((self.error, missed)),
        }
        return TensorBRDF(space, **parts)

    @property
    def texels(self) -> Texels:
        """Those that the outgoing and the incident axis of `to_tensorly` run over."""
        return Texels.of(self.u_i.shape[-1]).to(self.core)

    def to_tensorly(self) -> Any:
        """tensorly's TuckerTensor (h, t, t), without the lobes, over samples, outgoing and incident texels.

        A value is f [1/sr] times the roots of the projected solid angles of both texels, so that norms are those of
        `error`, in L2 by projected solid angle. The factors of both directions are orthonormal.

        - tucker_to_tensor(to_tensorly()) / roots / roots[:, None] is f of the samples at `texels.directions`
        - with_tensorly(to_tensorly()) is the same tensor, to the rounding of its type
        """
        return self._tucker().to_tensorly()

    def with_tensorly(self, tucker_tensor: Any) -> TensorBRDF:
        """The same space and lobes with the tensor of a TuckerTensor (h, t, t), at any ranks.

        `error` becomes a bound: what it was and what the tensor is changed by, loose for samples that are mostly lobes.
        `TransferModel.with_parts` puts the result into a model.

        Raises:
            ValueError: another shape, or values that are not finite.
        """
        texels = self.texels
        shape = len(self.space.samples), len(texels.inside), len(texels.inside)
        fit = tucker.Tucker.checked(tucker_tensor, shape, self.core, "brdf").orthonormal((1, 2))
        u_h, u_o, u_i = fit.factors
        return self._with(core=fit.core.contiguous(), u_h=u_h, u_o=texels.table(u_o), u_i=texels.table(u_i))

    def over(self, other: TensorBRDF) -> TensorBRDF:
        """The same tensor by the incident factors of another, with which transfer was compressed.

        Raises:
            ValueError: they leave out more than `SPANNED` of a sample.
        """
        if torch.equal(self.u_i, other.u_i):
            return self
        if self.u_i.shape[1:] != other.u_i.shape[1:]:
            raise ValueError(f"brdf must have {tuple(other.u_i.shape[1:])} texels, got {tuple(self.u_i.shape[1:])}")
        u_i = self.texels.factor(self.u_i)
        others = self.texels.factor(other.u_i)
        turn = others.T @ u_i
        matrices = torch.einsum("sh,hoi->soi", self.u_h, self.core)
        missed = _shares(matrices @ (u_i - others @ turn).T, matrices)
        if bool((missed > SPANNED).any()):
            raise ValueError(
                f"brdf must have incident factors that those of the model combine to, up to {SPANNED:g} of a sample, "
                f"got {float(missed.max()):.2g}: compress the transfer with it"
            )
        return self._with(core=self.core @ turn.T, u_i=other.u_i)

    def _tucker(self) -> tucker.Tucker:
        """The tensor (h, t, t) on the texels, orthonormal in both directions."""
        texels = self.texels
        return tucker.Tucker(self.core, (self.u_h, texels.factor(self.u_o), texels.factor(self.u_i)))

    def _with(self, **parts: Tensor) -> TensorBRDF:
        """The same with other parts of the tensor; what they change adds to the error."""
        made = TensorBRDF(self.space, **{**dict(self.named_buffers()), **parts})
        with torch.no_grad():
            pairs = zip(_slices(self._tucker()), _slices(made._tucker()), strict=True)
            changed = torch.cat([_shares(new - own, own) for own, new in pairs])
            made.error = self.error + (1 + self.error) * changed
        return made

    def matrix(self, shape: Shape | Tensor) -> Tensor:
        """The core (o, i) of a shape: f(wi, wo) = outgoing(wo) . matrix . incident(wi), without its lobes.

        A tensor (h,) in place of the shape: its coordinates in the space.
        """
        mixture = self.space.resolved(shape).to(self.core) @ self.u_h
        return (mixture @ self.core.flatten(1)).reshape(self.core.shape[1:])

    def lobe_tables(self, shape: Shape | Tensor) -> Tensor:
        """The fractions (k, p, t) of the light that the lobes of a shape reflect; read them by `lobes.lookup`.

        A tensor (h,) in place of the shape: its coordinates in the space.
        """
        mixture = self.space.resolved(shape).to(self.peaks)
        return (mixture @ self.peaks.flatten(1)).reshape(self.peaks.shape[1:])

    def coupling(self, material: Material, coloured: Tensor | None = None) -> Tensor:
        """M (3, 1 + o, 1 + i) of a material: diffuse to diffuse, and `matrix` of its highlights, in their colours.

        coloured: its coordinates (h, 3) in the space (`BRDFSpace.coloured`), where they are known
        """
        diffuse = material.diffuse.to(self.core)[:, None, None] / math.pi
        coloured = self.space.coloured(material) if coloured is None else coloured
        mixture = coloured.to(self.core).T @ self.u_h
        specular = (mixture @ self.core.flatten(1)).unflatten(1, self.core.shape[1:])
        top = nn.functional.pad(diffuse, (0, self.core.shape[2]))
        return torch.cat((top, nn.functional.pad(specular, (1, 0))), dim=1)

    def importance(self) -> Tensor:
        """How much each incident factor adds to the picture (1 + i,), the diffuse one first.

        Root mean square, over outgoing directions by projected solid angle and the samples of the space, of what a unit
        of it sends out at albedo 1 and specular weight 1.
        """
        matrices = torch.einsum("sh,hoi->soi", self.u_h, self.core)
        u_o = self.u_o.flatten(1)
        areas = Disk(self.u_o.shape[-1]).projected_solid_angles().flatten().to(self.u_o)
        specular = torch.einsum("soi,op,spi->si", matrices, u_o * areas @ u_o.T, matrices)
        specular = specular.mean(0).div(math.pi).clamp(min=0).sqrt()
        return torch.cat((specular.new_tensor([1 / math.pi]), specular))

    def outgoing(self, wo: Tensor) -> Tensor:
        """Outgoing factors (o, v) of local directions (v, 3); below the horizon those of the mirror image above."""
        return transfer.lookup(self.u_o, wo.T[None])[0]

    def incident(self, wi: Tensor) -> Tensor:
        """Incident factors (i, v) of local directions (v, 3); below the horizon those of the mirror image above."""
        return transfer.lookup(self.u_i, wi.T[None])[0]

    def evaluate(self, shape: Shape, wi: Tensor, wo: Tensor) -> Tensor:
        """The approximated BRDF (...) [1/sr] for local unit directions (..., 3), which broadcast; 0 below the horizon.

        The lobe of 0 degrees is as wide as `ops.lobes.MIRROR`, whatever the shape's own peak is.
        """
        wi, wo = torch.broadcast_tensors(wi, wo)
        batch = wi.shape[:-1]
        wi = wi.reshape(-1, 3)
        wo = wo.reshape(-1, 3)
        value = torch.einsum("ov,oi,iv->v", self.outgoing(wo), self.matrix(shape), self.incident(wi))
        reflected = lobes.lookup(self.lobe_tables(shape), wo)
        value = value + lobes.evaluate(reflected, self.axes, wi, wo, self.angles)
        return (value * ((wi[:, 2] > 0) & (wo[:, 2] > 0))).reshape(batch)


class Texels(NamedTuple):
    """Those texels of a disk grid that lie at least half inside of the unit circle, t of them; the others take no part.

    inside (t,) int64: which of the grid's
    nearest (n * n,) int64: of every texel of the grid, the nearest one of those, 0..t-1
    directions (t, 3): unit vectors
    roots (t,): of their projected solid angles [sr]
    """

    inside: Tensor
    nearest: Tensor
    directions: Tensor
    roots: Tensor

    @classmethod
    def of(cls, resolution: int) -> Texels:
        """Those of a grid of so many texels across."""
        grid = Disk(resolution)
        filled = grid.nearest_inside()
        inside = filled.unique()
        directions = grid.directions().reshape(-1, 3)[inside].float()
        roots = grid.projected_solid_angles().flatten()[inside].sqrt().float()
        return cls(inside, torch.searchsorted(inside, filled), directions, roots)

    def to(self, like: Tensor) -> Texels:
        """The same in the type and on the device of a tensor."""
        inside = self.inside.to(like.device)
        nearest = self.nearest.to(like.device)
        return Texels(inside, nearest, self.directions.to(like), self.roots.to(like))

    def table(self, factor: Tensor) -> Tensor:
        """Functions (k, n, n) on the grid from a factor (t, k), which holds them times the roots.

        The other texels have the nearest one's.
        """
        n = math.isqrt(len(self.nearest))
        return (factor.T / self.roots)[:, self.nearest].reshape(-1, n, n).contiguous()

    def factor(self, table: Tensor) -> Tensor:
        """The inverse of `table`."""
        return (table.flatten(1)[:, self.inside] * self.roots).T


class Remainders(Sequence[Tensor]):
    """What the tensor is fitted to, one slice (o, i) per shape, made when it is asked for.

    A slice is the remainder without lobes times the root of the fitting weights, over the norm of the whole, which
    `norms` keeps.
    """

    def __init__(self, shapes: Sequence[Shape], angles: Sequence[float], resolution: int) -> None:
        self.shapes = shapes
        self.angles = angles
        self.resolution = resolution
        self.texels = Texels.of(resolution)
        d = self.texels.directions
        self.from_mirror = lobes.from_mirror(d, d[:, None])  # shape: (o, i)
        self.norms: dict[int, float] = {}

    def __len__(self) -> int:
        return len(self.shapes)

    def __getitem__(self, h: Any) -> Any:
        shape = self.shapes[h]
        d = self.texels.directions
        values = shape.evaluate(d, d[:, None])  # shape: (o, i)
        weights = self.texels.roots[:, None] * self.texels.roots
        self.norms[h] = float((values * weights).double().norm()) or 1.0
        if self.angles:
            separate = separation.separate_isotropic if shape.isotropic else separation.separate
            found = separate(shape.evaluate, d, self.angles)
            columns = separation.SeparatedLobes(*(part[..., None] for part in found))
            values = separation.remainder(values, self.from_mirror, columns, self.angles)
        return values * (weights / self.norms[h])

    def decompose(self, ranks: Sequence[int] | None, error: float | None) -> tuple[tucker.Tucker, Tensor]:
        """The Tucker decomposition, and the error (h,) of every slice."""
        slices: tucker.Slices = self
        if 4 * len(self) * self.resolution**4 <= IN_MEMORY:
            slices = torch.stack(list(self))
            fit = tucker.decompose(slices, ranks=ranks, error=error)
        else:
            fit = tucker.decompose_slices(slices, ranks=ranks, error=error)
        missed = [(slices[h] - values[0]).norm() for h, values in enumerate(_slices(fit))]
        return fit, torch.stack(missed)


def _slices(fit: tucker.Tucker) -> Iterator[Tensor]:
    """A Tucker tensor (h, o, i), slice by slice (1, o, i)."""
    u_h, *others = fit.factors
    return (tucker.multiply(fit.core, (row[None], *others)) for row in u_h)


def _shares(part: Tensor, whole: Tensor) -> Tensor:
    """|part| / |whole| of every slice (h,) of tensors (h, ...); 0 where both are zero."""
    norms = torch.linalg.vector_norm(part.flatten(1), dim=1)
    return torch.where(norms > 0, norms / torch.linalg.vector_norm(whole.flatten(1), dim=1), 0.0)


def _fewest_lobes(space: BRDFSpace, ranks: Sequence[int] | None, error: float | None) -> int:
    """How many lobes come near the least error at these ranks, or need the fewest factors for this error."""
    counts = range(len(lobes.ANGLES) + 1)
    fits = [Remainders(space.samples, lobes.ANGLES[:k], TRIAL).decompose(ranks, error) for k in counts]
    if error is not None:
        return min(counts, key=lambda k: fits[k][0].core.shape[2])
    errors = [float(missed.square().mean().sqrt()) for _, missed in fits]
    return next(k for k in counts if errors[k] <= max(min(errors) * ENOUGH[0], ENOUGH[1]))
