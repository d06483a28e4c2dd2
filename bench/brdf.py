"""BRDF spaces: every figure of them, as rows of bench/results/brdf.csv.

    PTT_DATA=... python -m bench.brdf             # 8 minutes on two cores
    PTT_DATA=... python -m bench.brdf --quick     # three minutes: fewer samples, ranks and pixels; written nowhere

Needs PTT_DATA with hdri/uffizi.hdr. Pictures go to docs/images.
"""

from __future__ import annotations

import argparse
import math
import os
import statistics
import tempfile
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path

import torch
from torch import Tensor

import ptt
from bench import tucker_peer
from bench.spheres import Sphere, save_rows
from bench.table import ROOT, Table, median_seconds, setting
from ptt.materials.shapes import Shape
from ptt.models.brdf_basis import principal
from ptt.models.tensor_brdf import Remainders
from ptt.ops import lobes, tucker
from ptt.ops.albedo import albedo

IMAGES = ROOT / "docs" / "images"
INTEGERS = tuple(float(n) for n in range(1, 201))  # the paper's exponents
MATERIALS = ("red-fabric", "gold-metallic-paint", "cherry-235", "nickel", "green-metallic-paint2", "hematite")
TERMS = range(4, 33, 4)
DISK = "812 texels of a 32 x 32 disk, samples at their centres"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="three minutes: fewer samples; written nowhere")
    quick = parser.parse_args().quick
    if "PTT_DATA" not in os.environ:
        parser.error("set PTT_DATA to the folder with hdri/uffizi.hdr")
    light = ptt.Environment.load(Path(os.environ["PTT_DATA"]) / "hdri" / "uffizi.hdr")
    IMAGES.mkdir(parents=True, exist_ok=True)
    table = Table("brdf")
    step = 6 if quick else 1
    shapes = {
        "Cook-Torrance": ptt.BRDFSpace.fitted().samples[::step],
        "Blinn-Phong": ptt.BRDFSpace.blinn_phong(INTEGERS).samples[:: 4 * step],
    }
    spaces = {"Cook-Torrance": ptt.BRDFSpace.fitted(), "Blinn-Phong": ptt.BRDFSpace.blinn_phong()}
    energy(table, quick)
    for name, samples in shapes.items():
        figure_5(table, name, samples, quick)
    figure_6(table, light, pixels=32 if quick else 96, samples=128 if quick else 4096, pictures=not quick)
    for name, space in spaces.items():
        basis(table, name, space, shapes[name])
    between_samples(table, spaces)
    against_tensorly(table, shapes["Cook-Torrance"], quick)
    editing(table)
    if not quick:
        table.write()


def energy(table: Table, quick: bool) -> None:
    """The largest white-furnace albedo of every model, over its parameters and all angles."""
    tilts = [0.0, 15.0, 30.0, 45.0, 60.0, 70.0, 75.0, 80.0, 85.0, 88.0, 89.0, 89.9, 89.999][:: 3 if quick else 1]
    wo = torch.tensor([[math.sin(math.radians(t)), 0.0, math.cos(math.radians(t))] for t in tilts]).double()
    widths = (1e-4, 1e-3, 0.01, 0.03, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0)
    models: dict[str, Iterator[tuple[str, Shape]]] = {
        "Blinn-Phong": ((f"exponent {n:g}", ptt.BlinnPhong(n)) for n in (0, 1, 2, 5, 20, 100, 1e3, 1e4, 1e6)),
        "Cook-Torrance": (
            (f"F0 {f:g}, m {m:g}", ptt.CookTorrance(f, m)) for f, m in product((0.0, 0.04, 0.5, 1.0), widths)
        ),
        "Ward": ((f"slope {a:g}", ptt.Ward(a)) for a in widths),
        "Ward, slopes 4 : 1": ((f"slopes {a:g}, {a / 4:g}", ptt.Ward(a, a / 4)) for a in widths[1:]),
        "GGX": ((f"F0 {f:g}, roughness {r:g}", ptt.GGX(f, r)) for f, r in product((0.0, 0.04, 0.5, 1.0), widths)),
    }
    for model, shapes in models.items():
        best = 0.0
        where = ""
        over = 0
        for parameters, shape in shapes:
            values = albedo(shape.evaluate, wo, turns=48 if shape.isotropic else 160)
            over += int(values.max() > 1.001)
            if float(values.max()) > best:
                best = float(values.max())
                where = f"{parameters}, {tilts[int(values.argmax())]:g} degrees"
        how = f"at {where}; above 1.001 at {over} of the parameters tried; ops.albedo"
        table.row(f"largest albedo, {model}", best, "", how, "" if model == "Cook-Torrance" else "<= 1.001")


def remainders(samples: tuple[Shape, ...], angles: tuple[float, ...]) -> tuple[Tensor, Tensor]:
    """What lobes leave (h, o, i), by projected solid angle, and the norm (h,) of the whole."""
    slices = Remainders(samples, angles, 32)
    left = torch.stack(list(slices))
    norms = torch.tensor([slices.norms[h] for h in range(len(slices))], dtype=torch.float64)
    return left * norms.float()[:, None, None], norms


def figure_5(table: Table, name: str, samples: tuple[Shape, ...], quick: bool) -> None:
    """Squared relative error against n_h and n_i, with and without lobes; |f|^2, lobes included, is 1."""
    for lobed, angles in (("without lobes", ()), ("with lobes", lobes.ANGLES)):
        left, norms = remainders(samples, angles)
        for scaled in (False, True):
            tensor = left / norms.float()[:, None, None] if scaled else left
            whole = float(len(samples)) if scaled else float(norms.square().sum())
            kind = "each material scaled to 1" if scaled else "unscaled"
            how = f"{len(samples)} materials, {kind}; {DISK}; ST-HOSVD, n_o = n_i"
            for n_h, n_i, error in sweep(tensor, range(1, 7) if not quick else (1, 4), TERMS if not quick else (4, 32)):
                what = f"figure 5, {name}, {kind}, {lobed}, n_h {n_h}, n_i {n_i}"
                paper = "0.952465" if (name, lobed, n_h, n_i) == ("Cook-Torrance", "without lobes", 6, 32) else ""
                table.row(what, error / whole, "", how, paper=paper)


def sweep(tensor: Tensor, heights: Sequence[int], terms: Sequence[int]) -> Iterator[tuple[int, int, float]]:
    """Squared errors for every pair of ranks: what projecting on h loses, plus the rest's; they are orthogonal."""
    u_h = tucker.decompose(tensor, ranks=(max(heights), 1, 1)).factors[0]
    for n_h in heights:
        part = torch.einsum("hk,hoi->koi", u_h[:, :n_h], tensor)
        kept = (torch.einsum("k,koi->oi", row[:n_h], part) for row in u_h)
        lost = sum(float((a - b).double().square().sum()) for a, b in zip(tensor, kept, strict=True))
        for n in terms:
            fit = tucker.decompose(part, ranks=(n_h, n, n))
            yield n_h, n, lost + float((part - fit.to_dense()).double().square().sum())


def figure_6(table: Table, light: ptt.Environment, pixels: int, samples: int, pictures: bool) -> None:
    """Spheres with 0 to 4 lobes beside the path tracer, under uffizi."""
    space = ptt.BRDFSpace.fitted()
    sphere = Sphere(pixels)
    truths = [sphere.truth(space.material(name), light, samples) for name in MATERIALS]
    rows = [[sphere.picture(truth.mean)] for truth in truths]
    gains = [0.4 / float(truth.mean.mean()) for truth in truths]
    for ranks, counts in (((4, 8, 8), range(5)), ((6, 16, 16), (4,)), ((6, 40, 40), (4,))):
        for count in counts:
            fit = ptt.TensorBRDF.fit(space, ranks, separated=count)
            incident = sphere.incident(fit, light)
            mirrored = sphere.mirrored(fit, light)
            for k, (name, truth) in enumerate(zip(MATERIALS, truths, strict=True)):
                relit = sphere.relit(fit, space.material(name), incident, mirrored)
                noise = truth.noise
                shape = space.material(name).shape
                how = f"{shape}, uffizi, {pixels} x {pixels} pixels; noise of the reference {noise:.4f}"
                what = f"figure 6, {name}, {count} lobes, {ranks[1]} factors"
                table.row(what, ptt.relative_rmse(relit, truth.mean), "relative RMSE", how)
                rows[k].append(sphere.picture(relit))
                if count == 4:
                    rows[k].append(sphere.picture(0.5 / gains[k] + (relit - truth.mean)))
    if pictures:
        save_rows(IMAGES / "figure6.png", [row[:7] for row in rows], gains)


def basis(table: Table, name: str, space: ptt.BRDFSpace, samples: tuple[Shape, ...]) -> None:
    """Squared error of the PCA basis at 4 + 1 functions, on the paper's presumable measure and on ours."""
    paper = {"Cook-Torrance": "6.23e-4", "Blinn-Phong": "1.61e-7"}[name]
    tensor, norms = remainders(samples, ())
    flat = tensor.flatten(1)
    gram = sum((part.double() @ part.double().T for part in flat.split(1 << 16, 1)), torch.zeros(()))
    for kind, scale in (("unscaled", torch.ones_like(norms)), ("each material scaled to 1", 1 / norms)):
        scaled = gram * scale * scale[:, None]
        size, _ = principal(scaled, 4)
        error = 1 - float(size.sum() / scaled.trace())
        how = f"{len(samples)} materials; {DISK}, projected solid angle"
        table.row(f"PCA, {name}, squared error at 4 + 1 functions, disk, {kind}", error, "", how, paper=paper)
    for functions in (4, 8):
        fit = ptt.BRDFBasis.fit(space, functions)
        what = f"PCA, {name}, squared error at {functions} + 1 functions, norm of the fit, each material scaled to 1"
        worst = float(fit.error.max())
        how = f"{len(space.samples)} samples; 168 wo, 163 cells of wi and their sum; worst relative error {worst:.3g}"
        table.row(what, float(fit.error.square().mean()), "", how, paper=paper if functions == 4 else "")
        wrong = albedo_errors(space, fit)
        what = f"PCA, {name}, albedo at {functions} + 1 functions"
        how = "relative error of the albedo over wo, of each material; least squares over 24 tilts"
        table.row(f"{what}, median", float(wrong.median()), "", how)
        table.row(f"{what}, largest", float(wrong.max()), "", how)


def albedo_errors(space: ptt.BRDFSpace, fit: ptt.BRDFBasis) -> Tensor:
    """Relative errors (h,) of the albedo of every sample as the basis has it."""
    theta = (torch.arange(24).double() + 0.5) / 24 * (math.pi / 2)
    wo = torch.stack((theta.sin(), torch.zeros_like(theta), theta.cos()), 1)
    exact = torch.stack([albedo(shape.evaluate, wo) for shape in space.samples])  # shape: (h, wo)
    ours = fit.table.double() @ (fit.mixture.double().T @ exact)
    weights = theta.sin() * theta.cos()
    return ((ours - exact).square() @ weights / (exact.square() @ weights)).sqrt()


def between_samples(table: Table, spaces: dict[str, ptt.BRDFSpace]) -> None:
    """What navigation costs: a BRDF halfway between samples against its interpolation, in the norm of `BRDFBasis`."""
    grids = {"Blinn-Phong": spaces["Blinn-Phong"], "Ward": ptt.BRDFSpace.ward(), "GGX": ptt.BRDFSpace.ggx()}
    for name, space in grids.items():
        errors = []
        step = 2 if name == "GGX" else 1
        for a, b in zip(space.samples, space.samples[step:], strict=False):
            middle = space.path(a, b, 3)[1]
            mixed = ptt.BRDFSpace.user({"exact": middle.evaluate, "mixed": ptt.Blend((a, b), (0.5, 0.5)).evaluate})
            errors.append(float(ptt.BRDFBasis.fit(mixed, 1).error.max()) * 2)
        how = f"{len(space.samples)} samples; twice the distance of both from their first principal component"
        table.row(f"halfway between samples, {name}, largest relative error", max(errors), "", how)


def against_tensorly(table: Table, samples: tuple[Shape, ...], quick: bool) -> None:
    """Time, error and memory of Tucker decompositions in fresh processes, medians of three."""
    tensor, norms = remainders(samples, lobes.ANGLES)
    tensor /= norms.float()[:, None, None]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "tensor.pt"
        torch.save(tensor, path)
        for dtype in ("float32", "float64"):
            took = {}
            for how in ("tensorly-numpy", "tensorly-pytorch", "hooi", "hosvd", "st-hosvd"):
                runs = [tucker_peer.run(how, dtype, path) for _ in range(1 if quick or how.startswith("t") else 3)]
                took[how], error, memory = (statistics.median(r[k] for r in runs) for k in ("seconds", "error", "MiB"))
                setup = f"{tuple(tensor.shape)}, ranks {tucker_peer.RANKS}; {setting()}"
                table.row(f"Tucker, {dtype}, {how}", took[how], "s", setup)
                table.row(f"Tucker, {dtype}, {how}, error", error, "", setup)
                table.row(f"Tucker, {dtype}, {how}, memory added", memory, "MiB", setup)
            for how in ("hooi", "st-hosvd"):
                what = f"Tucker, {dtype}, {how}, speed over partial_tucker's default"
                table.row(what, took["tensorly-numpy"] / took[how], "", "numpy backend, truncated_svd", ">= 10")


def editing(table: Table) -> None:
    """What an edit costs: tensor, lobes and indirect basis of the fitted space."""
    space = ptt.BRDFSpace.fitted()
    tensor = ptt.TensorBRDF.fit(space, (4, 8, 8), separated=4)
    indirect = ptt.BRDFBasis.fit(space)
    steps = iter(range(10**9))
    how = f"core, lobe tables and basis; {setting()}"

    def parameter() -> object:
        shape = space.at(F0=0.3, m=0.2 + next(steps) * 1e-5)
        return tensor.matrix(shape), tensor.lobe_tables(shape), indirect.of_shape(shape)

    table.row("edit, one parameter", 1e3 * median_seconds(parameter, 51), "ms", how, "<= 1")
    path = space.path("gold-metallic-paint", "nickel", 60)

    def animation() -> object:
        material = path[next(steps) % len(path)]
        assert material.shape is not None
        shape = material.shape
        return tensor.matrix(shape), tensor.lobe_tables(shape), indirect.coefficients(material)

    table.row("edit, an animation step", 1e3 * median_seconds(animation, 51), "ms", how, "<= 1")
    for new in (ptt.ggx(f0=0.2, roughness=0.35), ptt.ward(ax=0.1, ay=0.3)):

        def add(new: ptt.Material = new) -> object:
            return tensor.with_brdf("new", new), indirect.with_brdf("new", new)

        seconds = median_seconds(add, 3)
        kind = "isotropic" if new.shape and new.shape.isotropic else "anisotropic"
        table.row(f"edit, a new user BRDF, {kind}", seconds, "s", how, "<= 2", paper="2 to 3 (Ma 2006)")


if __name__ == "__main__":
    main()
