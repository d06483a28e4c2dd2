"""What the scripts share: a config from defaults, a TOML file and flags, and errors that end in one line."""

from __future__ import annotations

import json
import sys
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import tyro

from ptt.light.environment import Environment
from ptt.light.layouts import Layout as Layout  # for the scripts
from ptt.materials.spaces import BRDFSpace
from ptt.materials.varying import SurfaceMaterial
from ptt.models.receivers import Receivers
from ptt.models.transfer_model import TransferModel
from ptt.ops import keeping
from ptt.scene.default import default_scene
from ptt.scene.scene import Scene
from ptt.scene.scene_files import load_scene

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Config = TypeVar("Config", bound="DataclassInstance")
Space = Literal["auto", "blinn-phong", "fitted", "ward", "ggx"]
SPACES: dict[str, Callable[[], BRDFSpace]] = {
    "blinn-phong": BRDFSpace.blinn_phong,
    "fitted": BRDFSpace.fitted,
    "ward": BRDFSpace.ward,
    "ggx": BRDFSpace.ggx,
}


def configure(cls: type[Config], doc: str) -> Config:
    """Defaults of the dataclass, overridden by the TOML file after --config, overridden by flags; printed.

    Raises:
        ValueError: the TOML file is missing, unreadable, or has keys that the dataclass has not.
    """
    arguments = sys.argv[1:]
    defaults = cls()
    if "--config" in arguments:
        at = arguments.index("--config")
        defaults = cls(**_read(arguments[at + 1 : at + 2], cls))
        del arguments[at : at + 2]
    doc += "\n--config FILE.toml overrides the defaults; flags override both."
    config = tyro.cli(
        cls,
        default=defaults,
        args=arguments,
        description=doc,
    )
    print(json.dumps(asdict(config), default=str, indent=2))
    return config


def chosen_scene(name: str) -> Scene:
    """The scene in a file, or the one made in code for "default"."""
    return default_scene() if name == "default" else load_scene(name)


def chosen_light(name: str, scene: Scene, layout: Layout) -> Environment:
    """The map in a file, by its layout; "scene" is the scene's own, "sky" and "constant" are made in code.

    Raises:
        ValueError: the scene has no environment, or the file cannot be read.
    """
    made: dict[str, Callable[[], Environment | None]] = {
        "scene": lambda: scene.environment,
        "sky": Environment.sun_sky,
        "constant": Environment.constant,
    }
    light = made[name]() if name in made else Environment.load(name, layout)
    if light is None:
        raise ValueError("--environment must be a map (.exr .hdr), sky or constant: the scene has none of its own")
    return light


def chosen_space(name: Space, materials: Mapping[str, SurfaceMaterial]) -> BRDFSpace:
    """The space of that name; "auto" is the one that holds the shapes of the materials, Blinn-Phong for none.

    Raises:
        ValueError: a material has a blend of shapes.
    """
    return BRDFSpace.holding(materials.values()) if name == "auto" else SPACES[name]()


def kept_model(scene: Scene, settings: Mapping[str, Any], make: Callable[[], TransferModel]) -> TransferModel:
    """The model that `make` makes of a scene with these settings, or made before; a line says where it is kept."""
    receivers = Receivers.of(scene)
    made_from = {"faces": scene.faces, "vertices": scene.vertices, **receivers.tensors(), **receivers.config()}
    path = keeping.place("model", {**made_from, **settings})
    if path.exists():
        try:
            model = TransferModel.load(path)
        except ValueError as error:
            print(f"{error}; it is made anew")
        else:
            print(f"found the model of this scene in {path}")
            return model
    model = make()
    model.save(path)
    print(f"the model is kept in {path}")
    return model


def make_folder(path: Path) -> None:
    """Make the folder for results, before anything takes long.

    Raises:
        ValueError: it cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"--out: cannot make the folder {path}: {error.strerror}") from error


def save_config(config: Any, path: Path) -> None:
    """Write a config dataclass as JSON beside the result it belongs to."""
    path.write_text(json.dumps(asdict(config), default=str, indent=2) + "\n")


def run(main: Callable[[], None]) -> None:
    """Call main; a ValueError or ImportError ends the program with its message alone and exit status 2."""
    try:
        main()
    except (ValueError, ImportError) as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None


def _read(name: list[str], cls: type) -> dict[str, Any]:
    if not name or not Path(name[0]).is_file():
        raise ValueError(f"--config needs an existing TOML file, got {name[0] if name else 'nothing'}")
    try:
        table = tomllib.loads(Path(name[0]).read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{name[0]} is not TOML: {error}") from error
    valid = {field.name: field.type for field in fields(cls)}
    if unknown := sorted(set(table) - set(valid)):
        raise ValueError(f"{name[0]}: unknown {', '.join(unknown)}; valid are {', '.join(valid)}")
    return {key: Path(value) if "Path" in str(valid[key]) else value for key, value in table.items()}
