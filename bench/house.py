"""The house in figures: rooms, floors, circles, imports, operators, graph breaks; rows of bench/results/house.csv.

    python -m bench.house           # about two minutes on two cores

Rooms are the packages and files of `ptt/`, and the folders of programs that stand on it. A room is on the floor above
the highest that it imports.
"""

from __future__ import annotations

import ast
import ctypes
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import torch

from bench.table import ROOT, Table, setting

PROGRAMS = ("scripts", "bench")
PEERS = "2 to 5 in tinygp, torch-harmonics, e3nn, ptwt, tensorly"


def main() -> None:
    table = Table("house")
    graph = arrows()
    table.row("rooms", len(rooms()), "", ", ".join(sorted(rooms())), "<= 15")
    table.row("floors", floors(), "", "the longest chain of imports between rooms", "<= 8")
    table.row("circles of rooms", len(circles(graph)), "", "", "<= 0")
    table.row("circles of files", len(circles(file_arrows())), "", "", "<= 0")
    table.row("late imports of ptt inside ptt", len(late_imports()), "", "", "<= 0")
    packed, statements = packed_assignments()
    how = f"{packed} of {statements} statements of ptt assign a tuple to a tuple"
    table.row("packed assignments", 1e3 * packed / statements, "per 1000 statements", how, "<= 5", peer=PEERS)
    imported(table)
    operators(table)
    graph_breaks(table)
    table.write()


@cache
def rooms() -> frozenset[str]:
    """The packages of ptt that hold code, its files at the top, and the folders of programs."""
    return frozenset(room_of(path) for path in sources())


@cache
def sources() -> tuple[Path, ...]:
    """The Python files of the package and of the programs, tests aside; empty ones hold nothing."""
    files = [path for folder in ("ptt", *PROGRAMS) for path in (ROOT / folder).rglob("*.py")]
    return tuple(path for path in files if path.read_text().strip() and not path.name.startswith("test_"))


def room_of(path: Path) -> str:
    """The room that a file lies in: `ptt` for the package's own `__init__`."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    if parts[0] != "ptt":
        return parts[0]
    return "ptt" if parts[1] == "__init__" else parts[1]


def imports(path: Path) -> Iterator[tuple[ast.stmt, str]]:
    """The modules of this project that a file imports, anywhere in it, with the statement."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] in ("ptt", *PROGRAMS):
            for name in node.names:
                whole = f"{node.module}.{name.name}"
                yield node, whole if module_file(whole) else node.module
        if isinstance(node, ast.Import):
            for name in node.names:
                if name.name.split(".")[0] in ("ptt", *PROGRAMS):
                    yield node, name.name


def module_file(module: str) -> Path | None:
    """The file of a module, None where there is none."""
    base = ROOT.joinpath(*module.split("."))
    return next((path for path in (base.with_suffix(".py"), base / "__init__.py") if path.is_file()), None)


@cache
def arrows() -> dict[str, set[str]]:
    """The other rooms that each room imports."""
    found: dict[str, set[str]] = {room: set() for room in rooms()}
    for path in sources():
        for _, module in imports(path):
            file = module_file(module)
            if file is not None:
                found[room_of(path)].add(room_of(file))
    return {room: others - {room} for room, others in found.items()}


def file_arrows() -> dict[str, set[str]]:
    """The files that each file imports."""
    found = {}
    for path in sources():
        files = {module_file(module) for _, module in imports(path)}
        found[str(path.relative_to(ROOT))] = {str(f.relative_to(ROOT)) for f in files if f is not None}
    return found


def late_imports() -> list[str]:
    """Where ptt imports itself inside of a function or a condition."""
    return [
        f"{path.relative_to(ROOT)}:{node.lineno} {module}"
        for path in (ROOT / "ptt").rglob("*.py")
        for node, module in imports(path)
        if node.col_offset and module.startswith("ptt")
    ]


def circles(graph: Mapping[str, set[str]]) -> list[set[str]]:
    """The groups of nodes that reach each other, and nodes that reach themselves."""
    reach = {node: reachable(graph, node) for node in graph}
    found = {
        frozenset(n for n in graph if n in reach[node] and node in reach[n]) for node in graph if node in reach[node]
    }
    return [set(group) for group in found]


def reachable(graph: Mapping[str, set[str]], start: str) -> set[str]:
    """The nodes that arrows lead to from a node."""
    found: set[str] = set()
    front = set(graph[start])
    while front:
        found |= front
        front = {other for node in front for other in graph.get(node, set())} - found
    return found


def floors() -> int:
    """The height of the house."""
    return height(arrows())


def height(graph: Mapping[str, set[str]]) -> int:
    """The nodes on the longest chain of a graph without circles."""

    @cache
    def level(node: str) -> int:
        return 1 + max((level(other) for other in graph[node]), default=0)

    return max(map(level, graph))


def packed_assignments() -> tuple[int, int]:
    """Assignments of a tuple to a tuple in ptt, and all statements."""
    packed = 0
    statements = 0
    for path in (ROOT / "ptt").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            statements += isinstance(node, ast.stmt)
            if isinstance(node, ast.Assign) and isinstance(node.value, ast.Tuple):
                packed += isinstance(node.targets[0], ast.Tuple)
    return packed, statements


def imported(table: Table) -> None:
    """The seconds that `import ptt` takes in a process of its own, and that of torch in it."""

    def seconds(module: str) -> float:
        code = f"import time; start = time.perf_counter(); import {module}; print(time.perf_counter() - start)"
        runs = [
            subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
            for _ in range(5)
        ]
        return statistics.median(float(run.stdout) for run in runs)

    whole = seconds("ptt")
    torch_alone = seconds("torch")
    table.row("import ptt", whole, "s", f"median of 5 processes; torch alone {torch_alone:.2f} s", "<= 2.5")


def operators(table: Table) -> None:
    """What a call of an operator costs above the call of its kernel by ctypes alone, microseconds."""
    from ptt.ops import native
    from ptt.ops.native import kernels

    frames = torch.eye(3).repeat(16, 1, 1)
    positions = torch.zeros(16, 3)
    eye = torch.tensor([0.0, 0.0, 3.0])
    rows = torch.empty(16, 4, dtype=torch.int32)
    weights = torch.empty(16, 4)
    structure = kernels.structures()["NearViews"]
    library = kernels.library("near")
    assert library is not None

    def bare() -> int:
        """As 0.1.0 called its kernels: tensors made, addresses and sizes packed, nothing checked."""
        values = dict(
            frames=frames, positions=positions, eye=eye, rows=torch.empty_like(rows), weights=torch.empty_like(weights)
        )
        pointers = {name: tensor.data_ptr() for name, tensor in values.items()}
        arguments = structure(**pointers, points=16, views=6, threads=1)
        status: int = library.ptt_near_views(ctypes.byref(arguments))
        return status

    def operator() -> Any:
        return native.of_views(frames, positions, eye, 6)

    def dispatched() -> Any:
        return torch.ops.ptt.near_views(frames, positions, eye, 6)

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    below = 1e6 * per_call(bare)
    graded = 1e6 * per_call(operator)
    through = 1e6 * per_call(dispatched)
    torch.set_num_threads(threads)
    how = f"near_views of 16 points; medians of 2000 calls; {setting()}"
    table.row("a kernel by ctypes alone", below, "us", how)
    peer = "9 as 0.1.0 called it, on the same machine; 23 by custom_op, in a trial"
    table.row("the same by ptt.ops.native", graded, "us", f"arguments checked; {how}", peer=peer)
    table.row("the same by torch.ops.ptt", through, "us", f"through torch's dispatcher; {how}", peer=peer)
    table.row("overhead of an operator", graded - below, "us", f"ptt.ops.native over ctypes alone; {how}")


def per_call(function: Callable[[], object], calls: int = 2000) -> float:
    """The median seconds of a call, of blocks of ten."""
    blocks = []
    function()
    for _ in range(calls // 10):
        start = time.perf_counter()
        for _ in range(10):
            function()
        blocks.append((time.perf_counter() - start) / 10)
    return statistics.median(blocks)


def graph_breaks(table: Table) -> None:
    """The graph breaks of torch.compile of each relighter, after changes of view, material and light."""
    from torch._dynamo.utils import counters

    for name, relighter in small_relighters().items():
        torch._dynamo.reset()
        counters.clear()
        compiled: Any = torch.compile(relighter, backend="aot_eager")
        light = small_light()
        for angle in (0.0, 30.0):
            for eye in (torch.tensor([1.0, 2.0, 3.0]), torch.tensor([-2.0, 1.0, 0.5])):
                compiled(light.rotated(y=angle), {}, eye)
        found = sum(counters["graph_break"].values())
        graphs = counters["stats"]["unique_graphs"]
        table.row(f"graph breaks, {name}", found, "", f"{graphs} graphs", "<= 0")


def small_light() -> Any:
    """A sky with a sun."""
    import ptt

    return ptt.Environment.sun_sky(radius=10.0)


def small_relighters() -> dict[str, torch.nn.Module]:
    """One of each kind on a ball over a floor."""
    import ptt
    from ptt.ops import mesh
    from ptt.scene.parts import Part

    ball, faces = mesh.sphere_mesh(2, 0.5)
    parts = [
        Part("floor", *mesh.plane_mesh(4.0, 13), material=ptt.lambert(0.6), editable=False),
        Part("ball", ball + torch.tensor([0.0, 0.6, 0.0]), faces, material=ptt.blinn_phong(0.3, 0.4, 12.0)),
    ]
    scene = ptt.Scene.from_parts(parts)
    space = ptt.BRDFSpace.blinn_phong((2.0, 8.0, 32.0))
    brdf = ptt.TensorBRDF.fit(space, ranks=(3, 8, 8), separated=3)
    raw = ptt.precompute(scene, 2, resolution=16, rays=64)
    model = ptt.compress(raw, 64, brdf, ptt.BRDFBasis.fit(space, 3), ptt.Clusters(60, 8, 32, 128))
    rotation = ptt.LightRotation.build(16, 4)
    return {
        "TransferRelighter": ptt.TransferRelighter(model),
        "EnvMapRelighter": ptt.EnvMapRelighter(scene, rotation, terms=16, views=16),
        "TripleProductRelighter": ptt.TripleProductRelighter(scene, 1, normals=6, twists=6, source=16, views=16),
    }


if __name__ == "__main__":
    main()
