"""The scripts as a user runs them: the whole flow on a small scene, and bad input that ends in one line."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import ptt
from ptt.cli import chosen_space
from ptt.io.images import read_image
from ptt.ops import keeping

SCRIPTS = Path(__file__).resolve().parent.parent / "scripts"
SCENE = """
[camera]
eye = [0, 1.5, 3]
target = [0, 0.3, 0]
[[region]]
name = "floor"
plane = { size = 3.0, cells = 8 }
material = { model = "lambert", diffuse = 0.5 }
editable = false
[[region]]
name = "ball"
sphere = { subdivisions = 2, radius = 0.4 }
translate = [0, 0.5, 0]
material = { model = "blinn-phong", diffuse = 0.4, specular = 0.3, exponent = 12 }
"""
COARSE = ("--ranks", 2, 4, 4, "--lobes", 2, "--functions", 2, "--eigenvectors", 8, "--lighting", 8, "--points", 100)


def script(name: str, *arguments: object, status: int = 0) -> str:
    command = [sys.executable, str(SCRIPTS / f"{name}.py"), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == status, done.stderr
    assert "Traceback" not in done.stderr
    return done.stdout + done.stderr


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with scene.toml and the results of precompute.py and compress.py."""
    folder = tmp_path_factory.mktemp("run")
    (folder / "scene.toml").write_text(SCENE)
    (folder / "precompute.toml").write_text(f'scene = "{folder / "scene.toml"}"\nresolution = 32\n')
    flags = ("--resolution", 16, "--rays", 64, "--out", folder)
    out = script("precompute", "--config", folder / "precompute.toml", *flags)
    assert "floor 81, ball 162" in out
    config = json.loads((folder / "precompute.json").read_text())
    assert (config["resolution"], config["bounces"]) == (16, 2)  # flags override the file
    out = script("compress", "--raw", folder / "raw.safetensors", *COARSE)
    assert "relative L2 error" in out and "BRDF tensor (2, 4, 4) with 2 lobes, 2 functions" in out
    assert "ball: 162 points, 2 clusters of 8 eigenvectors, " in out and "MB, lit by 1 slots and 3 pairs" in out
    assert json.loads((folder / "compress.json").read_text())["space"] == "auto"
    return folder


def test_compress_to_a_size_for_another_space(run: Path) -> None:
    (run / "metal").mkdir()
    raw = run / "metal" / "raw.safetensors"
    raw.write_bytes((run / "raw.safetensors").read_bytes())
    script("compress", "--raw", raw, "--space", "ward", *COARSE, "--bytes", 3e5, "--max-memory", 1)
    model = ptt.TransferModel.load(raw.with_name("model.safetensors"))
    assert {shape.model for shape in model.brdf.space.samples} == {"ward"}
    stored = ("columns", "direct", "lighting", "one", "two")
    assert 1.5e5 < sum(getattr(region, name).nbytes for region in model.clustered for name in stored) <= 3e5


def test_relight_writes_pictures_and_errors(run: Path) -> None:
    model = run / "model.safetensors"
    scene = run / "scene.toml"
    size = ("--width", 64, "--height", 48, "--samples", 64)
    out = script(
        "relight", "--model", model, "--scene", scene, "--environment", "sky", *size, "--out", run / "pictures"
    )
    assert "relative RMSE" in out
    names = ("before", "material", "light", "view")
    pictures = {name: read_image(run / "pictures" / f"{name}.exr") for name in names}
    for name in names:
        assert pictures[name].shape == (48, 64, 3) and (run / "pictures" / f"{name}.png").exists()
        assert name == "before" or (pictures[name] - pictures["before"]).abs().max() > 0.05
    assert read_image(run / "pictures" / "relight.png").shape == (3 * 48, 4 * 64, 3)
    report = json.loads((run / "pictures" / "relight.json").read_text())
    assert report["config"]["exponent"] == 16.0
    assert all(report["states"][name]["relative_rmse"] < 0.3 for name in names)


def test_relight_traces_a_scene_once(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Other flags of the picture find the model again; another ball does not."""
    own = run / "cache" / "ptt"
    own.mkdir(parents=True)
    for library in keeping.folder().glob("kernels-*"):
        shutil.copy(library, own)
    monkeypatch.setenv("XDG_CACHE_HOME", str(own.parent))
    scene = run / "scene.toml"
    flags = ("--scene", scene, "--environment", "sky", "--rays", 32, "--coefficients", 16, "--samples", 0)
    size = ("--width", 32, "--height", 24)
    first = script("relight", *flags, *size, "--out", run / "first")
    assert "the model is kept in" in first and "rays:" in first
    again = script("relight", *flags, *size, "--exponent", 40, "--out", run / "again")
    assert "found the model" in again and "rays:" not in again
    same, other = (read_image(run / folder / "before.exr") for folder in ("first", "again"))
    assert (same - other).abs().max() < 1e-3 * same.max()
    (run / "moved.toml").write_text(SCENE.replace("radius = 0.4", "radius = 0.3"))
    moved = script("relight", *flags, *size, "--scene", run / "moved.toml", "--out", run / "first")
    assert "the model is kept in" in moved


def test_evaluate_reports_each_region(run: Path) -> None:
    model = run / "model.safetensors"
    scene = run / "scene.toml"
    script("evaluate", "--model", model, "--scene", scene, "--environment", "constant", "--samples", 256)
    result = json.loads((run / "evaluate.json").read_text())
    assert result["config"]["bounces"] == 2  # as the model was made for
    errors = result["errors"]
    assert set(errors) == {"all", "floor", "ball"}
    assert all(0 < e["relative_rmse"] < 0.2 for e in errors.values())


@pytest.mark.parametrize("name", ["precompute", "compress", "relight", "evaluate"])
def test_help_teaches(name: str) -> None:
    out = script(name, "--help")
    assert f"python scripts/{name}.py" in out and "--config" in out


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        ("precompute", ("--scene", "none.ply"), "path must be an existing file, got none.ply"),
        ("precompute", ("--resolution", "48"), "resolution must be a power of two from 2 to 128, got 48"),
        ("precompute", ("--config", "none.toml"), "--config needs an existing TOML file, got none.toml"),
        ("precompute", ("--bounces", "3"), "bounces must be 0, 1 or 2"),
        ("compress", ("--raw", "none.safetensors"), "no file none.safetensors"),
        ("compress", ("--bytes", "1e6", "--error", "0.1"), "bytes and error exclude each other"),
        ("evaluate", ("--model", "none.safetensors"), "no file none.safetensors"),
        ("relight", ("--environment", "none.hdr"), "none.hdr"),
        ("relight", ("--region", "nose"), "no region 'nose'; the scene has floor, knot, ball, slab"),
        ("relight", ("--exponent", "2e6"), "exponent must be finite and in [0, 1e+06]"),
    ],
)
def test_bad_input_ends_in_one_line(name: str, arguments: tuple[str, ...], message: str) -> None:
    out = script(name, *arguments, status=2)
    assert "error: " in out and message in out.splitlines()[-1]


def test_a_folder_that_cannot_be_made_is_refused_before_the_work(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for name in ("precompute", "relight"):
        out = script(name, "--out", tmp_path / "file" / "runs", status=2)
        assert "cannot make the folder" in out.splitlines()[-1]


def test_unknown_key_in_a_config(tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text("resolutoin = 3")
    out = script("precompute", "--config", tmp_path / "c.toml", status=2)
    assert "unknown resolutoin; valid are scene, resolution, bounces, rays, out" in out


def test_the_space_of_a_scene() -> None:
    """That of its own shapes; of several models none can be chosen."""
    glossy = ptt.blinn_phong()
    metal = ptt.cook_torrance()
    brushed = ptt.ward(ax=0.1, ay=0.3)
    for material, model in (
        (ptt.lambert(), "blinn-phong"),
        (glossy, "blinn-phong"),
        (metal, "cook-torrance"),
        (brushed, "ward"),
        (ptt.ward(), "ward"),
        (ptt.ggx(), "ggx"),
    ):
        space = chosen_space("auto", {"floor": ptt.lambert(), "ball": material})
        assert {shape.model for shape in space.samples} == {model}
        assert material.shape is None or len(space.coordinates(material.shape)) == len(space.samples)
    both = chosen_space("auto", {"floor": glossy, "wall": ptt.lambert(), "ball": metal})
    assert {shape.model for shape in both.samples} == {"blinn-phong", "cook-torrance"}
    assert chosen_space("ggx", {"floor": glossy, "ball": metal}).samples[0].model == "ggx"


@pytest.mark.parametrize("name", ["bunny", "suzanne", "dragon", "engine"])
def test_the_scenes_have_a_space(name: str, data_dir: Path) -> None:
    """Every material of the scenes in scripts/configs lies in the space that "auto" finds."""
    materials = ptt.load_scene(SCRIPTS / "configs" / f"{name}.toml").materials
    space = chosen_space("auto", materials)
    for material in materials.values():
        if material.shape is not None:
            space.coordinates(material.shape)
