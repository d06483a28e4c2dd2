"""LightRotation: one meaning by three operators, saved and loaded, its extremes and refusals."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import get_args

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

import ptt
from ptt.models.light_rotation import Operator
from ptt.ops import haar, rotation
from ptt.ops.octahedral import Octahedral

OPERATORS = get_args(Operator)


def light(n: int = 16, channels: int = 3) -> Tensor:
    return haar.analyse(torch.rand(channels, n, n, generator=torch.Generator().manual_seed(1)))


@pytest.mark.parametrize("compiled", [False, True])
def test_operators_have_one_meaning(compiled: bool) -> None:
    got = {o: ptt.LightRotation.build(16, 4, operator=o, compiled=compiled)(light()) for o in OPERATORS}
    assert all(x.shape == (16, 64, 3) for x in got.values())
    torch.testing.assert_close(got["resample"], got["factored"], rtol=0, atol=2e-5)
    torch.testing.assert_close(got["matrix"], got["factored"], rtol=0, atol=2e-3)  # 16 bits of numbers, 256 a row


@pytest.mark.parametrize("operator", OPERATORS)
def test_local_light_is_the_light_seen_from_each_frame(operator: Operator) -> None:
    """A smooth light, in texels, against the light in each cell's direction."""
    rotate = ptt.LightRotation.build(32, 4, operator=operator)
    world = Octahedral(32).directions()
    values = torch.stack((world[..., 0] + 2, (2 * world[..., 1]).sin(), world[..., 2] ** 2)).float()
    local = haar.synthesise(rotate(haar.analyse(values)).transpose(1, 2).reshape(16, 3, 16, 16))
    from ptt.ops.octahedral import HemiOctahedral

    seen = HemiOctahedral(16).directions().float() @ rotate.frames[:, None]
    wanted = torch.stack((seen[..., 0] + 2, (2 * seen[..., 1]).sin(), seen[..., 2] ** 2), 1)
    assert float((local - wanted).abs().max()) < 0.15
    assert float((local - wanted).square().mean().sqrt()) < 0.05


def test_given_frames() -> None:
    """Any frames, such as those of a mesh with tangents of its own: R indexed by them alone."""
    g = torch.Generator().manual_seed(0)
    q, _ = torch.linalg.qr(torch.randn(5, 3, 3, generator=g, dtype=torch.float64))
    frames = q * q.det().sign()[:, None, None]
    rotate = ptt.LightRotation.build(16, frames=frames)
    assert rotate.normals is None
    for k, frame in enumerate(frames):
        alone = ptt.LightRotation.build(16, frames=frame[None])
        torch.testing.assert_close(rotate(light())[k], alone(light())[0], rtol=0, atol=1e-6)


@pytest.mark.parametrize("operator", OPERATORS)
def test_saved_and_loaded(operator: Operator, tmp_path: Path) -> None:
    rotate = ptt.LightRotation.build(8, 4, operator=operator)
    rotate.save(tmp_path / "r.safetensors")
    again = ptt.LightRotation.load(tmp_path / "r.safetensors")
    assert torch.equal(again(light(8)), rotate(light(8)))
    assert (again.n, again.m, again.normals, again.operator) == (8, 4, 4, operator)


def test_damaged_files_are_refused(tmp_path: Path) -> None:
    from safetensors import safe_open

    path = tmp_path / "r.safetensors"
    ptt.LightRotation.build(8, 4).save(path)
    with safe_open(str(path), framework="pt") as file:
        header = file.metadata()
    damages: tuple[tuple[str, Callable[[Tensor], Tensor], str], ...] = (
        ("reads", lambda t: t + (1 << 20), "holds wrong columns"),
        ("starts", lambda t: t.flip(0), "holds wrong rows"),
        ("frames", lambda t: t[:3], "frames must be"),
    )
    for name, damage, message in damages:
        tensors = load_file(path)
        tensors[name] = damage(tensors[name]).contiguous()
        save_file(tensors, tmp_path / "bad.safetensors", metadata=header)
        with pytest.raises(ValueError, match=message):
            ptt.LightRotation.load(tmp_path / "bad.safetensors")
    with pytest.raises(ValueError, match="no file"):
        ptt.LightRotation.load(tmp_path / "none.safetensors")


def test_thresholds() -> None:
    """A larger threshold keeps fewer numbers and errs more; one beyond all of them is refused."""
    exact = ptt.LightRotation.build(16, 4)(light())
    sizes = []
    errors = []
    for threshold in (1, 64, 1024):
        rotate = ptt.LightRotation.build(16, 4, operator="matrix", threshold=threshold)
        sizes.append(rotate.bytes)
        errors.append(float((rotate(light()) - exact).norm() / exact.norm()))
    assert sizes[0] > sizes[1] > sizes[2] and errors[0] < errors[1] < errors[2] and errors[0] < 1e-3
    with pytest.raises(ValueError, match="leaves nothing"):
        ptt.LightRotation.build(16, 4, operator="matrix", threshold=32768)


@pytest.mark.parametrize("operator", OPERATORS)
@pytest.mark.parametrize("compiled", [False, True])
def test_extremes(operator: Operator, compiled: bool) -> None:
    """n = 2, M > N, a sun of 1e9 in one texel, no light at all, 16-bit light."""
    tiny = ptt.LightRotation.build(2, 2, operator=operator, compiled=compiled)
    assert tiny(light(2)).shape == (4, 1, 3)
    wide = ptt.LightRotation.build(4, 2, m=8, operator=operator, compiled=compiled)
    assert wide(light(4)).shape == (4, 64, 3)
    rotate = ptt.LightRotation.build(16, 4, operator=operator, compiled=compiled)
    sun = torch.zeros(3, 16, 16)
    sun[:, 3, 5] = 1e9
    lit = rotate(haar.analyse(sun))
    assert bool(lit.isfinite().all()) and float(lit.abs().max()) > 1e8
    assert not bool(rotate(torch.zeros(3, 16, 16)).any())
    for kind in (torch.float16, torch.bfloat16):
        half = light().to(kind)
        assert torch.equal(rotate(half), rotate(half.float()))
    assert rotate(light().double()).dtype == torch.float64


@pytest.mark.parametrize("operator", OPERATORS)
def test_differentiable_in_the_light(operator: Operator) -> None:
    """The gradient of a sum against the difference of two evaluations: the operator is linear."""
    rotate = ptt.LightRotation.build(8, 4, operator=operator)
    base = light(8).double().requires_grad_()
    step = torch.randn(3, 8, 8, dtype=torch.float64)
    weights = torch.randn(16, 16, 3, dtype=torch.float64)
    (rotate(base) * weights).sum().backward()
    assert base.grad is not None
    difference = ((rotate(base.detach() + step) - rotate(base.detach())) * weights).sum()
    torch.testing.assert_close((base.grad * step).sum(), difference, rtol=1e-9, atol=1e-9)


def test_refuses() -> None:
    build = ptt.LightRotation.build
    for arguments, message in (
        ({"n": 12}, "n must be a power of two"),
        ({"n": 1}, "n must be a power of two, at least 2"),
        ({"n": 8, "m": 3}, "m must be a power of two"),
        ({"n": 8, "operator": "fast"}, "operator must be one of factored, resample, matrix"),
        ({"n": 8, "threshold": 4}, "threshold must"),
        ({"n": 8, "normals": 3}, "n must be even"),
        ({"n": 8, "frames": torch.ones(2, 3, 3)}, "orthonormal"),
    ):
        with pytest.raises(ValueError, match=message):
            build(**arguments)
    rotate = build(8, 2)
    with pytest.raises(ValueError, match=r"coefficients must be \(c, 8, 8\)"):
        rotate(torch.ones(3, 4, 4))
    with pytest.raises(ValueError, match="finite"):
        rotate(torch.full((3, 8, 8), float("nan")))


def test_normals_anywhere() -> None:
    """Folds, poles, -z and duplicates give local light of a constant that is that constant."""
    normals = torch.tensor([[0.0, 0, 1], [0, 0, -1], [1, 0, 0], [1, 1, 0], [0, -1, 0], [1e-9, 0, -5], [0, 0, 1]])
    rotate = ptt.LightRotation.build(16, frames=rotation.frames_of(normals))
    local = rotate(haar.analyse(torch.ones(1, 16, 16)))
    wanted = torch.zeros(7, 64, 1)
    wanted[:, 0] = 8.0  # the mean of 64 cells, times 8
    torch.testing.assert_close(local, wanted, rtol=0, atol=1e-5)
