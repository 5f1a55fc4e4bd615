"""The recorded file of scripts/golden, its comparison, and two scenes."""

import json
import subprocess
import sys
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
FILE = ROOT / "scripts" / "golden.json"
FIELDS = {"sides": [[64, 64], [16, 16]], "align_coefficients": "2x1 eJxjYGBo"}
OLD = {
    "a/planned/error_db": -52.0,
    "a/planned/plan/sides": [[64, 64], [16, 16]],
    "a/planned/predicted_db": -50.2,
    "a/planned/predicted_ms": 12.5,
    "a/planned/warnings": ["the error may be -32 dB", "lines are short"],
    "b/6 taps/error_db": -93.0,
    "b/-35 dB/within -35 dB": True,
    "c/explicit plan/fields": FIELDS,
}


@pytest.fixture(scope="module")
def golden():
    loader = SourceFileLoader("golden", str(ROOT / "scripts" / "golden"))
    module = module_from_spec(spec_from_loader("golden", loader))
    loader.exec_module(module)
    return module


def test_the_file_is_small_and_names_the_scenes_that_exist(golden):
    assert FILE.stat().st_size < 300e3
    assert {golden.scene_of(name) for name in golden.read(FILE)} == set(golden.chosen([]))


def test_the_file_has_nothing_that_machines_do_not_share(golden):
    values = golden.read(FILE)
    assert golden.shared(values) == values


def test_a_file_reads_as_it_was_written_with_a_value_on_each_line(golden, tmp_path):
    golden.write(tmp_path / "file", OLD | {"d/explicit plan/fields": FIELDS})
    lines = (tmp_path / "file").read_text().splitlines()
    assert len(lines) == len(OLD) + 1 + 1 + 2  # a plan and its filter, which two plans share
    assert lines[1:-1] == sorted(lines[1:-1])
    assert golden.read(tmp_path / "file") == OLD | {"d/explicit plan/fields": FIELDS}
    assert golden.explicit_plans(golden.read(tmp_path / "file")) == {"c": FIELDS, "d": FIELDS}


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("a/planned/error_db", -51.6, "planned/error_db: -52.0 -> -51.6 (+0.4 dB)"),
        ("a/planned/predicted_db", -50.1, "planned/predicted_db: -50.2 -> -50.1 (+0.1 dB)"),
        ("a/planned/predicted_ms", 12.6, "planned/predicted_ms: 12.5 -> 12.6"),
        (
            "a/planned/plan/sides",
            [[64, 64], [16, 8]],
            "planned/plan/sides: [[64, 64], [16, 16]] -> [[64, 64], [16, 8]]",
        ),
        ("b/6 taps/error_db", -86.0, "6 taps/error_db: -93.0 -> -86.0 (+7 dB)"),
        ("b/-35 dB/within -35 dB", False, "-35 dB/within -35 dB: true -> false"),
        ("b/-35 dB/warnings", ["loud"], 'new, ["loud"]'),
    ],
)
def test_a_changed_value_is_reported(golden, name, value, text):
    found = golden.differences(OLD, OLD | {name: value})
    assert found.keys() == {name[0]}
    (line,) = found[name[0]]
    assert line.endswith(text)


def test_changed_warnings_are_reported_one_by_one(golden):
    changed = {"a/planned/warnings": ["lines are short", "the error may be -33 dB"]}
    assert golden.differences(OLD, OLD | changed)["a"] == [
        "planned/warnings: gone: the error may be -32 dB",
        "planned/warnings: new: the error may be -33 dB",
    ]


def test_a_missing_value_is_reported(golden):
    left = {name: value for name, value in OLD.items() if name != "a/planned/predicted_ms"}
    assert golden.differences(OLD, left) == {"a": ["planned/predicted_ms: gone, was 12.5"]}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("a/planned/error_db", -52.05),
        ("a/planned/predicted_db", -50.22),
        ("b/6 taps/error_db", -90.5),
        ("b/6 taps/error_db", -97.0),
    ],
)
def test_what_rounds_otherwise_elsewhere_is_a_difference_only_here(golden, name, value):
    assert not golden.differences(OLD, OLD | {name: value})
    assert golden.differences(OLD, OLD | {name: value}, exactly=True)


def test_changed_pixels_are_reported(golden):
    image = np.arange(1, 5, dtype=np.complex64).reshape(2, 2)
    changed = image.copy()
    changed[0, 1] += 0.01
    assert not golden.pixel_differences({"a/planned": image}, {"a/planned": image.copy()})
    assert golden.pixel_differences({"a/planned": image}, {"a/planned": changed}) == {
        "a/planned": ["planned: values differ by -54.8 dB"]
    }
    assert golden.pixel_differences({"a/planned": image}, {"a/planned": changed[:1]}) == {
        "a/planned": ["planned: complex64 (2, 2) -> complex64 (1, 2)"]
    }


def test_a_pixel_that_is_not_finite_any_more_is_reported(golden):
    heights = np.array([1.0, 2.0, 3.0])
    (line,) = golden.pixel_differences({"a/h": heights}, {"a/h": [1.0, np.nan, 3.0] + 0 * heights})[
        "a/h"
    ]
    assert line.endswith("1 of them by being finite")


def test_a_plan_with_the_fields_of_another_forms_its_image():
    from golden_forming import fields_of, with_fields
    from golden_scenes import short

    import clsas

    scene = short()
    one, other = (
        clsas.plan(scene.lines, scene.grid, tolerance_db=-40, depth=1, taps=taps)
        for taps in ((4, 4), (8, 8))
    )
    fields = json.loads(json.dumps(fields_of(other)))
    images = [
        clsas.factorize(scene.lines, scene.grid, each)
        for each in (with_fields(one, fields), with_fields(other, fields))
    ]
    assert fields_of(with_fields(one, fields)) == fields
    assert np.array_equal(*(image.pixels for image in images))
    assert scene.error_db(images[0]) < -40


def test_a_field_that_moved_is_found_in_both_places(monkeypatch):
    import golden_forming

    monkeypatch.setitem(golden_forming.FIELDS, "sides", "method.ladder|method.sides")
    assert golden_forming._path("sides", {"method": {"sides": []}}) == ["method", "sides"]
    assert golden_forming._path("sides", {"method": {"ladder": []}}) == ["method", "ladder"]


@pytest.mark.slow
def test_two_scenes_are_as_recorded():
    command = [sys.executable, str(ROOT / "scripts" / "golden"), "exact, plane", "helix"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout == "2 of 2 scenes are as recorded\n"
