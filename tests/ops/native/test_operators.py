"""Kernels as torch operators: what torch asks of an operator holds for each, and its gradient is the plain one's."""

from __future__ import annotations

import ctypes
import subprocess
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from ptt.light.prefiltered import samples
from ptt.materials.shapes import BlinnPhong
from ptt.ops import haar, native, near, rotation, slices
from ptt.ops.around import Around
from ptt.ops.cells import Gloss, Lobes
from ptt.ops.constants import BITS, LEVELS, MET, PARTS, RECORD, RINGS, ROW, SECTORS, SENT, TILTS
from ptt.ops.geodesic import Geodesic
from ptt.ops.gloss import GlossLight
from ptt.ops.haar import Truncated
from ptt.ops.hemispheres import Between, words_of
from ptt.ops.native import building, kernels, operators
from ptt.ops.near import Near
from ptt.ops.octahedral import HemiOctahedral, Octahedral
from ptt.ops.relight import ArrivingLight, LitRegion, OutgoingLight, Responses
from ptt.ops.shade import Functions, RegionCoats, ShadedPoints
from ptt.ops.sphere import Cube
from ptt.ops.table import stored
from ptt.ops.view import LitLobes, SurfaceBlocks, ViewedRegion, points_at

pytestmark = pytest.mark.usefixtures("built")


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def uniform(*shape: int) -> Tensor:
    return torch.rand(*shape, generator=generator())


def words(*shape: int) -> Tensor:
    return torch.randint(-32000, 32000, shape, generator=generator(), dtype=torch.int16)


def lighting() -> None:
    native.lighting(uniform(64, 4), torch.eye(3), *samples(Cube(4)), Cube(4).shape)


def octahedral_means() -> None:
    native.octahedral_means(uniform(4, 8, 3), 4, 3, 0.5)


def light_eigens() -> None:
    chosen = torch.randint(0, 9, (2, 5))
    native.light_eigens([uniform(2, 5, 20).half(), uniform(2, 5, 20)], [uniform(3, 5), uniform(3, 9)], [None, chosen])


def exitants() -> None:
    arriving = ArrivingLight(uniform(2, 3, 4, 5), uniform(2, 3, 2, 4, 16), uniform(2, 3, 1, 4))
    material = uniform(2, 3), uniform(1, 3), uniform(3, 6, 5)
    blocks = uniform(3, 4, 64), torch.tensor([0, 1, 1])
    lit = [LitRegion(arriving, *material, *blocks, glossy) for glossy in (False, True)]
    native.exitants(lit, Responses(uniform(16, 5), uniform(16, 16)))


def view() -> None:
    blocks, w = 2, 32
    n = blocks * w
    place = torch.randperm(n, generator=generator())[: n - 3]
    surface = SurfaceBlocks(
        uniform(3, n),
        torch.eye(3)[:, :, None].repeat(1, 1, n),
        uniform(n),
        None,
        torch.randint(0, 2**31, (n, 64), generator=generator()).int(),
        place,
        points_at(place, n),
    )
    sent = OutgoingLight(words(blocks, 3, 6 + 16 + 1, w), uniform(blocks, 3, 6 + 16 + 1))
    gloss = LitLobes(
        torch.tensor([0, 2]),
        uniform(20, 2),
        0.1 + uniform(20, 4),
        uniform(3),
        uniform(2, 144, 4),
        torch.eye(3),
        uniform(2, 16),
    )
    dull = OutgoingLight(words(blocks, 3, 6 + 1, w), uniform(blocks, 3, 6 + 1))
    coloured = surface._replace(colour=uniform(3, n))
    eye = torch.tensor([0.2, 0.4, 5.0])
    native.view([ViewedRegion(surface, eye, sent, gloss), ViewedRegion(coloured, eye, dull, None)], uniform(36, 5))


def shine() -> None:
    n = 32
    seen = torch.randint(0, 2**31, (n, words_of(BITS)), generator=generator()).int()
    frame = torch.eye(3)[:, :, None].repeat(1, 1, n)
    place = torch.arange(n - 3)
    surface = SurfaceBlocks(uniform(3, n), frame, uniform(n), None, torch.empty(0), place, points_at(place, n))
    gloss = Gloss(
        Lobes(uniform(TILTS, 3, 7), 1),
        uniform(TILTS, RINGS, SECTORS, 3),
        uniform(TILTS, ROW),
        uniform(TILTS, PARTS, ROW),
        spread=90.0,
    )
    meets = torch.arange(n * MET, dtype=torch.int32).reshape(n, -1) % 4 - 1
    records = torch.cat((torch.eye(3).flatten().expand(3, -1), torch.zeros(3, RECORD - 9)), 1)
    maps = uniform(LEVELS, 36, 4)
    around = Around(
        uniform(3, n),
        meets,
        records,
        uniform(3, SENT),
        seen,
        meets,
        uniform(TILTS, ROW),
        uniform(TILTS, PARTS, ROW),
        maps,
        *map(uniform, (2, 2, n), (3, 3, 2)),
    )
    for lamps, other in ((0, None), (2, around)):
        light = GlossLight(maps, torch.eye(3), uniform(lamps, 3), uniform(lamps, 3), uniform(lamps, n))
        native.shine(surface, torch.tensor([0.2, 0.4, 5.0]), seen, gloss, light, other, uniform(3, n))
    lit = (
        frame,
        uniform(n),
        torch.tensor([0.2, 0.4, 5.0]),
        uniform(TILTS, RINGS, SECTORS, 3),
        uniform(2, 3),
        uniform(2, 3),
    )
    native.reflected_lamps(surface.position, *lit)
    native.reflected_lamps(surface.position, *lit, uniform(2, n))
    native.lamp_visibility(seen, torch.arange(8).reshape(2, 4), uniform(2, 4))
    native.cell_sums(uniform(3, 3, 40), uniform(6, 40, 3), (4, 2))
    rows = torch.arange(3 * n, dtype=torch.int32).reshape(n, 3) % 5
    between = Between(rows, uniform(n, 3), torch.eye(3).repeat(5, 1, 1))
    light = GlossLight(maps, torch.eye(3), uniform(2, 3), uniform(2, 3), uniform(2, n))
    native.shine(surface, torch.tensor([0.2, 0.4, 5.0]), seen[:5], gloss, light, None, None, between)
    native.lamps_between(uniform(2, 5), between, uniform(2, 3))
    native.lamps_seen(seen[:5].contiguous(), between.frames, 0.1 + uniform(2, 4, 3), uniform(2, 4))


def resampling() -> rotation.Resampling:
    return rotation.resampling(Octahedral(8), HemiOctahedral(4), frames().double())


def frames(count: int = 5) -> Tensor:
    return rotation.frames_of(torch.randn(count, 3, generator=generator(), dtype=torch.float64)).float()


def rotate() -> None:
    light = uniform(3, 8, 8)
    native.local_light(light, resampling(), 4)
    native.resampled_light(light, frames(), HemiOctahedral(4))
    native.rotated_light(light, native.quantised(resampling(), 8, 4, 1 / 32767, 1), 4)


def values() -> None:
    grid = Geodesic(0)
    s = rotation.resampling(Octahedral(8), grid, frames().double())
    for storage in (torch.float32, torch.float16, torch.uint8):
        native.resampled_values(uniform(64, 3), s, grid.cells, storage)


def reflected() -> None:
    sampled = rotation.frames_of(Octahedral(4).directions().reshape(-1, 3)).float()
    cut = slices.tabulate(BlinnPhong(20.0).evaluate, 4, 8, 10)
    at = slices.located(uniform(32, 3), frames(32), sampled)
    first = slices.first_slice(cut, at.twist)
    for channels in (3, 4):
        native.reflected(uniform(16, 16, channels), cut, first, sampled, at, torch.tensor([0.0, 0.5, 3.0]))


def shade() -> None:
    n, points = 20, 40
    rows = torch.randint(0, 6, (points, 4), generator=generator()).int()
    lookup = Near(rows, torch.full((points, 4), 0.25))
    for storage in (torch.float32, torch.float16):
        functions = Functions(
            stored(uniform(6, 3, n), storage),
            torch.randint(0, 256, (6, n), generator=generator()).to(torch.uint8),
            uniform(n),
            stored(uniform(6, n), storage),
        )
        coats = RegionCoats(uniform(1, 2, 3), uniform(1, 2, 3), torch.zeros(1, 2, dtype=torch.int32))
        at = ShadedPoints(
            lookup, lookup, lookup, torch.zeros(points, dtype=torch.int32), uniform(points, 3), uniform(1, points, 3)
        )
        native.shade(functions, coats, at)
        native.shade(functions, coats, at, uniform(points, 3))


def lookups() -> None:
    sampled = rotation.frames_of(Octahedral(4).directions().reshape(-1, 3)).float()
    for between in (False, True):
        native.of_frames(frames(40), sampled, 8, between)
    native.of_views(frames(40), uniform(40, 3), torch.tensor([0.0, 1.0, 3.0]), 6)
    native.of_views(frames(40), uniform(40, 3), uniform(40, 3), 6)
    barycentric = torch.full((40, 3), 1 / 3)
    native.of_texels(uniform(7, 3, 2), torch.arange(40) % 7, barycentric, torch.arange(64, dtype=torch.int32))


def adaptive() -> None:
    full = haar.truncate(torch.randn(6, 80, generator=generator()), 12)
    f, g, h = (Truncated(full.indices, full.values + k) for k in range(3))
    native.adaptive(f, g, h, 80)


USES = (
    octahedral_means,
    lighting,
    light_eigens,
    exitants,
    view,
    shine,
    rotate,
    values,
    reflected,
    shade,
    lookups,
    adaptive,
)


class Calls(TorchDispatchMode):
    """A record of the calls of ptt's operators."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.made: list[tuple[Any, tuple[Any, ...]]] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func.namespace == "ptt":
            self.made.append((func, args))
        return func(*args, **(kwargs or {}))


def calls(use: Callable[[], None]) -> list[tuple[Any, tuple[Any, ...]]]:
    with Calls() as recorded, native.refusals() as found:
        use()
    assert not found  # by kernels
    made: list[tuple[Any, tuple[Any, ...]]] = recorded.made
    return made


@pytest.mark.parametrize("use", USES, ids=lambda use: use.__name__)
def test_opcheck(use: Callable[[], None]) -> None:
    """Schema, registration for autograd, fake tensors, and tracing with static and dynamic shapes."""
    for operator, arguments in calls(use):
        torch.library.opcheck(operator, arguments)


def test_every_operator_is_checked() -> None:
    used = {operator._schema.name.removeprefix("ptt::") for use in USES for operator, _ in calls(use)}
    assert used == set(operators.DEFINED)


def flat(results: Any) -> list[Tensor]:
    """The tensors of a result, of several, or of lists of them."""
    return [results] if isinstance(results, Tensor) else [item for part in results for item in flat(part)]


def tensors(arguments: Iterable[Any]) -> list[Tensor]:
    items = [item for a in arguments for item in (a if isinstance(a, list) else [a])]
    return [item for item in items if isinstance(item, Tensor)]


def with_leaves(arguments: Iterable[Any]) -> list[Any]:
    """The same arguments, every float32 tensor a leaf that requires a gradient."""

    def leaf(item: Any) -> Any:
        if isinstance(item, list):
            return [leaf(each) for each in item]
        is_real = isinstance(item, Tensor) and item.dtype == torch.float32
        return item.clone().requires_grad_() if is_real else item

    return [leaf(argument) for argument in arguments]


def gradients(function: Callable[..., Any], arguments: list[Any]) -> list[Tensor | None]:
    """Gradients of a weighted sum of all results, with respect to every leaf."""
    results = flat(function(*arguments))
    total = torch.zeros(())
    for k, result in enumerate(results):
        if result.requires_grad:
            total = total + (result * torch.linspace(0.5, 1.5 + k, result.numel()).reshape(result.shape)).sum()
    leaves = [t for t in tensors(arguments) if t.requires_grad]
    return list(torch.autograd.grad(total, leaves, allow_unused=True)) if total.requires_grad else []


@pytest.mark.parametrize("use", USES, ids=lambda use: use.__name__)
def test_gradients_are_those_of_the_plain_function(use: Callable[[], None]) -> None:
    """Two-sided: the operator's gradient and the plain function's are the same to the bit, leaf by leaf."""
    for operator, arguments in calls(use):
        plain = operators.DEFINED[operator._schema.name.removeprefix("ptt::")]
        got = gradients(operator, with_leaves(arguments))
        wanted = gradients(plain, with_leaves(arguments))
        assert len(got) == len(wanted)
        for one, other in zip(got, wanted, strict=True):
            assert (one is None) == (other is None)
            if one is not None and other is not None:
                assert torch.equal(one, other)


@pytest.mark.parametrize("use", USES, ids=lambda use: use.__name__)
def test_operators_are_one_node_of_a_graph(use: Callable[[], None]) -> None:
    """torch.compile with fullgraph keeps the kernel and changes nothing."""
    for operator, arguments in calls(use):
        torch._dynamo.reset()  # each operator is another function to torch.compile, which takes eight
        got = torch.compile(operator, fullgraph=True, backend="aot_eager")(*arguments)  # type: ignore[no-untyped-call]
        wanted = operator(*arguments)
        assert all(torch.equal(*pair) for pair in zip(flat(got), flat(wanted), strict=True))


def test_a_user_can_ask_why_a_kernel_was_not_used() -> None:
    frame = frames(40).requires_grad_()
    with native.refusals() as found:
        native.of_views(frames(8), uniform(8, 3), torch.ones(3), 6)
    assert found == {"near_views": "there must be 16 points, which kernels take at once"}
    with native.refusals() as found:
        native.of_views(frame, uniform(40, 3), torch.ones(3), 6)
    assert found == {"near_views": "derivatives are asked for"}
    with native.refusals() as found:
        native.of_views(frames(40), uniform(40, 3), torch.ones(3), 6)
    assert not found


def test_forward_derivatives_go_the_plain_way() -> None:
    eye = torch.tensor([0.0, 1.0, 3.0])
    with torch.autograd.forward_ad.dual_level():
        dual = torch.autograd.forward_ad.make_dual(eye, torch.ones(3))
        got = native.of_views(frames(40), uniform(40, 3), dual, 6).weights
        wanted = near.of_views(frames(40), uniform(40, 3), dual, 6).weights
        tangents = [torch.autograd.forward_ad.unpack_dual(x).tangent for x in (got, wanted)]
    assert tangents[0] is not None and torch.equal(*tangents)


def test_members_that_are_missing_are_refused() -> None:
    with pytest.raises(RuntimeError, match="kernel near_views takes"):
        kernels.run("near_views", frames=torch.eye(3))


def test_a_kernel_without_a_case_says_so() -> None:
    x = torch.zeros(1)
    with pytest.raises(RuntimeError, match="kernel light_eigen has no case"):
        kernels.run(
            "light_eigen",
            lighting=x,
            columns=None,
            transfer=x,
            out=x,
            cluster=0,
            channel=0,
            rows=0,
            width=0,
            clusters=0,
            type=9,
        )


def test_structures_are_laid_out_as_the_compiler_lays_them_out(tmp_path: Path) -> None:
    """Sizes and the offset of each last member, printed by a program that includes signatures.h itself."""
    (tmp_path / "constants.h").write_text(building.header())
    lines = [
        f'std::printf("{name} %zu %zu\\n", sizeof({name}), offsetof({name}, threads));' for name in kernels.structures()
    ]
    code = '#include "signatures.h"\n#include <cstddef>\n#include <cstdio>\nint main() {' + "\n".join(lines) + "}"
    (tmp_path / "layout.cpp").write_text(code)
    program = str(tmp_path / "layout")
    command = [*building.toolchain()[0], "-std=c++17", f"-I{tmp_path}", f"-I{building.FOLDER}"]
    subprocess.run([*command, str(tmp_path / "layout.cpp"), "-o", program], check=True)
    printed = subprocess.run([program], check=True, capture_output=True, text=True).stdout.split()
    assert printed[::3] == list(kernels.structures())
    for name, size, offset in zip(printed[::3], printed[1::3], printed[2::3], strict=True):
        structure = kernels.structures()[name]
        assert (int(size), int(offset)) == (ctypes.sizeof(structure), structure.threads.offset)


@pytest.mark.parametrize("processor", ["x86-64", "x86-64-v3", "native"])
def test_sources_have_no_warnings(processor: str, tmp_path: Path) -> None:
    (tmp_path / "constants.h").write_text(building.header())
    command = [
        *building.toolchain()[0],
        *building.FLAGS,
        f"-march={processor}",
        "-Wall",
        "-Wextra",
        "-Werror",
        "-fsyntax-only",
        f"-I{tmp_path}",
    ]
    subprocess.run([*command, *map(str, building.SOURCES.values())], check=True)
