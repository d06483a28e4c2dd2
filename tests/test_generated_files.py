"""The generated files of `bench.inputs` through the loaders; and what the judge over them sees."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from bench import generated_exr, generated_gltf, generated_hdr, generated_obj, generated_ply, inputs
from bench.generated_files import Shapes, Sky, Verdict, judge, survives


@pytest.mark.parametrize("name", inputs.FORMATS)
def test_files_are_right_or_refused_by_name(tmp_path: Path, name: str) -> None:
    """Valid ones in rare forms give what was written; damaged ones are refused, or give it as well."""
    verdicts = [(case, judge(case)) for case in inputs.cases(name, tmp_path)]
    assert not [(case.path.name, verdict.why) for case, verdict in verdicts if verdict.outcome == "wrong"]
    assert {"right", "refused"} == {verdict.outcome for _, verdict in verdicts}


def other_shapes(shapes: Shapes) -> dict[str, Shapes]:
    """What differs from the first region's shapes in one respect."""
    first, *others = shapes.regions
    moved, recoloured = ([polygon.copy() for polygon in first.polygons] for _ in range(2))
    moved[0][0, 0] += 0.01
    recoloured[0][0, 5] += 0.01
    polygons = {
        "a corner moved": moved,
        "a colour": recoloured,
        "a face turned over": [first.polygons[0][::-1], *first.polygons[1:]],
        "a face too few": [*first.polygons, first.polygons[0]],
        "a face too many": first.polygons[1:],
    }
    regions = {what: first._replace(polygons=own) for what, own in polygons.items() if own}
    regions["a material"] = first._replace(diffuse=(0.123, 0.2, 0.3))
    return {what: Shapes([own, *others]) for what, own in regions.items()} | {
        "a region": Shapes([*shapes.regions, first])
    }


@pytest.mark.parametrize("draw", [generated_gltf.valid, generated_obj.valid, generated_ply.valid])
def test_shapes_that_are_not_the_file_s_are_seen(tmp_path: Path, draw: inputs.Draw) -> None:
    for number in range(5):
        case = draw(tmp_path, number, np.random.default_rng(number))
        assert isinstance(case.answer, Shapes) and judge(case).outcome == "right"
        for what, other in other_shapes(case.answer).items():
            assert judge(case._replace(answer=other)).outcome == "wrong", what


@pytest.mark.parametrize("draw", [generated_hdr.valid, generated_exr.valid])
def test_pixels_that_are_not_the_file_s_are_seen(tmp_path: Path, draw: inputs.Draw) -> None:
    case = draw(tmp_path, 1, np.random.default_rng(1))
    assert isinstance(case.answer, Sky) and judge(case).outcome == "right"
    pixels = case.answer.pixels
    other = pixels.copy()
    other[-1, 0, 0] = 1.1 * other[-1, 0, 0] + 0.1 * pixels.max()
    for wrong in (other, pixels[:, ::-1], 1.2 * pixels, pixels[1:]):
        assert judge(case._replace(answer=case.answer._replace(pixels=wrong))).outcome == "wrong"


def test_what_must_be_refused_or_warned_of_is_not_read_in_silence(tmp_path: Path) -> None:
    case = generated_ply.valid(tmp_path, 0, np.random.default_rng(0))
    assert judge(case._replace(answer=None, damage="none")).why == "it was read"
    assert judge(case._replace(warns="without a corner")).outcome == "wrong"
    assert survives(case.path).outcome == "right"
    case.path.write_text("ply")
    assert judge(case).outcome == "wrong" and survives(case.path).outcome == "refused"


def test_a_reader_that_hangs_is_ended() -> None:
    """After its second, by the process that it runs in."""
    assert [found.outcome for found in inputs.apart(sleeps, [60.0], 1)] == ["wrong"]


def sleeps(seconds: float) -> Verdict:
    time.sleep(seconds)
    return Verdict("right")
