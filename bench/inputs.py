"""What comes of files: generated ones, test models of others, large ones; rows of bench/results/inputs.csv.

    python -m bench.inputs                     # about three minutes on two cores
    python -m bench.inputs --quick             # a fifth of the generated files, nothing written
    python -m bench.inputs reading             # the times alone; the other rows stay
    python -m bench.inputs "one model"         # four materials relit and edited (bench.one_model)
    python -m bench.inputs --models FOLDER     # test models to read, beside those of PTT_DATA; or PTT_MODELS=a:b

Files are read in another process, which may crash or hang. Peers read in the same run: trimesh the models and the large
mesh, OpenEXR and OpenImageIO the large map. Test models of others are those of Debian's package assimp-testmodels
(/usr/share/assimp/models), and of trimesh's repository (models).
"""

from __future__ import annotations

import argparse
import os
import signal
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import OpenEXR
import trimesh
from numpy.typing import NDArray

import ptt
from bench import broken_gltf, generated_exr, generated_gltf, generated_hdr, generated_obj, generated_ply, one_model
from bench.generated_files import Case, Verdict, judge, survives
from bench.table import Table, median_seconds, setting
from ptt.io import by_oiio
from ptt.ops import mesh

T = TypeVar("T")
R = TypeVar("R")
SEED = 20
VALID = 70  # files of a format; beside them there is one for each damage
CHANGED = 100  # files of a format in which random bytes are changed
LONGEST = 10  # seconds that a generated file may take
LONGEST_MODEL = 60
ENDINGS = (".gltf", ".glb", ".obj", ".ply", ".stl")
Draw = Callable[[Path, int, np.random.Generator], Case]


class Format(NamedTuple):
    """A format: what draws valid files and damaged ones, and the damages."""

    valid: Draw
    broken: Draw
    damages: tuple[str, ...]


FORMATS = {
    "glTF": Format(generated_gltf.valid, broken_gltf.broken, broken_gltf.DAMAGES),
    "OBJ": Format(generated_obj.valid, generated_obj.broken, generated_obj.DAMAGES),
    "PLY": Format(generated_ply.valid, generated_ply.broken, generated_ply.DAMAGES),
    "HDR": Format(generated_hdr.valid, generated_hdr.broken, generated_hdr.DAMAGES),
    "EXR": Format(generated_exr.valid, generated_exr.broken, generated_exr.DAMAGES),
}
SOLIDS = "either: ptt joins the solids of an STL file in one region"
REASONS = {
    "without triangles": "must hold triangles",
    "of glTF 1.0": "got version",
    "in need of an extension": "convert the file",
}
RIGHT = {
    "simple_skin.gltf": "ptt, which poses its skin",
    "wallhole.obj": "ptt, whose triangles have the area 721.42 of its polygons; trimesh's have 761.42",
    "triangle_with_two_solids.stl": SOLIDS,
    "multibody.stl": SOLIDS,
    "two_objects_mixed_case_names.stl": SOLIDS,
}
"""Who is right about models that ptt and trimesh read differently, and why."""


def main() -> None:
    parser = argparse.ArgumentParser(description="What comes of files.")
    parser.add_argument("sections", nargs="*", default=list(SECTIONS), metavar="section", help=", ".join(SECTIONS))
    parser.add_argument("--quick", action="store_true", help="fewer files, nothing written")
    parser.add_argument("--models", type=Path, nargs="+", default=[], help="folders of test models")
    options = parser.parse_args()
    for name in options.sections:
        table = Table("inputs")
        SECTIONS[name](table, options)
        if not options.quick:
            table.replace(name, SECTIONS)


def cases(name: str, folder: Path, share: int = 1) -> Iterator[Case]:
    """Files of a format, the same each time: valid ones, and one of each damage; every share-th of them."""
    form = FORMATS[name]
    for draw, count in ((form.valid, VALID), (form.broken, len(form.damages))):
        for number in range(0, count, share):
            yield draw(folder, number, np.random.default_rng([SEED, *name.encode(), number]))


def generated(table: Table, options: argparse.Namespace) -> None:
    """Files with their right answers."""
    share = 5 if options.quick else 1
    wrong = 0
    count = 0
    for name in FORMATS:
        with tempfile.TemporaryDirectory() as folder:
            drawn = list(cases(name, Path(folder), share))
            verdicts = list(apart(judge, drawn, LONGEST))
        forms = {form for case in drawn for form in case.forms}
        valid = Counter(v.outcome for case, v in zip(drawn, verdicts, strict=True) if not case.damage)
        damaged = Counter(v.outcome for case, v in zip(drawn, verdicts, strict=True) if case.damage)
        bad = [(case, v) for case, v in zip(drawn, verdicts, strict=True) if v.outcome == "wrong"]
        for case, verdict in bad:
            print(f"  {case.path.name} {case.damage or case.forms}: {verdict.why}")
        how = (
            f"{valid.total()} valid in {len(forms)} rare forms: {valid['right']} right; {damaged.total()} damaged: "
            f"{damaged['refused']} refused by name, {damaged['right']} read and right"
        )
        table.row(f"generated files, {name}", len(bad), "wrong", how, "<= 0")
        wrong += len(bad)
        count += len(drawn)
    how = f"of {count} files: neither right nor refused by name, or crashed, or more than {LONGEST} s"
    table.row("generated files, all", wrong, "wrong", how, "<= 0")


def changed(table: Table, options: argparse.Namespace) -> None:
    """Valid files in which a few random bytes are others: they are read, or refused by name."""
    share = 5 if options.quick else 1
    bad = []
    outcomes = Counter[str]()
    for name, form in FORMATS.items():
        with tempfile.TemporaryDirectory() as folder:
            paths = []
            for number in range(0, CHANGED, share):
                random = np.random.default_rng([SEED + 1, *name.encode(), number])
                paths.append(form.valid(Path(folder), number, random).path)
                _change(paths[-1], random)
            verdicts = list(apart(survives, paths, LONGEST))
        outcomes.update(v.outcome for v in verdicts)
        bad += [f"{path.name}: {v.why}" for path, v in zip(paths, verdicts, strict=True) if v.outcome == "wrong"]
    for line in bad:
        print(f"  {line}")
    how = (
        f"{outcomes['right']} read, {outcomes['refused']} refused by name; 1 to 4 bytes are others, most of them digits"
    )
    table.row("random bytes, all", len(bad), "wrong", f"of {outcomes.total()} files: {how}", "<= 0")


def _change(path: Path, random: np.random.Generator) -> None:
    """Change one to four bytes of a file."""
    data = bytearray(path.read_bytes())
    for _ in range(int(random.integers(1, 5))):
        most = min(300, len(data)) if random.random() < 0.5 else len(data)
        value = int(random.integers(256)) if random.random() < 0.3 else int(random.choice(list(b"0123456789-. ")))
        data[int(random.integers(most))] = value
    path.write_bytes(data)


def apart(function: Callable[[T], R], values: list[T], seconds: int) -> Iterator[R | Verdict]:
    """The results of a function, in another process; a verdict where that ends or takes longer."""
    pool = _pool()
    for value in values:
        try:
            yield pool.submit(_within, function, value, seconds).result()
        except BrokenProcessPool:
            yield Verdict("wrong", f"the process crashed, or took more than {seconds} s")
            pool = _pool()
    pool.shutdown()


def _pool() -> ProcessPoolExecutor:
    return ProcessPoolExecutor(1, get_context("spawn"), _quiet)


def _quiet() -> None:
    """Drop what C libraries and other readers print about damage."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)


def _within(function: Callable[[T], R], value: T, seconds: int) -> R:
    """The result of a function; the process ends where it takes longer."""
    signal.alarm(seconds)
    result = function(value)
    signal.alarm(0)
    return result


# --- test models of others


class Reading(NamedTuple):
    """What a reader makes of a model.

    error: why it does not; the rest is of no meaning then
    refused: says whether that names the file
    faces: triangles with an area; places: distinct positions; regions: parts with a material of their own
    bounds (2, 3): of the vertices of triangles
    """

    error: str = ""
    refused: bool = False
    faces: int = 0
    places: int = 0
    regions: int = 0
    bounds: NDArray[np.float64] = np.zeros((2, 3))


def models(table: Table, options: argparse.Namespace) -> None:
    """Those of the folders that are given, of PTT_MODELS, and the meshes of PTT_DATA."""
    named = [Path(name) for name in os.environ.get("PTT_MODELS", "").split(os.pathsep) if name]
    data = [Path(os.environ["PTT_DATA"]) / name for name in ("meshes", "gltf")] if "PTT_DATA" in os.environ else []
    folders = (*options.models, *named, *data)
    counts = np.array([models_of(table, folder) for folder in folders]).reshape(-1, 2).sum(0)
    what = "test models, all, crashed or refused without a name"
    table.row(what, counts[1], "", f"of {counts[0]} files in {len(folders)} folders", "<= 0")


def models_of(table: Table, folder: Path) -> tuple[int, int]:
    """How many models a folder has, and how many crash; rows of those, and of what trimesh reads differently."""
    paths = sorted(path for path in folder.rglob("*") if path.suffix.lower() in ENDINGS and path.is_file())
    pairs = list(apart(both_read, paths, LONGEST_MODEL))
    name = f"test models, {folder.parent.name if folder.name == 'models' else folder.name}"
    crashed = [
        f"{path.name} ({pair.why})" for path, pair in zip(paths, pairs, strict=True) if isinstance(pair, Verdict)
    ]
    read = {path: pair for path, pair in zip(paths, pairs, strict=True) if not isinstance(pair, Verdict)}
    crashed += [f"{path.name} ({own.error})" for path, (own, _) in read.items() if own.error and not own.refused]
    loaded = [path for path, (own, _) in read.items() if not own.error]
    refused = [path for path, (own, _) in read.items() if own.refused]
    table.row(f"{name}, read", len(loaded), "", f"of {len(paths)} files")
    table.row(f"{name}, refused by name", len(refused), "", _reasons({path: read[path][0].error for path in refused}))
    table.row(f"{name}, crashed or refused without a name", len(crashed), "", ", ".join(crashed), "<= 0")
    differ = [f"{path.name}: {why}" for path in loaded if (why := _difference(path, *read[path]))]
    both = sum(not read[path][1].error for path in loaded)
    how = (
        f"of {both} that both read, by trimesh {trimesh.__version__}: triangles with an area, distinct positions (to "
        f"0.1 %), parts, bounds. {'; '.join(differ)}"
    )
    table.row(f"{name}, read differently by trimesh", len(differ), "", how)
    return len(paths), len(crashed)


def _reasons(errors: dict[Path, str]) -> str:
    """Why files were refused, and which for damage."""
    if not errors:
        return ""
    why = {
        path: next((name for name, words in REASONS.items() if words in error), "damaged")
        for path, error in errors.items()
    }
    damaged = ", ".join(path.name for path, name in why.items() if name == "damaged")
    return "; ".join(f"{count} {name}" for name, count in Counter(why.values()).most_common()) + f" ({damaged})"


def both_read(path: Path) -> tuple[Reading, Reading]:
    """What ptt and trimesh make of a model."""
    return _reading(path, _by_ptt), _reading(path, _by_trimesh)


def _reading(path: Path, read: Callable[[Path], tuple[NDArray[np.float64], int]]) -> Reading:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            triangles, regions = read(path)
        sound = triangles[_have_area(triangles)].reshape(-1, 3)
        if not len(sound):
            raise ValueError(f"{path}: no triangles")
    except Exception as error:  # the readers of others raise whatever they stumble over
        named = isinstance(error, ValueError) and path.name in str(error)
        return Reading(f"{type(error).__name__}: {error}"[:200], named)
    bounds = np.stack((sound.min(0), sound.max(0)))
    cells = np.floor((sound - bounds[0]) / np.ptp(bounds, axis=0).max() * 2e4 + 0.317)
    return Reading("", False, len(sound) // 3, len(np.unique(cells, axis=0)), regions, bounds)


def _have_area(triangles: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Tell which triangles (t, 3, 3) are more than a line."""
    edges = np.linalg.norm(triangles - np.roll(triangles, 1, 1), axis=2)
    areas = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1)
    large: NDArray[np.bool_] = areas > 1e-9 * edges.max(1, initial=0) ** 2
    return large


def _by_ptt(path: Path) -> tuple[NDArray[np.float64], int]:
    scene = ptt.load_scene(path)
    return (scene.vertices.double() + scene.offset)[scene.faces].numpy(), len(scene.regions)


def _by_trimesh(path: Path) -> tuple[NDArray[np.float64], int]:
    scene = trimesh.load_scene(path, process=False)
    triangles: NDArray[np.float64] = scene.to_mesh().triangles.astype(np.float64)
    return triangles, len(scene.geometry)


def _difference(path: Path, own: Reading, peer: Reading) -> str:
    """How trimesh's reading differs, and who is right; "" for not at all, or where it has none."""
    if peer.error:
        return ""
    size = float(np.ptp(own.bounds, axis=0).max())
    parts = {
        f"{own.faces} triangles, {peer.faces} by trimesh": own.faces != peer.faces,
        f"{own.places} positions, {peer.places} by trimesh": abs(own.places - peer.places) > 1e-3 * own.places,
        f"{own.regions} parts, {peer.regions} by trimesh": own.regions != peer.regions,
        "other bounds": not np.allclose(own.bounds, peer.bounds, rtol=0, atol=1e-5 * size),
    }
    found = [words for words, differs in parts.items() if differs]
    return f"{', '.join(found)} (right: {RIGHT.get(path.name, 'not looked into')})" if found else ""


# --- large files


def large(table: Table, options: argparse.Namespace) -> None:
    """A mesh of 1.3 million triangles, and a map of 8192 x 4096."""
    with tempfile.TemporaryDirectory() as name:
        large_mesh(table, Path(name), 5 if options.quick else 8)
        large_map(table, Path(name), 512 if options.quick else 4096)


def large_mesh(table: Table, folder: Path, subdivisions: int) -> None:
    """Seconds to read a ball of 1.3 million triangles, beside trimesh."""
    vertices, faces = (x.numpy() for x in mesh.sphere_mesh(subdivisions))
    for ending in ("ply", "glb"):
        path = folder / f"ball.{ending}"
        trimesh.Trimesh(vertices, faces, process=False).export(path)
        own = median_seconds(partial(ptt.load_scene, path), 3)
        alone = median_seconds(partial(_by_trimesh_alone, path, False), 3)
        shaded = median_seconds(partial(_by_trimesh_alone, path, True), 3)
        what = f"reading, {len(faces):,} triangles, {ending.upper()}"
        table.row(f"{what}, ptt", own, "s", "checked, with normals and tangents", peer=f"{alone:.3g} s trimesh alone")
        table.row(f"{what}, ptt over trimesh", own / alone, "", f"medians of 3; trimesh reads only; {setting()}")
        how = "trimesh with the normals of its vertices"
        table.row(f"{what}, ptt over trimesh with normals", own / shaded, "", how, peer=f"{shaded:.3g} s")


def large_map(table: Table, folder: Path, height: int) -> None:
    """Seconds to read a map of 8192 x 4096, beside OpenEXR and OpenImageIO."""
    y, x = np.mgrid[0:height, 0 : 2 * height].astype(np.float32) / height
    grain = np.tile(np.random.default_rng(0).random((64, 64), dtype=np.float32), (height // 64, height // 32))
    pixels = np.stack((1 + y + grain, 1 + x + grain, 2 - y + grain), -1)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"RGB": pixels.astype(np.float16)}).write(str(folder / "sky.exr"))
    by_oiio.write(folder / "sky.hdr", pixels)
    peers = {"exr": ("OpenEXR", _by_openexr), "hdr": ("OpenImageIO", by_oiio.read)}
    for ending, (peer, read) in peers.items():
        path = folder / f"sky.{ending}"
        own = median_seconds(partial(ptt.Environment.load, path), 3)
        alone = median_seconds(partial(read, path), 3)
        what = f"reading, a map of {2 * height} x {height}, {ending.upper()}"
        table.row(f"{what}, ptt", own, "s", "as a light, checked", peer=f"{alone:.3g} s {peer} alone")
        table.row(f"{what}, ptt over {peer}", own / alone, "", f"medians of 3; {peer} to float32; {setting()}")


def _by_trimesh_alone(path: Path, shaded: bool) -> Any:
    loaded = trimesh.load_mesh(path, process=False)
    return loaded.vertex_normals if shaded else loaded


def _by_openexr(path: Path) -> NDArray[np.float32]:
    with OpenEXR.File(str(path)) as file:
        pixels: NDArray[np.float32] = file.channels()["RGB"].pixels.astype(np.float32)
    return pixels


SECTIONS: dict[str, Callable[[Table, argparse.Namespace], None]] = {
    "generated files": generated,
    "random bytes": changed,
    "test models": models,
    "reading": large,
    "one model": one_model.rows,
}
"""What rows begin with, and what measures them."""

if __name__ == "__main__":
    main()
