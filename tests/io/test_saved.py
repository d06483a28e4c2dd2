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
from ptt.io.saved import SCHEMA


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


@pytest.fixture()
def clustered(clustered_model: ptt.TransferModel, tmp_path: Path) -> Path:
    clustered_model.save(tmp_path / "c.safetensors")
    return tmp_path / "c.safetensors"


def test_clusters_round_trip_to_the_bit(clustered: Path, clustered_model: ptt.TransferModel) -> None:
    again = ptt.TransferModel.load(clustered)
    before, after = (dict(m.named_buffers()) for m in (clustered_model, again))
    assert before.keys() == after.keys() and "kept" not in before
    assert all(after[name].dtype == t.dtype and torch.equal(after[name], t) for name, t in before.items())
    assert [(r.slots, r.pairs) for r in again.regions] == [(r.slots, r.pairs) for r in clustered_model.regions]
    light = ptt.Environment.constant(1.0)
    eye = torch.tensor([1.0, 2.0, 3.0])
    a, b = (ptt.TransferRelighter(m)(light, {}, eye) for m in (clustered_model, again))
    assert torch.equal(a, b)
    assert (again.truncation_error, again.bounces) == (clustered_model.truncation_error, 2)
    again.save(clustered.with_name("again.safetensors"))
    assert clustered.with_name("again.safetensors").read_bytes() == clustered.read_bytes()


def test_damaged_clusters(clustered: Path) -> None:
    header, tensors = parts(clustered)
    one = "regions.1."
    cases = [
        ({k: t for k, t in tensors.items() if k != one + "weights"}, "lacks the tensor regions.1.weights"),
        ({k: t for k, t in tensors.items() if k != "basis.table"}, "lacks the tensor basis.table"),
        (tensors | {"regions.2.place": torch.zeros(1)}, "unknown tensors: regions.2.place"),
        (tensors | {one + "direct": tensors[one + "direct"].half()}, "direct must be torch.float32"),
        (tensors | {one + "weights": tensors[one + "weights"][:, 1:].clone()}, "weights must be torch.float32"),
        (tensors | {one + "two": tensors[one + "two"] / 0}, "two holds values that are not finite"),
        (tensors | {one + "cluster": tensors[one + "cluster"] + 9}, "cluster must be in 0"),
        (tensors | {one + "cluster": tensors[one + "cluster"] - 1}, "cluster must be in 0"),
        (tensors | {one + "columns": tensors[one + "columns"] + 1500}, r"columns must be in 0\.\.1535"),
        (tensors | {one + "place": tensors[one + "place"] + 64 * 99}, "place must be in 0"),
    ]
    for changed, message in cases:
        edit(clustered, header, changed)
        with pytest.raises(ValueError, match=f"c.safetensors.*{message}"):
            ptt.TransferModel.load(clustered)


def test_damaged_config_of_clusters(clustered: Path) -> None:
    header, tensors = parts(clustered)
    good = header["config"]["clustered"]
    first = good[1]
    lighting = first["lighting"]
    cases = [
        ({"storage": "float8"}, "float8"),
        ({"slots": [99, *first["slots"][1:]]}, r"slots must be in 0\.\."),
        ({"slots": [-1, *first["slots"][1:]]}, r"slots must be in 0\.\."),
        ({"pairs": [[0, 99], *first["pairs"][1:]]}, r"pairs must be in 0\.\."),
        ({"eigenvectors": 9}, "weights must be"),
        ({"lighting": [lighting[0], 96, lighting[2]]}, "lighting must be"),
    ]
    for change, message in cases:
        header["config"]["clustered"] = [good[0], first | change]
        edit(clustered, header, tensors)
        with pytest.raises(ValueError, match=f"c.safetensors.*{message}"):
            ptt.TransferModel.load(clustered)
    for damaged in (good[:1], [*good, first], [good[0], {k: v for k, v in first.items() if k != "pairs"}]):
        header["config"]["clustered"] = damaged
        edit(clustered, header, tensors)
        with pytest.raises(ValueError, match=r"c\.safetensors"):
            ptt.TransferModel.load(clustered)


def test_raw_round_trip(small_raw: ptt.RawTransfer, tmp_path: Path) -> None:
    small_raw.save(tmp_path / "r.safetensors")
    again = ptt.RawTransfer.load(tmp_path / "r.safetensors")
    assert torch.equal(again.visible, small_raw.visible) and again.resolution == small_raw.resolution
    assert again.receivers.names == small_raw.receivers.names


def test_raw_of_bounces(small_bounced: ptt.RawTransfer, tmp_path: Path) -> None:
    path = tmp_path / "r.safetensors"
    small_bounced.save(path)
    again = ptt.RawTransfer.load(path)
    assert torch.equal(again.hits, small_bounced.hits) and again.bounces == 2
    header, tensors = parts(path)
    for change in (1000, -2):
        edit(path, header, tensors | {"hits": tensors["hits"].clone().fill_(change)})
        with pytest.raises(ValueError, match=r"r.safetensors.*hits: must be in -1"):
            ptt.RawTransfer.load(path)


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
    with pytest.raises(ValueError, match=f"has schema 99, this version of ptt reads {SCHEMA}"):
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
