"""Measured BRDFs: tables in the MERL format, and neural fits of them.

Tables (`MERL`) and fits (`NeuralBRDF`) have `evaluate(wi, wo)`: RGB (..., 3) [1/sr] without the cosine, for local unit
directions (..., 3), which broadcast; it is zero where either direction is at or below the horizon. They are isotropic:
they see the directions through `half_difference` alone.

    gold = MERL.load("gold-metallic-paint.binary")             # maps the file: its 33 MB stay on the disk
    radiance = gold.evaluate(wi, wo) * wi[..., 2:]

Matusik, Pfister, Brand and McMillan 2003 (tables); Rusinkiewicz 1998 (coordinates); Sztrajman, Rainer, Ritschel and
Weyrich 2021 (fits).
"""

from __future__ import annotations

import difflib
import math
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from os import PathLike
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ptt.ops import brdf

Interpolation = Literal["linear", "nearest"]
Stencil = list[tuple[Tensor, Tensor]]  # along one axis: cell numbers and their weights

CELLS = (90, 90, 180)  # theta_h, theta_d, phi_d; the last varies fastest
_HEADER = np.array(CELLS, dtype="<i4")
_BYTES = _HEADER.nbytes + 3 * math.prod(CELLS) * 8
_SCALE = torch.tensor([1.0, 1.15, 1.66], dtype=torch.float64) / 1500  # 1/sr per unit in the file
_FLOOR = 1e-12  # least weight of a cell, so that the centre of a masked one takes its neighbours' mean


class HalfDifference(NamedTuple):
    """Rusinkiewicz's coordinates of two directions, without the azimuth of h; each (...) [rad]."""

    theta_h: Tensor
    theta_d: Tensor
    phi_d: Tensor


def half_difference(wi: Tensor, wo: Tensor) -> HalfDifference:
    """The polar angle of h, the unit half vector, and polar angle and azimuth of wi in the frame whose pole is h.

    wi, wo (..., 3): unit directions, local frame
    Returns theta_h in 0..pi (0..pi/2 above the horizon), theta_d in 0..pi/2, phi_d in -pi..pi.

    - turning wi and wo about the normal changes nothing
    - exchanging wi and wo adds pi to phi_d and changes nothing else
    - phi_d = 0 or pi in the plane of h and the normal; 0 where wi = wo, and arbitrary where theta_h = 0

    All angles are arc tangents: the arc cosine of the original code loses half of the digits at h = n and at wi = wo.

    Rusinkiewicz 1998, section 3.
    """
    h = brdf.half_vector(wi, wo)
    d = (wi - wo) / 2  # d: wi less its part along h
    sin = torch.hypot(h[..., 0], h[..., 1])
    cos = h[..., 2]
    x = torch.where(sin > 0, h[..., 0] / sin, 1.0)  # cosine and sine of the azimuth of h
    y = torch.where(sin > 0, h[..., 1] / sin, 0.0)
    along = x * d[..., 0] + y * d[..., 1]
    across = x * d[..., 1] - y * d[..., 0]
    theta_d = torch.atan2(d.norm(dim=-1), (wi + wo).norm(dim=-1) / 2)
    return HalfDifference(torch.atan2(sin, cos), theta_d, torch.atan2(across, cos * along - sin * d[..., 2]))


def from_half_difference(theta_h: Tensor, theta_d: Tensor, phi_d: Tensor) -> tuple[Tensor, Tensor]:
    """The inverse of `half_difference`, with h in the x-z plane: angles (...) [rad] -> wi (..., 3), wo (..., 3)."""
    along = torch.sin(theta_d) * torch.cos(phi_d)
    across = torch.sin(theta_d) * torch.sin(phi_d)
    sin = torch.sin(theta_h)
    cos = torch.cos(theta_h)
    up = torch.cos(theta_d)
    wi = torch.stack((cos * along + sin * up, across, cos * up - sin * along), dim=-1)
    wo = torch.stack((sin * up - cos * along, -across, cos * up + sin * along), dim=-1)
    return wi, wo


@dataclass(frozen=True, eq=False)
class MERL:
    """A table over (theta_h, theta_d, phi_d): 90 x 90 x 180 cells per colour, as the MERL database stores it.

    planes (3, 90, 90, 180): values as in the file, R, G, B; times 1, 1.15, 1.66 / 1500 they are in 1/sr. `load` maps
        them; `MERL(np.array(table.planes))` is a copy in memory
    interpolation: "linear" in the three angles between cell centres (constant beyond the outermost, around the circle
        in phi_d), or "nearest", the cell that the database's own code reads

    - cell k covers k..k+1 of 90 sqrt(theta_h / 90 deg), of theta_d / 1 deg, and of phi_d / 1 deg modulo 180
    - reciprocal by construction: phi_d and phi_d + pi are one cell (at phi_d = pi itself the original reads the last
      one, and this class the first)
    - a negative value in any colour masks the cell. Masked cells take no part, the other weights are renormalised; the
      value is 0 where no neighbour is left ("nearest": where the cell is masked)

    Lookups are not differentiable in the table; they run on the CPU, whatever the directions' device.

    Raises:
        ValueError: planes have another shape, or the interpolation is unknown.

    Matusik et al. 2003; cell numbers as in the database's BRDFRead.cpp.
    """

    planes: npt.NDArray[np.float64]
    interpolation: Interpolation = "linear"

    def __post_init__(self) -> None:
        if self.planes.shape != (3, *CELLS):
            raise ValueError(f"planes must have shape {(3, *CELLS)}, got {self.planes.shape}")
        if self.interpolation not in _STENCILS:
            raise ValueError(f"interpolation must be one of {', '.join(_STENCILS)}, got {self.interpolation!r}")

    @classmethod
    def load(cls, path: str | PathLike[str], interpolation: Interpolation = "linear") -> MERL:
        """Map a .binary file: three int32 (90, 90, 180), then float64 planes R, G, B; little-endian.

        Raises:
            ValueError: the file is missing, has another header, or another size.
        """
        path = Path(path)
        if not path.is_file():
            raise ValueError(f"{path}: no such file; expected a MERL .binary of {_BYTES} bytes")
        header = np.fromfile(path, dtype="<i4", count=3)
        if header.size < 3 or (header != _HEADER).any():
            raise ValueError(f"{path}: a MERL .binary begins with int32 {list(CELLS)}, got {header.tolist()}")
        if (size := path.stat().st_size) != _BYTES:
            raise ValueError(f"{path}: a MERL .binary has 12 + 3 * 90 * 90 * 180 * 8 = {_BYTES} bytes, got {size}")
        planes = np.memmap(path, dtype="<f8", mode="r", offset=_HEADER.nbytes, shape=(3, *CELLS))
        return cls(planes, interpolation)

    @staticmethod
    def write(path: str | PathLike[str], brdf_function: Callable[[Tensor, Tensor], Tensor]) -> None:
        """Sample f(wi, wo) at the cell centres and write a file that `load` reads; f is called with float64.

        brdf_function: f, (n, 3), (n, 3) -> RGB (n, 3) [1/sr]; a negative value means not measured: the cell is masked,
            like those whose centre is below the horizon

        Raises:
            ValueError: f returns another shape, or a value that is not finite above the horizon.
        """
        slabs = [_sample(brdf_function, k) for k in range(CELLS[0])]
        with Path(path).open("wb") as file:
            file.write(_HEADER.tobytes())
            file.write(torch.stack(slabs, dim=1).numpy().astype("<f8").tobytes())

    @property
    def masked_cells(self) -> int:
        """The number of masked cells among the 1,458,000, those below the horizon included; reads the whole table."""
        return math.prod(CELLS) - int(((self.planes >= 0) & (self.planes < np.inf)).all(axis=0).sum())

    def evaluate(self, wi: Tensor, wo: Tensor) -> Tensor:
        """RGB (..., 3) [1/sr] for local unit directions wi and wo (..., 3), in their dtype."""
        above = _above(wi, wo)
        stencils = _STENCILS[self.interpolation](*_cell_coordinates(half_difference(wi, wo), above))
        total = torch.zeros(())
        weight = torch.zeros(())
        for (h, a), (d, b), (p, c) in product(*stencils):
            value, valid = self._read(h, d, p)
            w = (a * b * c * valid)[..., None]
            total = total + w * value
            weight = weight + w
        return (total / weight.clamp(min=1e-60) * above[..., None].cpu()).to(wi)

    def _read(self, h: Tensor, d: Tensor, p: Tensor) -> tuple[Tensor, Tensor]:
        """Values (..., 3) [1/sr] of cells by number (...), which may overrun, 0 where masked, and validity (...)."""
        h = h.clamp(0, CELLS[0] - 1)
        d = d.clamp(0, CELLS[1] - 1)
        p = p % CELLS[2]
        cells = self.planes[:, h.long().numpy(), d.long().numpy(), p.long().numpy()]
        value = torch.from_numpy(np.array(cells, dtype=np.float64)).movedim(0, -1)
        valid = ((value >= 0) & (value < math.inf)).all(-1)
        return torch.where(valid[..., None], value * _SCALE, 0.0), valid


@dataclass(frozen=True, eq=False)
class NeuralBRDF:
    """A fit of one MERL material by a network of 675 weights, relu(exp(y) - 1) of y = W3 relu(W2 relu(W1 x)).

    name: that of the material
    layers: three times weights (in, out) and biases (out), over 6 -> 21 -> 21 -> 3. x holds h and wi as vectors in
        the frame that has h in the x-z plane: (sin th_h, 0, cos th_h, sin th_d cos phi_d, sin th_d sin phi_d, cos th_d)

    The scale of the MERL colours is in the weights. A fit is reciprocal only to its own accuracy.

    Sztrajman et al. 2021, section 3.
    """

    name: str
    layers: tuple[tuple[Tensor, Tensor], ...]

    @classmethod
    def load(cls, path: str | PathLike[str], name: str) -> NeuralBRDF:
        """The fit of one material in an .npz with names (n), w1 (n, 6, 21), b1 (n, 21), w2, b2, w3, b3.

        Raises:
            ValueError: the file is missing or holds something else, or no material has that name; the message has the
                names closest to it.

        Nothing is unpickled.
        """
        names, *arrays = _arrays(path, "names", "w1", "b1", "w2", "b2", "w3", "b3")
        known = [str(n) for n in names]
        if name not in known:
            close = ", ".join(difflib.get_close_matches(name, known, n=3, cutoff=0.0))
            raise ValueError(f"name must be one of the {len(known)} materials of {path}, such as {close}; got {name!r}")
        if (shapes := [a.shape[1:] for a in arrays]) != _SHAPES:
            raise ValueError(f"{path}: w1, b1, w2, b2, w3, b3 must have shapes (n, *s) with s {_SHAPES}, got {shapes}")
        w1, b1, w2, b2, w3, b3 = (torch.from_numpy(a[known.index(name)].copy()) for a in arrays)
        return cls(name, ((w1, b1), (w2, b2), (w3, b3)))

    @staticmethod
    def names(path: str | PathLike[str]) -> tuple[str, ...]:
        """The names of the materials that a file holds.

        Raises:
            ValueError: the file is missing or holds something else.
        """
        return tuple(str(n) for n in _arrays(path, "names")[0])

    def evaluate(self, wi: Tensor, wo: Tensor) -> Tensor:
        """RGB (..., 3) [1/sr] for local unit directions wi and wo (..., 3), in their dtype."""
        theta_h, theta_d, phi_d = half_difference(wi, wo)
        sin_h = torch.sin(theta_h)
        sin_d = torch.sin(theta_d)
        zero = torch.zeros_like(theta_h)
        d = (sin_d * torch.cos(phi_d), sin_d * torch.sin(phi_d), torch.cos(theta_d))
        x = torch.stack((sin_h, zero, torch.cos(theta_h), *d), dim=-1)  # (..., 6)
        *hidden, (weight, bias) = self.layers
        for w, b in hidden:
            x = torch.relu(x @ w.to(x) + b.to(x))
        value = torch.relu(torch.expm1(x @ weight.to(x) + bias.to(x)))
        return torch.where(_above(wi, wo)[..., None], value, 0.0)


_SHAPES = [(6, 21), (21,), (21, 21), (21,), (21, 3), (3,)]  # of the weights and biases of one material


def _above(wi: Tensor, wo: Tensor) -> Tensor:
    """Tell (...) where both directions lie above the horizon."""
    return (wi[..., 2] > 0) & (wo[..., 2] > 0)


def _cell_coordinates(angles: HalfDifference, above: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Coordinates (...), float64 on the CPU, in which cell k is k..k+1, of angles (...); 0 below the horizon."""
    h, d, p = (torch.where(above, a, 0.0).double().cpu() for a in angles)
    return (h * 2 / math.pi).sqrt() * 90, d * 2 / math.pi * 90, torch.remainder(p, math.pi) / math.pi * 180


def _centres(h: int) -> tuple[Tensor, Tensor]:
    """wi and wo (90 * 180, 3) at the centres of the cells with number h along theta_h; phi_d varies fastest."""
    theta_h = torch.tensor(((h + 0.5) / 90) ** 2 * math.pi / 2, dtype=torch.float64)
    theta_d, phi_d = (torch.arange(n, dtype=torch.float64).add(0.5) * (math.pi / 180) for n in CELLS[1:])
    grid = torch.meshgrid(theta_h, theta_d, phi_d, indexing="ij")
    return from_half_difference(*(angle.flatten() for angle in grid))


def _sample(brdf_function: Callable[[Tensor, Tensor], Tensor], h: int) -> Tensor:
    """The file's values (3, 90, 180) of f in the cells with number h along theta_h; -1 is masked."""
    wi, wo = _centres(h)
    value = brdf_function(wi, wo).detach().cpu()
    above = _above(wi, wo)
    if value.shape != wi.shape:
        raise ValueError(f"brdf_function must return RGB {tuple(wi.shape)}, got {tuple(value.shape)}")
    if not bool(value[above].isfinite().all()):
        raise ValueError("brdf_function must return finite values above the horizon, got nan or inf")
    keep = above & (value >= 0).all(-1)
    return torch.where(keep[:, None], value.double() / _SCALE, -1.0).T.reshape(3, *CELLS[1:])


def _nearest(h: Tensor, d: Tensor, p: Tensor) -> list[Stencil]:
    """The cell that holds each coordinate."""
    return [[(x.floor(), torch.ones_like(x))] for x in (h, d, p)]


def _linear(h: Tensor, d: Tensor, p: Tensor) -> list[Stencil]:
    """The two cells whose centres surround each coordinate; weights along theta_h, the square of h, go by the angle."""
    stencils = []
    for x in (h, d, p):
        low = (x - 0.5).floor()
        t = x - 0.5 - low
        if x is h:
            t = (t * (x + low + 0.5) / (2 * low + 2).clamp(min=1)).clamp(0, 1)
        stencils.append([(low, (1 - t).clamp(min=_FLOOR)), (low + 1, t.clamp(min=_FLOOR))])
    return stencils


_STENCILS: dict[str, Callable[[Tensor, Tensor, Tensor], list[Stencil]]] = {"linear": _linear, "nearest": _nearest}


def _arrays(path: str | PathLike[str], *keys: str) -> list[npt.NDArray[Any]]:
    """The arrays of an .npz by their names; nothing is unpickled."""
    if not Path(path).is_file():
        raise ValueError(f"{path}: no such file; expected an .npz of neural BRDFs")
    try:
        with np.load(path, allow_pickle=False) as file:
            return [file[key] for key in keys]
    except (ValueError, KeyError, TypeError, EOFError, AttributeError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path}: expected an .npz with arrays {', '.join(keys)}, got: {error}") from error
