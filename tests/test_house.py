"""The house: rooms by subject, arrows that run one way, nothing imported late, no name that hides a module."""

from __future__ import annotations

import importlib
import pkgutil
from types import ModuleType

import pytest

import ptt
from bench import house

MOST_ROOMS = 15
MOST_FLOORS = 8


def test_there_are_few_rooms() -> None:
    rooms = house.rooms()
    assert len(rooms) <= MOST_ROOMS, sorted(rooms)


def test_no_circle_and_few_floors() -> None:
    """Rooms stand on those that they import; a circle has no floor."""
    assert not house.circles(house.arrows())
    assert house.floors() <= MOST_FLOORS


def test_no_circle_of_files() -> None:
    assert not house.circles(house.file_arrows())


@pytest.mark.parametrize(
    ("room", "may_import"),
    [
        ("ops", set()),
        ("io", set()),
        ("materials", {"ops"}),
        ("light", {"ops", "io"}),
        ("scene", {"ops", "io", "light", "materials"}),
        ("threads", {"ops"}),
        ("models", {"ops", "io", "light", "materials", "scene", "threads"}),
        ("imaging", {"ops", "io", "light", "materials", "scene"}),
        ("reference", {"ops", "io", "light", "materials", "scene"}),
        ("transfer", {"ops", "io", "light", "materials", "scene", "models", "threads"}),
        ("relight", {"ops", "io", "light", "materials", "scene", "models", "imaging", "threads"}),
    ],
)
def test_no_arrow_runs_upward(room: str, may_import: set[str]) -> None:
    """Data flows scene -> transfer -> compressed model -> relight -> image; nothing flows back."""
    assert house.arrows()[room] <= may_import


def test_nothing_of_ptt_is_imported_late() -> None:
    """No import of ptt inside a function, or for type checkers alone, to dodge a circle."""
    assert not house.late_imports()


def test_scripts_import_the_package_and_the_command_line_alone() -> None:
    assert house.arrows()["scripts"] <= {"ptt", "cli"}


def test_no_public_name_hides_a_module() -> None:
    """`ptt.x` is a module of that name, or there is none: `import ptt.x` never gives a function."""
    found = [module.name for module in pkgutil.walk_packages(ptt.__path__, "ptt.")]
    assert len(found) > 60
    for name in found:
        package, _, last = name.rpartition(".")
        importlib.import_module(name)
        assert isinstance(getattr(importlib.import_module(package), last), ModuleType), name


def test_the_graph_sees_a_circle() -> None:
    """The search itself: two circles, and a chain of three floors."""
    graph = {"a": {"b"}, "b": {"a"}, "c": {"a", "d"}, "d": set(), "e": {"e"}}
    assert sorted(map(sorted, house.circles(graph))) == [["a", "b"], ["e"]]
    assert house.height({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == 3
