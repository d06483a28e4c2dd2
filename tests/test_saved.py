"""Saved models: round trips to the bit, and everything that a file can have wrong with it."""

from __future__ import annotations

import json
import pickle
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

import ptt


def parts(path: Path) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    with safe_open(str(path), framework="pt") as file:
        return json.loads(file.metadata()["ptt"]), {k: file.get_tensor(k) for k in file.keys()}  # noqa: SIM118


@pytest.fixture()
def path(small_model: ptt.TransferModel, tmp_path: Path) -> Path:
    small_model.save(tmp_path / "m.safetensors")
    return tmp_path / "m.safetensors"


def test_round_trip_relights_the_same(path: Path, small_model: ptt.TransferModel, small_scene: ptt.Scene) -> None:
    again = ptt.TransferModel.load(path)
    light = ptt.Environment.sun_sky()
    a, b = (ptt.TransferRelighter(m)(light, {}, small_scene.camera) for m in (small_model, again))
    assert torch.equal(a, b)
    assert again.receivers.editable == (False, True)
    assert again.truncation_error == small_model.truncation_error


def test_raw_round_trip(small_raw: ptt.RawTransfer, tmp_path: Path) -> None:
    small_raw.save(tmp_path / "r.safetensors")
    again = ptt.RawTransfer.load(tmp_path / "r.safetensors")
    assert torch.equal(again.visible, small_raw.visible) and again.resolution == small_raw.resolution
    assert again.receivers.names == small_raw.receivers.names


@pytest.mark.parametrize("keep", [0, 5, 200, -1])
def test_cut_short(path: Path, keep: int) -> None:
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(ValueError, match=r"m.safetensors"):
        ptt.TransferModel.load(path)


def edit(path: Path, header: dict[str, Any], tensors: dict[str, torch.Tensor]) -> None:
    save_file(tensors, str(path), metadata={"ptt": json.dumps(header)})


def test_missing_extra_misshapen_and_non_finite_tensors(path: Path) -> None:
    header, tensors = parts(path)
    v = len(tensors["positions"])
    cases = [
        ({k: t for k, t in tensors.items() if k != "brdf.core"}, "lacks the tensor brdf.core"),
        (tensors | {"more": torch.zeros(1)}, "unknown tensors: more"),
        (tensors | {"frames": torch.zeros(v, 3)}, rf"frames must be torch.float32 \({v}, 3, 3\)"),
        (tensors | {"values": tensors["values"].half()}, "values must be torch.float32"),
        (tensors | {"colours": tensors["colours"] / 0}, "colours holds values that are not finite"),
        (tensors | {"columns": tensors["columns"] + 30000}, r"columns must be in 0..1535"),
        (tensors | {"kept": tensors["kept"] + 1}, "kept must be at least 0 and sum to"),
    ]
    for changed, message in cases:
        edit(path, header, changed)
        with pytest.raises(ValueError, match=f"m.safetensors.*{message}"):
            ptt.TransferModel.load(path)


def test_unknown_schema_other_kind_and_foreign_files(path: Path) -> None:
    header, tensors = parts(path)
    edit(path, header | {"schema": 99}, tensors)
    with pytest.raises(ValueError, match="has schema 99, this version of ptt reads 2"):
        ptt.TransferModel.load(path)
    with pytest.raises(ValueError, match="must hold a raw transfer, got transfer model"):
        ptt.RawTransfer.load(path)
    save_file(tensors, str(path))
    with pytest.raises(ValueError, match="a file that ptt did not write"):
        ptt.TransferModel.load(path)
    with pytest.raises(ValueError, match="no file"):
        ptt.TransferModel.load(path.with_name("none.safetensors"))


def test_damaged_config(path: Path) -> None:
    header, tensors = parts(path)
    for key in ("resolution", "regions", "ranks", "space"):
        config = {k: v for k, v in header["config"].items() if k != key}
        edit(path, header | {"config": config}, tensors)
        with pytest.raises(ValueError, match=f"m.safetensors.*{key}"):
            ptt.TransferModel.load(path)


def test_no_config_and_an_impossible_one(path: Path) -> None:
    header, tensors = parts(path)
    edit(path, {k: v for k, v in header.items() if k != "config"}, tensors)
    with pytest.raises(ValueError, match=r"m.safetensors.*config"):
        ptt.TransferModel.load(path)
    header["config"]["regions"][1]["material"]["exponent"] = -1
    edit(path, header, tensors)
    with pytest.raises(ValueError, match=r"m.safetensors.*exponent must be finite"):
        ptt.TransferModel.load(path)


def test_a_pickle_is_refused_and_not_run(tmp_path: Path) -> None:
    class Evil:
        def __reduce__(self) -> tuple[Any, ...]:
            return (Path.touch, (tmp_path / "ran",))

    (tmp_path / "m.safetensors").write_bytes(pickle.dumps(Evil()))
    with pytest.raises(ValueError, match="not a whole safetensors file"):
        ptt.TransferModel.load(tmp_path / "m.safetensors")
    assert not (tmp_path / "ran").exists()


def test_a_folder_that_is_not_there(small_raw: ptt.RawTransfer, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="cannot write"):
        small_raw.save(tmp_path / "no" / "r.safetensors")
