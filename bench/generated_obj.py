"""Generated OBJ files and their materials: text in every dress, polygons of any shape, and damage."""

from __future__ import annotations

import codecs
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from bench.generated_files import Array, Case, Forms, Region, Shapes, linear, polygons


class Text(NamedTuple):
    """Lines of an .obj file and of its .mtl file."""

    obj: list[str]
    mtl: list[str]


def valid(folder: Path, number: int, random: np.random.Generator) -> Case:
    """A valid .obj file, with its materials beside it."""
    forms = Forms(random)
    text = Text(["# made by bench"], [])
    coloured = forms.chance("colours of vertices")
    names = ["", "red wood", "b\u00e4r", "third"][: random.integers(1, 5)]
    library = f"materials {number}.mtl"
    text.obj.append(f"mtllib {library}")
    count = np.zeros(3, np.int64)
    regions = []
    for name in names:
        if name:
            text.obj.append(f"usemtl {name}{'  # as it is' * forms.chance('comments after values')}")
        look = _material(forms, text.mtl, name, folder, number)
        text.obj.append(forms.one("", "g f 1 2 3", "o v", "s off", "s 1", "g"))
        own = [
            _face(forms, text.obj, corners, count, coloured, look)
            for corners in polygons(forms, int(random.integers(1, 5)))
        ]
        regions.append(Region(own, look.diffuse))
    if forms.chance("lines and points", 0.2):
        text.obj.append("p 1\nl 1 2")
    path = folder / f"valid {number}.obj"
    path.write_bytes(_dressed(forms, text.obj))
    (folder / library).write_text("\n".join(text.mtl), encoding="utf-8")
    return Case(path, Shapes(regions), tuple(forms.drawn))


class Look(NamedTuple):
    """A material's diffuse colour, and its texture's scale, offset and linear colours (2, 2, 3) of quadrants."""

    diffuse: tuple[float, ...] | None = None
    scale: Array = np.ones(2)
    offset: Array = np.zeros(2)
    quadrants: Array | None = None


def _material(forms: Forms, mtl: list[str], name: str, folder: Path, number: int) -> Look:
    random = forms.random
    if not name:
        return Look()
    colour = random.uniform(0, 1, 3).round(4)
    single = forms.chance("one number for a colour")
    values = colour[:1] if single else colour
    keyword = forms.one("Kd", "kd", "\tKd", "  KD")
    mtl += [
        f"newmtl {name}",
        f"{keyword} {' '.join(map(str, values))}{' # diffuse' * forms.chance('comments after values')}",
    ]
    mtl += ["Ks 0 0 0", "Ns 10", "illum 2"]
    diffuse = tuple(np.broadcast_to(values, 3).tolist())
    if not forms.chance("texture"):
        return Look(diffuse)
    quadrants = random.integers(0, 256, (2, 2, 3))
    image = f"half tone {name} {number}.png"
    Image.fromarray(quadrants.repeat(4, 0).repeat(4, 1).astype(np.uint8)).save(folder / image)
    scale, offset = np.ones(2), np.zeros(2)
    options = ""
    if forms.chance("options of a texture", 0.5):
        scale, offset = random.integers(1, 4, 2).astype(float), random.integers(0, 3, 2) / 2
        options = f"-s {scale[0]:g} {scale[1]:g} 1 -o {offset[0]:g} {offset[1]:g} -blendu on -mm 0 1 "
    mtl.append(f"map_Kd {options}{'C:' + chr(92) if forms.chance('path of elsewhere') else ''}{image}")
    return Look(diffuse, scale, offset, linear(quadrants / 255))


def _face(forms: Forms, lines: list[str], corners: Array, count: Any, coloured: bool, look: Look) -> Array:
    """Write a face and what it needs; its corners (n, 8). count (3,): positions, coordinates and normals so far."""
    random = forms.random
    n = len(corners)
    colours = random.uniform(0, 1, (n, 3)).round(4)
    fourth = not coloured and forms.chance("a fourth coordinate", 0.2)
    for corner, colour in zip(corners, colours, strict=True):
        words = [_written(forms, x) for x in corner]
        words += [f"{x:g}" for x in colour] if coloured else ["1.0"] * fourth
        lines.append(f"v {' '.join(words)}{' # here' * forms.chance('comments after values', 0.1)}")
    at = random.integers(-2, 3, (n, 2)) + random.choice([0.25, 0.75], (n, 2))
    stored = (at - look.offset) / look.scale
    textured = look.quadrants is not None or forms.chance("coordinates without a texture")
    lines += [f"vt {u!r} {v!r}{' 0' * forms.chance('a third coordinate', 0.2)}" for u, v in stored.tolist()] * textured
    normals = forms.chance("normals")
    lines += ["vn 0 0 2"] * (n * normals)
    order = np.arange(n)
    backwards = forms.chance("negative indices")
    numbers = [order - n, order - n, order - n] if backwards else [order + 1 + start for start in count]
    shown = (True, textured, normals)
    words = ["/".join(str(numbers[k][c]) if shown[k] else "" for k in range(3)).rstrip("/") for c in order]
    between = " \\\n " if forms.chance("lines that go on", 0.2) else " "
    lines.append(f"f {between.join(words)}{' # a face' * forms.chance('comments after values', 0.1)}")
    count += n * np.array(shown)
    shade = linear(colours) if coloured else np.ones((n, 3))
    if look.quadrants is not None:
        inside = at - np.floor(at)
        shade = look.quadrants[(inside[:, 1] < 0.5).astype(int), (inside[:, 0] >= 0.5).astype(int)]
    return np.concatenate(
        (corners, at if textured and look.quadrants is not None else np.full((n, 2), np.nan), shade), 1
    )


def _written(forms: Forms, x: float) -> str:
    form = forms.one(".6f", "+.5f", ".7e", "E", "g")
    return f"{x:{'.8E' if form == 'E' else '.9g' if form == 'g' else form}}"


def _dressed(forms: Forms, lines: list[str]) -> bytes:
    """Text with tabs, indents, line ends and an encoding as drawn."""
    text = "\n".join(lines) + "\n" * forms.chance("an end of line at the end", 0.5)
    if forms.chance("tabs"):
        text = text.replace("v ", "v\t").replace("f ", "f \t")
    if forms.chance("indents"):
        text = text.replace("\nv", "\n  v").replace("\nf", "\n\tf")
    end = forms.one("\n", "\r\n", "\r")
    text = text.replace("\n", end)
    encoding = forms.one("utf-8", "utf-8-sig", "utf-16", "utf-16-be", "latin-1")
    return (codecs.BOM_UTF16_BE if encoding == "utf-16-be" else b"") + text.encode(encoding)


OBJ = "mtllib m.mtl\nv 0 0 0\nv 10 0 0\nv 0 10 0\nv 10 10 0\nvt 0.5 0.5\nvn 0 0 1\nusemtl a\nf 1 2 3\nf 2 4 3\n"
MTL = "newmtl a\nKd 0.5 0.5 0.5\n"
WRITTEN: dict[str, tuple[str, str]] = {
    "index 0": ("f 1 2 3", "f 0 1 2"),
    "an index beyond the end": ("f 1 2 3", "f 1 2 9"),
    "an index before the start": ("f 1 2 3", "f -9 -2 -1"),
    "coordinates beyond the end": ("f 1 2 3", "f 1/2 2/1 3/1"),
    "coordinates before the start": ("f 1 2 3", "f 1/-5 2/1 3/1"),
    "normals beyond the end": ("f 1 2 3", "f 1//1 2//1 3//7"),
    "words for indices": ("f 1 2 3", "f one two three"),
    "fractions for indices": ("f 1 2 3", "f 1.5 2.5 3.5"),
    "too many slashes": ("f 1 2 3", "f 1/1/1/1 2/1/1/1 3/1/1/1"),
    "endless indices": ("f 1 2 3", "f 1 2 99999999999999999999999"),
    "two coordinates": ("v 10 0 0", "v 10 0"),
    "words for numbers": ("v 10 0 0", "v ten 0 0"),
    "no number": ("v 10 0 0", "v nan 0 0"),
    "no end": ("v 10 0 0", "v inf 0 0"),
    "a number beyond float32": ("v 10 0 0", "v 1e300 0 0"),
    "a comma": ("v 10 0 0", "v 10,0 0 0"),
    "a coordinate without a number": ("vt 0.5 0.5", "vt"),
    "a coordinate that is a word": ("vt 0.5 0.5", "vt u v"),
    "a coordinate that is no number": ("vt 0.5 0.5", "vt nan 0.5\nf 1/1 2/1 3/1\n"),
    "a normal of two numbers": ("vn 0 0 1", "vn 0 1"),
    "no faces": ("f", "g"),
    "no vertices": ("v ", "# "),
    "no area": ("10", "0"),
    "a spectral colour": ("0.5 0.5 0.5", "spectral a.rfl"),
    "a colour that is a word": ("0.5 0.5 0.5", "grey"),
    "a colour that is no number": ("0.5 0.5 0.5", "nan 0.5 0.5"),
    "an image that is none": ("Kd 0.5 0.5 0.5", "map_Kd m.mtl"),
}
"""What is written in place of what, in either file."""
DAMAGES = (
    *WRITTEN, "half a character", "bytes that are no text", "a face of two corners", "no materials", "cut short"
)  # fmt: skip


def broken(folder: Path, number: int, random: np.random.Generator) -> Case:
    """Two triangles, damaged in one way; what is left out is named in a warning."""
    damage = DAMAGES[number % len(DAMAGES)]
    path = folder / f"broken {number}.obj"
    corners = np.array([[0, 0, 0], [10, 0, 0], [0, 10, 0], [10, 10, 0]], np.float64)
    rows = np.concatenate((corners, np.full((4, 2), np.nan), np.ones((4, 3))), 1)
    first = Shapes([Region([rows[[0, 1, 2]]])])
    both = Shapes([Region([rows[[0, 1, 2]], rows[[1, 3, 2]]])])
    old, new = WRITTEN.get(damage, ("", ""))
    text, mtl = (whole.replace(old, new).replace("m.mtl", f"m{number}.mtl") for whole in (OBJ, MTL))
    if damage != "no materials":
        (folder / f"m{number}.mtl").write_text(mtl)
    read: dict[str, tuple[bytes, Shapes | None, str]] = {
        "half a character": (text.encode("utf-16")[:-1], None, ""),
        "bytes that are no text": (bytes(random.integers(128, 256, 300, dtype=np.uint8)), None, ""),
        "a face of two corners": (text.replace("f 2 4 3", "f 2 4").encode(), first, "corners"),
        "no materials": (text.encode(), both, f"m{number}.mtl"),
        "cut short": (text[: text.index("f 2") + 4].encode() if "f 2" in text else b"", first, "corners"),
    }
    data, answer, warns = read.get(damage, (text.encode(), None, ""))
    path.write_bytes(data)
    return Case(path, answer, damage=damage, warns=warns)
