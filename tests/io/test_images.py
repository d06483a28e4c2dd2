"""Images: what is written comes back, in linear values; broken files are refused by name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest
import torch

from ptt.io.colour import from_srgb, to_srgb
from ptt.io.images import read_image, write_image


def image(channels: int = 3) -> torch.Tensor:
    generator = torch.Generator().manual_seed(channels)
    return 4 * torch.rand(5, 7, channels, generator=generator)


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_exr_keeps_every_bit(tmp_path: Path, channels: int) -> None:
    written = image(channels) * torch.tensor(1e5)
    written[0, 0, 0] = -1.5
    write_image(tmp_path / "a.exr", written)
    read = read_image(str(tmp_path / "a.exr"))
    assert read.dtype == torch.float32
    assert torch.equal(read, written)


def test_exr_of_a_view_holds_the_view(tmp_path: Path) -> None:
    """OpenEXR writes wrong pixels from strided arrays without saying so."""
    view = image().flip(0).transpose(0, 1)[::2].double()
    write_image(tmp_path / "a.exr", view.requires_grad_())
    assert torch.equal(read_image(tmp_path / "a.exr"), view.float())


@pytest.mark.parametrize("kind", [np.float16, np.float32])
@pytest.mark.parametrize("names", ["RGB", "RGBA", "Y", "YA", "RGBZ"])
def test_exr_channels_of_others(tmp_path: Path, names: str, kind: type) -> None:
    planes: dict[str, Any] = {name: np.full((3, 4), i + 1, dtype=kind) for i, name in enumerate(names)}
    OpenEXR.File({}, planes).write(str(tmp_path / "a.exr"))
    expected = torch.arange(len(names.strip("Z"))) + 1.0
    assert torch.equal(read_image(tmp_path / "a.exr"), expected.expand(3, 4, -1))


def test_exr_without_colour_is_refused(tmp_path: Path) -> None:
    OpenEXR.File({}, {"Z": np.ones((2, 2), np.float32)}).write(str(tmp_path / "a.exr"))
    with pytest.raises(ValueError, match=r"a\.exr: it must have channels R, G, B or Y, got Z"):
        read_image(tmp_path / "a.exr")


def test_hdr_keeps_eight_bits_of_mantissa(tmp_path: Path) -> None:
    """RGBE shares an exponent: errors up to 2^-8 of the largest channel."""
    written = image() * 1000
    write_image(tmp_path / "a.hdr", written)
    error = (read_image(tmp_path / "a.hdr") - written).abs() / written.amax(-1, keepdim=True)
    assert 0 < error.max() <= 2**-7


def test_png_is_srgb_clipped_and_read_back_linear(tmp_path: Path) -> None:
    """Half a step of 255 at the inverse curve's steepest slope, 2.28: 4.5e-3. Code 188 is linear 0.5029."""
    written = image() / 3
    written[0, 0] = torch.tensor([-1.0, 0.5029, 2.0])
    write_image(tmp_path / "a.png", written)
    assert (read_image(tmp_path / "a.png") - written.clamp(0, 1)).abs().max() < 4.6e-3
    file = oiio.ImageInput.open(str(tmp_path / "a.png"))
    assert file is not None
    raw = file.read_image("uint8")
    assert raw is not None and raw.shape == (5, 7, 3)
    assert raw[0, 0].tolist() == [0, 188, 255]


def test_png_alpha_is_linear(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png", torch.full((2, 2, 4), 0.2))
    read = read_image(tmp_path / "a.png")
    assert torch.allclose(read[..., 3], torch.tensor(0.2))
    assert torch.allclose(read[..., :3], torch.tensor(0.2), atol=4e-3)


def test_srgb_curve() -> None:
    """IEC 61966-2-1: 0.0031308 is where the pieces meet; 0.2140 encodes to 0.5."""
    x = torch.linspace(0, 1, 1001, dtype=torch.float64)
    assert torch.allclose(from_srgb(to_srgb(x)), x, atol=1e-6)
    assert float(to_srgb(torch.tensor(0.21404114))) == pytest.approx(0.5, abs=1e-6)
    assert float(to_srgb(torch.tensor(0.001))) == pytest.approx(0.01292, abs=1e-7)
    x = torch.zeros(3, requires_grad=True)
    to_srgb(x).sum().backward()
    assert x.grad is not None and torch.allclose(x.grad, torch.tensor(12.92))


@pytest.mark.parametrize("ending", [".exr", ".hdr", ".png"])
def test_missing_broken_and_cut_files_are_refused_by_name(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"a{ending}"
    with pytest.raises(ValueError, match=f"cannot read .*a{ending}"):
        read_image(path)
    path.write_bytes(b"hello")
    with pytest.raises(ValueError, match=f"cannot read .*a{ending}"):
        read_image(path)
    write_image(path, torch.rand(64, 64, 3))
    whole = path.read_bytes()
    for share in (0.1, 0.5, 0.9):
        path.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(ValueError, match=f"cannot read .*a{ending}"):
            read_image(path)


def test_bad_requests_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"\.exr, \.hdr, \.pic, \.png, got a\.tiff"):
        read_image("a.tiff")
    for shape in ((4, 4), (4, 4, 2), (0, 4, 3)):
        with pytest.raises(ValueError, match="image must have shape"):
            write_image(tmp_path / "a.exr", torch.ones(shape))
    with pytest.raises(ValueError, match="1 of 12 values"):
        write_image(tmp_path / "a.png", (torch.arange(12.0) - 3).reciprocal().reshape(2, 2, 3))
    with pytest.raises(ValueError, match="needs 3 channels >= 0"):
        write_image(tmp_path / "a.hdr", -torch.ones(2, 2, 3))
    for ending in ("exr", "hdr", "png"):
        with pytest.raises(ValueError, match="cannot write"):
            write_image(tmp_path / "nowhere" / f"a.{ending}", torch.ones(2, 2, 3))
