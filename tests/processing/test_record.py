"""Records of steps: which bits they notice, and what is done about damaged ones."""

import json
from dataclasses import replace

import numpy as np
import pytest

import clsas
from clsas.engine.data.digests import file_digest
from clsas.engine.data.validate import ClsasWarning
from clsas.files.scene_files import SceneFile
from clsas.processing.record import (
    RecordingFile,
    StepRecord,
    read_records,
    write_records,
)
from clsas.processing.steps import STEPS

SCENE = SceneFile("scene")
NUMBERS = {"peak_db": -3.25, "valid": 0.9, "unknowns": ["sway", "heave"], "none": None}


def written(folder, *names):
    """Records of some steps, each with a file, and the contents of `process.json`."""
    records = {}
    for name in names:
        (folder / f"{name}.h5").write_text(name)
        files = {f"{name}.h5": file_digest(folder / f"{name}.h5")}
        records[name] = StepRecord(name, "ab12", numbers=NUMBERS, files=files, warnings=("dark",))
    write_records(folder, SCENE, {"file": "lines.h5", "digest": "cd34"}, records.values())
    return records, (folder / "process.json").read_bytes()


def test_no_bit_changes_what_is_read(tmp_path):
    records, whole = written(tmp_path, "focus", "image")
    assert read_records(tmp_path, SCENE) == (records, False)
    chance, kinds = np.random.default_rng(2), []
    for bit in chance.choice(8 * len(whole), 600, replace=False):
        content = bytearray(whole)
        content[bit // 8] ^= 1 << bit % 8
        (tmp_path / "process.json").write_bytes(content)
        try:
            found, is_damaged = read_records(tmp_path, SCENE)
        except ValueError:
            kinds.append("refused")
            continue
        kinds.append(len(found))
        assert found.items() <= records.items()
        assert is_damaged or found == records
    assert kinds.count(1) > 100  # one of the two records is damaged
    assert kinds.count("refused") < 40


@pytest.mark.parametrize("name", ["image", "focus"])
def test_only_the_damaged_record_is_lost(tmp_path, name):
    records, whole = written(tmp_path, "focus", "image")
    document = json.loads(whole)
    (step,) = (each for each in document["steps"] if each["name"] == name)
    step["numbers"]["valid"] = 900
    (tmp_path / "process.json").write_text(json.dumps(document))
    del records[name]
    assert read_records(tmp_path, SCENE) == (records, True)


@pytest.mark.parametrize("cut", [40, 200, -2])
def test_a_record_that_is_cut_is_damaged(tmp_path, cut):
    _, whole = written(tmp_path, "image")
    (tmp_path / "process.json").write_bytes(whole[:cut])
    assert read_records(tmp_path, SCENE) == ({}, True)


def test_a_record_names_no_files_elsewhere(tmp_path):
    write_records(tmp_path, SCENE, {}, [StepRecord("image", "ab12", files={"../lines.h5": "0"})])
    assert read_records(tmp_path, SCENE) == ({}, True)


PLACE = clsas.Georeference.local(60.39, 5.32, heading_deg=217)
LINES = clsas.RangeLines(
    np.ones((2, 9), complex), 40.0, 0.05, [[0, 0, -1], [0.5, 0, -1]], [0, 0, -1], 1e5, 1500.0
)


@pytest.mark.parametrize(
    "changes",
    [
        {"sound_speed": clsas.SoundSpeed([0, 60], [1500, 1490])},
        {"georeference": PLACE},
        {"georeference": replace(PLACE, heading_deg=217.0000001)},
        {"look_direction": [0, 1, 0]},
        {"bank_numbers": [0, 1]},
        {"rx_velocity_m_s": [1, 0, 0]},
        {"samples": 1j * LINES.samples},
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_lines_in_memory_differ_by_every_field(changes):
    found = {RecordingFile.of(SCENE, each).digest for each in (LINES, replace(LINES, **changes))}
    assert len(found) == 2


class TestChain:
    """With an image that takes no time."""

    @pytest.fixture(autouse=True)
    def quick(self, monkeypatch):
        def imaged(job):
            grid = job.scene.grid
            clsas.save(job.staged / "image.h5", clsas.Image(np.ones(grid.shape, complex), grid))
            return {"peak_db": -3.25}

        def inspected(job):
            (job.staged / "inspect.txt").write_text("fine")
            return {}

        for name, run in (("image", imaged), ("inspect", inspected)):
            monkeypatch.setitem(STEPS, name, replace(STEPS[name], run=run))

    @pytest.fixture
    def scene(self, tmp_path):
        path = tmp_path / "scene.toml"
        path.write_text(
            "[grid]\nx = { start_m = 0, stop_m = 1, count = 3 }\n"
            "y = { start_m = 40, stop_m = 41, count = 2 }\n"
            '[image]\naccuracy_db = -50\n[process]\nsteps = ["inspect", "image"]\n'
        )
        assert clsas.process(path, lines=LINES).repeated == ("inspect", "image")
        return path

    @pytest.mark.parametrize(
        ("old", "new", "again"),
        [
            ('"peak_db": -3.25', '"peak_db": -3.2', ("image",)),
            ('"name": "image"', '"name": "imagd"', ("image",)),
            ('"inspect.txt": "', '"inspect.txt": "1', ("inspect",)),
            ('"recording": {', '"recordinf": {', ("inspect", "image")),
            ('"steps": [', '"steps": {', ("inspect", "image")),
        ],
    )
    def test_the_step_of_a_damaged_record_runs_again(self, scene, old, new, again):
        path = scene.with_suffix("") / "process.json"
        whole = json.loads(path.read_text())
        assert old in path.read_text()
        path.write_text(path.read_text().replace(old, new, 1))
        message = rf"process\.json is damaged; these steps are run again: {', '.join(again)}$"
        with pytest.warns(ClsasWarning, match=message):
            found = clsas.process(scene, lines=LINES)
        assert found.repeated == again
        assert found["image"].numbers == {"peak_db": -3.25}
        assert [each["name"] for each in json.loads(path.read_text())["steps"]] == [
            each["name"] for each in whole["steps"]
        ]
        assert clsas.process(scene, lines=LINES).repeated == ()

    def test_a_step_that_is_left_alone_may_run_again_later(self, scene):
        """Although its record was damaged, and the record was written again since."""
        path = scene.with_suffix("") / "process.json"
        path.write_text(path.read_text().replace('"peak_db": -3.25', '"peak_db": -3.2'))
        (path.parent / "inspect.txt").unlink()
        with pytest.warns(ClsasWarning) as said:
            assert clsas.process(scene, lines=LINES, steps=["inspect"]).repeated == ("inspect",)
        assert ["is damaged" in str(each.message) for each in said] == [True, False]
        assert "results of image" in str(said[1].message)
        assert clsas.process(scene, lines=LINES).repeated == ("image",)

    @pytest.mark.parametrize(
        "changes",
        [{"sound_speed": clsas.SoundSpeed([0, 60], [1500, 1490])}, {"georeference": PLACE}],
        ids=lambda changes: next(iter(changes)),
    )
    def test_other_lines_in_memory_run_the_steps_again(self, scene, changes):
        other = replace(LINES, **changes)
        assert clsas.process(scene, lines=other).repeated == ("inspect", "image")
        assert clsas.process(scene, lines=other).repeated == ()

    def test_a_place_that_words_would_round_counts(self, scene):
        for latitude in ("60.39", "60.3900000001"):
            scene.write_text(
                scene.read_text().partition("[georeference]")[0]
                + f"[georeference]\nlatitude_deg = {latitude}\nlongitude_deg = 5.32\n"
                "heading_deg = 0\n"
            )
            assert clsas.process(scene, lines=LINES).repeated == ("inspect", "image")
