"""The view step as an operator; its plain function is `ptt.ops.view.view`."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ptt.ops import view as plain
from ptt.ops.compiling import inlined
from ptt.ops.constants import CHANNELS, GROUP, HARMONICS, MOST_LOBES, TILE
from ptt.ops.native.arguments import contiguous, of_type, side, square
from ptt.ops.native.kernels import run
from ptt.ops.native.operators import Conditions, operator
from ptt.ops.relight import OutgoingLight
from ptt.ops.view import LitLobes, SurfaceBlocks, ViewedRegion

SCHEMA = (
    "view(Tensor[] position, Tensor[] frame, Tensor[] dip, Tensor?[] colour, Tensor[] cuts, Tensor[] place, "
    "Tensor[] point, Tensor[] eye, Tensor[] values, Tensor[] unit, Tensor?[] which, Tensor?[] rho, Tensor?[] axes, "
    "Tensor?[] specular, Tensor?[] maps, Tensor?[] turn, Tensor?[] blurs, Tensor outgoing) -> Tensor"
)
COLUMNS = (*SurfaceBlocks._fields, "eye", *OutgoingLight._fields, *LitLobes._fields)
NO_LOBES = (None,) * len(LitLobes._fields)


@inlined
def view(regions: Sequence[ViewedRegion], outgoing: Tensor) -> Tensor:
    """B (v, c), as `ptt.ops.view.view`; where a point is at the eye, its lobes are finite."""
    columns: tuple[list[Tensor | None], ...] = tuple([] for _ in range(len(COLUMNS)))
    for region in regions:
        lobes = NO_LOBES if region.lobes is None else region.lobes
        for column, tensor in zip(columns, (*region.points, region.eye, *region.sent, *lobes), strict=True):
            column.append(tensor)
    result: Tensor = _view(*columns, outgoing)
    return result


def _regions(*columns: Sequence[Tensor | None]) -> list[ViewedRegion]:
    """The regions whose tensors are given column by column, in the order of the schema."""
    found = []
    for position, frame, dip, colour, cuts, place, point, eye, values, unit, *lobes in zip(*columns, strict=True):
        points = SurfaceBlocks(position, frame, dip, colour, cuts, place, point)
        gloss = None if lobes[0] is None else LitLobes(*lobes)
        found.append(ViewedRegion(points, eye, OutgoingLight(values, unit), gloss))
    return found


def _plain(*arguments: Sequence[Tensor | None]) -> Tensor:
    outgoing = arguments[-1]
    assert isinstance(outgoing, Tensor)
    return plain.view(_regions(*arguments[:-1]), outgoing)


def _kernel(*arguments: Sequence[Tensor | None]) -> Tensor:
    outgoing = arguments[-1]
    assert isinstance(outgoing, Tensor)
    regions = _regions(*arguments[:-1])
    outgoing = outgoing.contiguous()
    sizes = [region.points.place.shape[0] for region in regions]
    out = outgoing.new_empty(sum(sizes), 3)
    for region, rows in zip(regions, out.split(sizes), strict=True):
        _write(region, outgoing, rows)
    return out


def _write(region: ViewedRegion, outgoing: Tensor, out: Tensor) -> None:
    """Write the radiance of one region to out (v, 3)."""
    points, eye, sent, gloss = region
    b, _, rows, width = sent.values.shape
    factors = 1 + outgoing.shape[1]
    lobes: dict[str, Tensor | None] = dict.fromkeys(LitLobes._fields)
    if gloss is not None:
        lobes = {name: None if tensor is None else tensor.contiguous() for name, tensor in gloss._asdict().items()}
    run(
        "view",
        position=points.position,
        frame=points.frame,
        dip=points.dip,
        colour=points.colour,
        eye=eye.contiguous(),
        outgoing=outgoing,
        values=sent.values,
        unit=sent.unit,
        cuts=points.cuts,
        point=points.point,
        out=out,
        blocks=b,
        width=width,
        rows=rows,
        points=out.shape[0],
        distant=eye.ndim == 2,
        factors=factors,
        harmonics=rows - 1 - factors,
        lobes=0 if gloss is None else gloss.which.shape[0],
        tilts=0 if gloss is None else gloss.axes.shape[0],
        disk=side(outgoing.shape[0]),
        cells=side(points.cuts.shape[1]),
        map=0 if gloss is None or gloss.maps is None else side(gloss.maps.shape[1]),
        **lobes,
    )


def _conditions(*arguments: Sequence[Tensor | None]) -> Conditions:
    outgoing = arguments[-1]
    assert isinstance(outgoing, Tensor)
    yield of_type(torch.float32, outgoing), "outgoing must be float32"
    yield square(outgoing.shape[0]), "outgoing must be on a square grid"
    for region in _regions(*arguments[:-1]):
        yield from _of_points(region, 1 + outgoing.shape[1])
        if region.lobes is not None:
            yield from _of_lobes(region.lobes, region.points.cuts, region.sent.values.shape[2] - 2 - outgoing.shape[1])


def _of_points(region: ViewedRegion, factors: int) -> Conditions:
    points, eye, (values, unit), _ = region
    reals = (points.position, points.frame, points.dip, points.colour, eye, unit)
    yield of_type(torch.float32, *reals), "points must be float32"
    yield of_type(torch.int16, values), "values must be int16, as the kernel of expand writes them"
    yield of_type(torch.int32, points.point), "point must be int32"
    large = (points.position, points.frame, points.dip, points.colour, unit, values, points.point)
    yield contiguous(*large), "points and values must be contiguous"
    yield values.ndim == 4 and values.shape[1] == 3, "values must be (b, 3, x, w)"
    b, _, rows, width = values.shape
    n = b * width
    yield width % GROUP == 0, f"blocks must hold a multiple of {GROUP} points"
    yield rows > factors, "values must have a row for each outgoing factor, and one more"
    yield points.position.shape == (3, n), "position must be (3, n)"
    yield points.frame.shape == (3, 3, n), "frame must be (3, 3, n)"
    yield points.dip.shape == points.point.shape == (n,), "dip and point must be (n,)"
    yield points.colour is None or points.colour.shape == (3, n), "colour must be (3, n)"
    yield eye.shape in ((3,), (3, n)), "eye must be (3,) or (3, n)"
    yield unit.shape == values.shape[:3], "unit must be (b, 3, x)"


def _of_lobes(gloss: LitLobes, cuts: Tensor, harmonics: int) -> Conditions:
    which, rho, axes, specular, maps, turn, blurs = gloss
    k = which.shape[0]
    tilts = axes.shape[0]
    yield of_type(torch.float32, rho, axes, specular, maps, turn, blurs), "lobes must be float32"
    yield of_type(torch.int64, which), "which must be int64"
    yield 0 < k <= MOST_LOBES, f"there must be 1..{MOST_LOBES} lobes"
    yield rho.shape == (tilts, k), "lobes must be isotropic: rho (tilts, k)"
    yield axes.shape == (tilts, 2 * k), "axes must be (tilts, 2 k)"
    yield specular.shape == (3,), "specular must be (3,)"
    yield turn.shape == (3, 3), "turn must be (3, 3)"
    if maps is not None:
        yield maps.ndim == 3 and maps.shape[::2] == (k, CHANNELS), "maps must be (k, cells, 4)"
        yield maps.shape[1] > 1 and square(maps.shape[1]), "maps must be square"
        yield of_type(torch.int32, cuts) and contiguous(cuts), "cuts must be int32, contiguous"
        yield square(cuts.shape[1]) and side(cuts.shape[1]) % TILE == 0, "cuts must be a square of whole tiles"
    yield harmonics in (0, HARMONICS), f"values must have no harmonics, or {HARMONICS}"
    yield harmonics == 0 or blurs.shape == (k, HARMONICS), f"blurs must be (k, {HARMONICS})"


def _fake(*arguments: Sequence[Tensor]) -> Tensor:
    outgoing = arguments[-1]
    assert isinstance(outgoing, Tensor)
    place, values = arguments[COLUMNS.index("place")], arguments[COLUMNS.index("values")]
    return outgoing.new_empty(sum(len(p) for p in place), values[0].shape[1])


_view = operator(SCHEMA, plain=_plain, kernel=_kernel, conditions=_conditions, fake=_fake)
