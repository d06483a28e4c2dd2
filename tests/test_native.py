"""The kernel of the view step against the plain one."""

from __future__ import annotations

import os
import subprocess
import threading
import warnings
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor

from ptt.ops import native
from ptt.ops import view as plain
from ptt.ops.view import Gloss, Points

W, TILTS = 32, 20
Inputs = tuple[Points, Tensor, Tensor, Tensor, Gloss | None]


def inputs(k: int = 2, s: int = 16, o: int = 8, b: int = 3, distant: bool = False, turns: int = 1) -> Inputs:
    g = torch.Generator().manual_seed(1000 * k + 100 * s + 10 * o + b)
    n = b * W
    frame = rotations(n, g).permute(1, 2, 0).contiguous()
    cuts = torch.randint(-(2**31), 2**31, (n, 64), generator=g).int()
    points = Points(torch.randn(3, n, generator=g), frame, cuts)
    eye = torch.nn.functional.normalize(torch.randn(3, n, generator=g), dim=0) if distant else torch.ones(3)
    rho, maps = torch.rand(turns * TILTS, k, generator=g), torch.rand(12 * 12, 3 * k, generator=g)
    which = torch.randperm(4, generator=g)[:k]
    turn, blurs = rotations(1, g)[0].contiguous(), torch.rand(k, s, generator=g)
    gloss = Gloss(which, rho, TILTS, torch.rand(3, generator=g), maps, turn, blurs) if k else None
    return points, eye, torch.randn(14 * 14, o - 1, generator=g), torch.randn(b, 3, o + s, W, generator=g), gloss


def rotations(n: int, g: torch.Generator) -> Tensor:
    rotation: Tensor = torch.linalg.qr(torch.randn(n, 3, 3, generator=g))[0]
    return rotation


def double(x: Inputs) -> Inputs:
    points, eye, outgoing, sent, gloss = x
    if gloss is not None:
        gloss = Gloss(*(t.double() if isinstance(t, Tensor) and t.is_floating_point() else t for t in gloss))
    points = Points(points.position.double(), points.frame.double(), points.cuts)
    return points, eye.double(), outgoing.double(), sent.double(), gloss


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """One entry for each call of the plain function by `native.view`."""
    made: list[int] = []
    original = plain.view

    def counted(*args: object) -> Tensor:
        made.append(1)
        return original(*args)  # type: ignore[arg-type]

    monkeypatch.setattr(plain, "view", counted)
    return made


@pytest.fixture
def built() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if not native.available():
            pytest.skip("no C++ compiler")


def agree(x: Inputs, calls: list[int]) -> None:
    got = native.view(*x)
    assert not calls  # by the kernel
    expected = plain.view(*double(x))  # tables of noise: float32 rounds where they are looked up
    calls.clear()
    assert got.shape == expected.shape and got.dtype == torch.float32
    assert torch.allclose(got.double(), expected, rtol=2e-5, atol=2e-5 * float(expected.abs().max()))


@pytest.mark.parametrize("distant", [False, True])
@pytest.mark.parametrize("s", [0, 16])
@pytest.mark.parametrize("k", range(5))
def test_agrees_for_all_lobes(built: None, calls: list[int], k: int, s: int, distant: bool) -> None:
    agree(inputs(k, s, distant=distant), calls)


@pytest.mark.parametrize("b", [1, 7])
@pytest.mark.parametrize("o", [1, 8, 16, 24])
def test_agrees_for_all_sizes(built: None, calls: list[int], o: int, b: int) -> None:
    agree(inputs(o=o, b=b), calls)


def test_agrees_where_directions_are_special(built: None, calls: list[int]) -> None:
    points, _, outgoing, sent, gloss = inputs(k=4, distant=True)
    n = points.frame[2]
    toward = torch.stack((n, -n, points.frame[0], points.frame[1], -points.frame[0], -points.frame[1]))
    for eye in toward:  # head-on, facing away, at the horizon
        agree((points, eye.contiguous(), outgoing, sent, gloss), calls)


def test_a_point_at_the_eye_is_finite(built: None) -> None:
    points, _, *rest = inputs(k=4)
    assert native.view(points, points.position[:, 5].contiguous(), *rest).isfinite().all()


@pytest.mark.parametrize(
    "change",
    [
        double,
        lambda x: (*x[:3], x[3].clone().requires_grad_(), x[4]),
        lambda x: (x[0]._replace(frame=x[0].frame.transpose(0, 1)), *x[1:]),
        lambda x: (*x[:4], x[4]._replace(rho=inputs(turns=2)[4].rho)),
    ],
    ids=["float64", "gradient", "strided", "anisotropic"],
)
def test_what_the_kernel_is_not_for_goes_the_plain_way(calls: list[int], change: Callable[[Inputs], Inputs]) -> None:
    x = change(inputs())
    got = native.view(*x)
    assert calls == [1] and torch.equal(got, plain.view(*x))


def test_gradients_pass() -> None:
    points, eye, outgoing, sent, gloss = inputs()
    sent.requires_grad_()
    native.view(points, eye, outgoing, sent, gloss).sum().backward()
    assert sent.grad is not None and sent.grad.isfinite().all()


def test_without_gradients_a_parameter_goes_by_the_kernel(built: None, calls: list[int]) -> None:
    x = inputs()
    x[3].requires_grad_()
    with torch.no_grad():
        agree(x, calls)


@pytest.mark.parametrize("failure", ["missing", "broken"])
def test_no_compiler_is_one_warning(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, failure: str) -> None:
    def missing() -> str:
        raise RuntimeError("none here")

    compiler = missing if failure == "missing" else lambda: "false"
    monkeypatch.setattr("torch._inductor.cpp_builder.get_cpp_compiler", compiler)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    native._kernel.cache_clear()
    x = inputs()
    try:
        with pytest.warns(UserWarning, match="no C\\+\\+ compiler, relighting stays eager: .+"):
            first = native.view(*x)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert torch.equal(native.view(*x), first) and torch.equal(plain.view(*x), first)
            assert not native.available()
    finally:
        native._kernel.cache_clear()


def test_builds_at_the_same_time_are_safe(built: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    barrier, made = threading.Barrier(2), []

    def run(*command: str) -> str:
        if "-shared" in command:
            barrier.wait()  # both have found no library
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout

    monkeypatch.setattr(native, "_run", run)
    threads = [threading.Thread(target=lambda: made.append(native._build(tmp_path))) for _ in range(2)]
    for t in threads:
        t.start()
    for t in threads:
        t.join()
    assert len(made) == 2 and made[0] == made[1] and os.listdir(tmp_path) == [made[0].name]
    assert native._build(tmp_path) == made[0]  # which finds it: the barrier would hold a second build for ever
