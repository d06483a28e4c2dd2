"""A sky with a letter on each of six faces, and its images in every layout, by formulas of their own.

The letters are those of a viewer who looks along -z with +y up: Right +x, Left -x, Up +y, Down -y, Back +z, Front -z.
Each is upright for who turns to it; to U and D one tilts the head from F, so that F lies below U and above D. A smooth
shade over all faces shows where texels lie: half a texel changes it by about 1e-3.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from math import pi
from pathlib import Path

import numpy as np
import PIL.Image
import PIL.ImageDraw
import PIL.ImageFont
import torch
from torch import Tensor

from ptt.io.images import write_image

LETTERS = "RLUDBF"
AXES = ("+x", "-x", "+y", "-y", "+z", "-z")
AHEAD = torch.tensor([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)], dtype=torch.float64)
UP = torch.tensor([(0, 1, 0), (0, 1, 0), (0, 0, 1), (0, 0, -1), (0, 1, 0), (0, 1, 0)], dtype=torch.float64)
RIGHT = torch.linalg.cross(AHEAD, UP)
COLOURS = torch.tensor(  # linear, of the faces
    [(0.6, 0.04, 0.03), (0.02, 0.34, 0.4), (0.05, 0.36, 0.06), (0.36, 0.04, 0.36), (0.03, 0.1, 0.6), (0.6, 0.33, 0.01)],
    dtype=torch.float64,
)
WHITE = 3.0  # radiance of the letters, more than a .png holds
SHADE = torch.tensor([0.12, 0.15, 0.16], dtype=torch.float64)
FINE = 512  # texels along a letter's edge
SAMPLES = 3  # along an edge of a texel or pixel
MARGIN = 0.06  # of half a face, from an edge, that is not compared: what texels blur
SIZES = {  # height, width
    "latlong": (256, 512),
    "cross": (512, 384),
    "angular": (512, 512),
    "octahedral": (384, 384),
    "poles": (257, 512),
}


@cache
def glyphs(size: int) -> Tensor:
    """Where (6, size, size) the letters are white: each with its axis below, row 0 on top."""
    pages = []
    for letter, axis in zip(LETTERS, AXES, strict=True):
        page = PIL.Image.new("L", (size, size))
        draw = PIL.ImageDraw.Draw(page)
        for text, place, height, bold in ((letter, 0.42, 0.58, 0.022), (axis, 0.8, 0.2, 0.006)):
            font = PIL.ImageFont.load_default(height * size)
            draw.text((size / 2, place * size), text, 255, font, "mm", stroke_width=bold * size)
        pages.append(np.array(page))
    return torch.from_numpy(np.stack(pages)) > 127


def looked_up(pages: Tensor, face: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """The texels of pages (6, size, size) of faces (n,) at x (n,) to the right and y (n,) up, both -1 to 1."""
    size = pages.shape[-1]
    column = ((x + 1) * (size / 2)).long().clamp(0, size - 1)
    row = ((1 - y) * (size / 2)).long().clamp(0, size - 1)
    return pages[face, row, column]


def flattened(directions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The face (...,) that directions (..., 3) lie in, and where in it: x to the right and y up, both -1 to 1."""
    face = (directions @ AHEAD.T).argmax(-1)
    depth = (directions * AHEAD[face]).sum(-1)
    x = (directions * RIGHT[face]).sum(-1) / depth
    y = (directions * UP[face]).sum(-1) / depth
    return face, x, y


def sky(directions: Tensor) -> Tensor:
    """Radiance (..., 3) from unit directions (..., 3), float64."""
    face, x, y = flattened(directions)
    letter = looked_up(glyphs(FINE), face, x, y)
    flat = torch.where(letter[..., None], WHITE, COLOURS[face])
    return flat * (0.75 + directions @ SHADE)[..., None]


def clear(directions: Tensor) -> Tensor:
    """Whether unit directions (n, 3) lie away from the edges of faces and letters."""
    face, x, y = flattened(directions)
    return looked_up(_far_from_edges(), face, x, y)


@cache
def _far_from_edges() -> Tensor:
    """Where (6, FINE, FINE) all within MARGIN is alike."""
    reach = round(MARGIN * FINE / 2)
    white = glyphs(FINE).float()
    far = _widened(white, reach) != _widened(1 - white, reach)
    inner = torch.zeros_like(far)
    inner[:, reach:-reach, reach:-reach] = True
    return far & inner


def _widened(pages: Tensor, reach: int) -> Tensor:
    """The largest values of pages (6, h, w) within `reach` along rows and columns."""
    down = torch.nn.functional.max_pool2d(pages[:, None], (2 * reach + 1, 1), 1, (reach, 0))
    return torch.nn.functional.max_pool2d(down, (1, 2 * reach + 1), 1, (0, reach))[:, 0]


def clear_directions(count: int, seed: int = 0) -> Tensor:
    """At most `count` unit directions (n, 3) at random that are `clear`, every face and letter among them."""
    random = torch.randn(2 * count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    directions: Tensor = random / random.norm(dim=1, keepdim=True)
    return directions[clear(directions)][:count]


def errors(radiance: Tensor, directions: Tensor) -> Tensor:
    """The errors (n,) of radiance (n, 3) from directions (n, 3), each relative to the brightest channel there."""
    exact = sky(directions)
    return (radiance.double() - exact).abs().amax(-1) / exact.amax(-1)


# --- Layouts: the direction (n, 3) of a place u to the right and v down, both 0 to 1; 0 where an image shows none


def latlong(u: Tensor, v: Tensor) -> Tensor:
    """Row 0 at +y; from the left -z, +x, +z, -x, -z."""
    theta = pi * v
    phi = 2 * pi * u
    return torch.stack((theta.sin() * phi.sin(), theta.cos(), -theta.sin() * phi.cos()), -1)


def cross(u: Tensor, v: Tensor) -> Tensor:
    """From the top U; L F R; D; B upside down."""
    directions = torch.zeros(*u.shape, 3, dtype=torch.float64)
    for letter, column, row in (("U", 1, 0), ("L", 0, 1), ("F", 1, 1), ("R", 2, 1), ("D", 1, 2), ("B", 1, 3)):
        face = LETTERS.index(letter)
        x = 2 * (3 * u - column) - 1
        y = 1 - 2 * (4 * v - row)
        turned = -1 if letter == "B" else 1
        inside = (x.abs() <= 1) & (y.abs() <= 1)
        cell = AHEAD[face] + turned * (x[..., None] * RIGHT[face] + y[..., None] * UP[face])
        directions = torch.where(inside[..., None], cell / cell.norm(dim=-1, keepdim=True), directions)
    return directions


def angular(u: Tensor, v: Tensor) -> Tensor:
    """F in the middle, B all around the rim: the distance from the middle is the angle from -z."""
    a = 2 * u - 1
    b = 1 - 2 * v
    r = torch.hypot(a, b)
    sine = (pi * r).sin() / r
    return torch.stack((sine * a, sine * b, -(pi * r).cos()), -1) * (r <= 1)[..., None]


def octahedral(u: Tensor, v: Tensor) -> Tensor:
    """`EqualAreaSquareToSphere` of pbrt-v4, whose x, y, z are x, -z, y here."""
    a = 2 * u - 1
    b = 2 * v - 1
    signed = 1 - a.abs() - b.abs()
    r = 1 - signed.abs()
    phi = ((b.abs() - a.abs()) / r + 1) * (pi / 4)
    height = (1 - r**2).copysign(signed)
    across = r * (2 - r**2).sqrt()
    return torch.stack((across * phi.cos().copysign(a), height, -across * phi.sin().copysign(b)), -1)


def poles(u: Tensor, v: Tensor) -> Tensor:
    """Lat-long as Mitsuba reads it: the first row lies at the pole +y, the last at -y."""
    height, _ = SIZES["poles"]
    return latlong(u, (height * v - 0.5) / (height - 1))


LAYOUTS: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "latlong": latlong,
    "cross": cross,
    "angular": angular,
    "octahedral": octahedral,
    "poles": poles,
}


@cache
def image(layout: str) -> Tensor:
    """The sky's image (height, width, 3), float32: means over the texels, black where a layout shows nothing."""
    height, width = SIZES[layout]
    v, u = torch.meshgrid(_centres(height * SAMPLES), _centres(width * SAMPLES), indexing="ij")
    directions = LAYOUTS[layout](u, v)
    radiance = sky(directions) * directions.any(-1, keepdim=True)
    return reduced(radiance).float()


def reduced(samples: Tensor) -> Tensor:
    """Means (h, w, 3) over the samples (h * SAMPLES, w * SAMPLES, 3) of texels or pixels."""
    height, width, _ = samples.shape
    return samples.reshape(height // SAMPLES, SAMPLES, width // SAMPLES, SAMPLES, 3).mean((1, 3))


def write(folder: Path, layout: str, ending: str) -> Path:
    """The file of the sky's image in a layout."""
    path = folder / f"{layout}.{ending}"
    write_image(path, image(layout))
    return path


def _centres(count: int) -> Tensor:
    """Middles (count,) of equal steps from 0 to 1."""
    return (torch.arange(count, dtype=torch.float64) + 0.5) / count
