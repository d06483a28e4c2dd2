"""The compressed transfer of a scene: what `compress` makes, `save` writes and `TransferRelighter` evaluates."""

from __future__ import annotations

import warnings
from os import PathLike
from typing import Any

import torch
from torch import Tensor, nn

from ptt import saved
from ptt.materials import BlinnPhongSpace
from ptt.models.tensor_brdf import TensorBRDF
from ptt.ops.sphere import Cube
from ptt.receivers import Receivers

KIND = "transfer model"


class TransferModel(nn.Module):
    """T0 in the Haar basis of a cube map, truncated, with the receivers and the BRDF tensor that it belongs to.

    receivers: names, counts, default materials of the regions
    index (i, v, k) int16: cube map coefficients kept for each incident factor and point; factor 0 is diffuse
    value (i, v, k) float32: their values [sr]
    positions (v, 3), frames (v, 3, 3), colours (v, 3): of the receivers
    resolution: cells along an edge of the cube map
    truncation_error: relative L2 error of T0 that leaving out the other coefficients makes
    """

    index: Tensor
    value: Tensor
    positions: Tensor
    frames: Tensor
    colours: Tensor

    def __init__(
        self,
        receivers: Receivers,
        brdf: TensorBRDF,
        resolution: int,
        index: Tensor,
        value: Tensor,
        truncation_error: float,
    ) -> None:
        super().__init__()
        self.receivers, self.resolution, self.brdf = receivers, resolution, brdf
        self.truncation_error = truncation_error
        for name, tensor in {"index": index, "value": value, **receivers.tensors()}.items():
            self.register_buffer(name, tensor)

    @property
    def grid(self) -> Cube:
        """The lighting's cube map."""
        return Cube(self.resolution)

    @property
    def bytes(self) -> int:
        """Size of all buffers."""
        return sum(buffer.numel() * buffer.element_size() for buffer in self.buffers())

    def transfer(self) -> Tensor:
        """T0 as a sparse CSR matrix (i * v, l), rows ordered (i, v)."""
        i, v, k = self.value.shape
        starts = torch.arange(0, i * v * k + 1, k, dtype=torch.int32, device=self.value.device)
        with torch.sparse.check_sparse_tensor_invariants(enable=False), warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Sparse CSR tensor support is in beta")
            return torch.sparse_csr_tensor(
                starts, self.index.flatten().int(), self.value.flatten(), size=(i * v, self.grid.cells)
            )

    def save(self, path: str | PathLike[str]) -> None:
        """Write a safetensors file with the config in its header."""
        config = {
            "resolution": self.resolution,
            "kept": self.value.shape[2],
            "truncation_error": self.truncation_error,
            "ranks": list(self.brdf.core.shape),
            "disk": self.brdf.u_i.shape[1],
            "exponents": list(self.brdf.space.exponents),
            **self.receivers.config(),
        }
        saved.save(path, KIND, config, self.state_dict())

    @classmethod
    def load(cls, path: str | PathLike[str]) -> TransferModel:
        """Read what `save` wrote.

        Raises:
            ValueError: the file is missing, damaged or not a transfer model; the message names what is wrong.
        """
        config, tensors = saved.load(path, KIND)
        with saved.describing(path):
            saved.check(path, tensors, _expected(config))
            cells = Cube(config["resolution"]).cells
            if int(tensors["index"].min()) < 0 or int(tensors["index"].max()) >= cells:
                raise ValueError(f"{path}: index must be in 0..{cells - 1}")
            parts = {name.removeprefix("brdf."): t for name, t in tensors.items() if name.startswith("brdf.")}
            return cls(
                Receivers.restore(config, tensors),
                TensorBRDF(BlinnPhongSpace(tuple(config["exponents"])), **parts),
                config["resolution"],
                tensors["index"],
                tensors["value"],
                config["truncation_error"],
            )


def _expected(config: dict[str, Any]) -> saved.Shapes:
    h, o, i = config["ranks"]
    n, k = config["disk"], config["kept"]
    v = sum(region["points"] for region in config["regions"])
    cells = Cube(config["resolution"]).cells
    samples = len(config["exponents"])
    return {
        "index": (torch.int16 if cells <= 1 << 15 else torch.int32, (1 + i, v, k)),
        "value": (torch.float32, (1 + i, v, k)),
        "brdf.core": (torch.float32, (h, o, i)),
        "brdf.u_h": (torch.float32, (samples, h)),
        "brdf.u_o": (torch.float32, (o, n, n)),
        "brdf.u_i": (torch.float32, (i, n, n)),
        "brdf.error": (torch.float32, (samples,)),
        **Receivers.expected(config),
    }
