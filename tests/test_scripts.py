"""The scripts as a user runs them: the whole flow on a small scene, and bad input that ends in one line."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from ptt.io import read_image

SCRIPTS = Path(__file__).resolve().parent.parent / "scripts"
SCENE = """
[camera]
eye = [0, 1.5, 3]
target = [0, 0.3, 0]
[[region]]
name = "floor"
plane = { size = 3.0, cells = 8 }
[[region]]
name = "ball"
sphere = { subdivisions = 2, radius = 0.4 }
translate = [0, 0.5, 0]
"""


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
    out = script("precompute", "--config", folder / "precompute.toml", "--resolution", 16, "--out", folder)
    assert "floor 81, ball 162" in out
    assert json.loads((folder / "precompute.json").read_text())["resolution"] == 16  # flags override the file
    out = script("compress", "--raw", folder / "raw.safetensors", "--ranks", 3, 8, 8)
    assert "relative L2 error" in out and (folder / "compress.json").exists()
    return folder


def test_relight_writes_pictures_and_errors(run: Path) -> None:
    model, scene = run / "model.safetensors", run / "scene.toml"
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
    assert all(report["states"][name]["relative_rmse"] < 0.5 for name in names)


def test_evaluate_reports_each_region(run: Path) -> None:
    model, scene = run / "model.safetensors", run / "scene.toml"
    script("evaluate", "--model", model, "--scene", scene, "--environment", "constant", "--samples", 256)
    errors = json.loads((run / "evaluate.json").read_text())["errors"]
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
        ("compress", ("--raw", "none.safetensors"), "no file none.safetensors"),
        ("evaluate", ("--model", "none.safetensors"), "no file none.safetensors"),
        ("relight", ("--environment", "none.hdr"), "none.hdr"),
        ("relight", ("--region", "nose"), "no region 'nose'; the scene has floor, knot, ball, slab"),
        ("relight", ("--exponent", "900"), "exponent must be in 1..64"),
    ],
)
def test_bad_input_ends_in_one_line(name: str, arguments: tuple[str, ...], message: str) -> None:
    out = script(name, *arguments, status=2)
    assert "error: " in out and message in out.splitlines()[-1]


def test_unknown_key_in_a_config(tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text("resolutoin = 3")
    out = script("precompute", "--config", tmp_path / "c.toml", status=2)
    assert "unknown resolutoin; valid are scene, resolution, out" in out
