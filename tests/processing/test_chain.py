"""The chain from a recording to a focused image: which steps run, and which files are kept."""

import json
import pickle
import re
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

import clsas
from clsas.cli import main
from clsas.engine.data.atomic import locked
from clsas.engine.data.digests import with_digest
from clsas.engine.data.validate import ClsasWarning
from clsas.files.scene_tables import STEP_NAMES
from clsas.processing import record as record_module
from clsas.processing.steps import STEPS

pytest.importorskip("matplotlib")

SCENE = """
[grid]
x = { start_m = 1.0, stop_m = 5.0, count = 161 }
y = { start_m = 13.0, stop_m = 15.0, count = 121 }

[image]
tolerance_db = -40

[process]
lines = "lines.h5"
"""
CALIBRATE = """
[process.calibrate]
points_m = [[2.0, 11.5, 0.0], [4.0, 16.5, 0.0]]
unknowns = ["time_offset"]
search_m = 0.4
"""
FOCUS = """
[process.focus]
unknowns = ["sway"]
"""


def recording(sway_m=0.0, time_s=0.0):
    """Return lines of points from a swaying track, with the positions of a straight one."""
    sonar = clsas.Sonar(
        clsas.Pulse(100e3, 30e3, 1e-3), [[0.0, 0.0, 0.0]], tx_length_m=0.06, rx_length_m=0.06
    )
    course = (0, 0, 0), (0.025, 0, 0), 260, 1.0
    track = clsas.Track.straight(*course, sway_m=lambda t: sway_m * np.sin(t / 40))
    rng = np.random.default_rng(0)
    at = np.stack([rng.uniform(1.2, 4.8, 60), rng.uniform(13.2, 14.8, 60), np.zeros(60)], axis=1)
    at[:2] = [2.0, 11.5, 0.0], [4.0, 16.5, 0.0]
    level = np.exp(2j * np.pi * rng.random(60)) * np.where(np.arange(60) < 2, 2, 1)
    lines = clsas.compress(clsas.simulate(sonar, track, clsas.PointTargets(at, level)))
    told = clsas.channels(sonar, clsas.Track.straight(*course))
    return replace(
        lines, tx_m=told.tx_m, rx_m=told.rx_m, first_range_m=lines.first_range_m - 750 * time_s
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("processing")
    clsas.save(path / "lines.h5", recording(4e-3, 2e-4))
    return path


@pytest.fixture
def scene(folder, tmp_path):
    """A scene file beside the recording, with every step that works on lines."""
    (tmp_path / "lines.h5").symlink_to(folder / "lines.h5")
    path = tmp_path / "scene.toml"
    path.write_text(SCENE + CALIBRATE + FOCUS)
    return path


STEPS_HERE = ("calibrate", "focus", "image")


def choose(scene, *steps):
    """Write the steps of a scene into its file."""
    text = scene.read_text().replace(
        'lines = "lines.h5"', f'lines = "lines.h5"\nsteps = {[*steps]}'
    )
    scene.write_text(text)


@pytest.fixture
def plain(scene):
    """A scene whose only step images the uncorrected recording."""
    choose(scene, "image")
    return scene


@pytest.mark.slow
def test_steps_run_in_their_order_and_improve_the_image(scene):
    told = []
    found = clsas.process(scene, steps=STEPS_HERE[::-1], progress=lambda *each: told.append(each))
    assert tuple(step.name for step in found.steps) == STEPS_HERE == found.repeated
    assert [name for name in STEPS if name in {each[0] for each in told}] == list(STEPS_HERE)
    for name in STEPS_HERE:
        assert all(done <= total for step, done, total in told if step == name)
        assert max(done / total for step, done, total in told if step == name) == 1
    numbers = found["image"].numbers
    assert numbers["peak_db"] > numbers["before"]["peak_db"] + 1
    assert found["calibrate"].numbers["values"][0] == pytest.approx(2e-4, abs=5e-6)
    assert found["focus"].numbers["focused"]
    assert np.abs(found.image.pixels).max() == pytest.approx(10 ** (numbers["peak_db"] / 20))
    assert found.lines.channels == 260
    folder = scene.with_suffix("")
    assert found.folder == folder
    pictures = {"focus-track.png", "focus-sharpness.png", "image.png", "before-and-after.png"}
    data = {"calibrate.h5", "focus.h5", "focus.csv", "image.h5", "before.h5", "process.json"}
    assert {path.name for path in folder.iterdir()} == pictures | data
    written = np.genfromtxt(folder / "focus.csv", delimiter=",", names=True)
    np.testing.assert_allclose(written["y_m"], found.lines.ping_centres_m[:, 1], atol=1e-6)
    record = json.loads((folder / "process.json").read_text())
    assert record["clsas"] == clsas.__version__
    assert record["recording"]["file"].endswith("lines.h5")
    assert [step["name"] for step in record["steps"]] == list(STEPS_HERE)
    assert record["steps"][0]["options"]["unknowns"] == ["time_offset"]
    assert "calibrate, focus, image" in repr(found)


def array_lines():
    """Return lines of an array whose samples depend on the phase centre alone."""
    rng = np.random.default_rng(0)
    spacing_m, (ping, receiver) = 0.0075, np.divmod(np.arange(8 * 24), 24)
    tx_m, rx_m = np.zeros((2, len(ping), 3))
    tx_m[:, 0] = 12 * spacing_m * ping
    rx_m[:, 0] = tx_m[:, 0] + 2 * spacing_m * receiver
    spectrum = rng.standard_normal((12 * 8 + 24, 400, 2)) @ [1, 1j]
    spectrum[:, np.abs(np.fft.fftfreq(400)) > 0.25] = 0
    samples = np.fft.ifft(spectrum)[12 * ping + receiver]
    return clsas.RangeLines(samples, 20.0, 0.02, tx_m, rx_m, 100e3, 1500.0)


def test_navigation_writes_lines_a_table_and_pictures(tmp_path):
    scene = tmp_path / "scene.toml"
    scene.write_text("[process]\nsteps = ['navigate']\n")
    found = clsas.process(scene, lines=array_lines())
    assert tuple(found["navigate"].files) == STEPS["navigate"].files
    assert found["navigate"].numbers["pings"] == 8
    written = np.genfromtxt(found.folder / "navigate.csv", delimiter=",", names=True)
    np.testing.assert_array_equal(written["ping"], np.arange(8))
    np.testing.assert_allclose(written["y_m"], found.lines.ping_centres_m[:, 1], atol=1e-9)
    np.testing.assert_allclose(written["sway_m"], written["y_m"], atol=1e-9)  # of a straight track


def test_every_step_has_a_row():
    assert tuple(STEPS) == STEP_NAMES


@pytest.mark.slow
def test_only_what_changed_runs_again(scene):
    def repeated(**options):
        return clsas.process(scene, **options).repeated

    steps = "calibrate", "image"
    choose(scene, *steps)
    assert repeated() == steps
    assert repeated() == ()
    scene.write_text(scene.read_text().replace("tolerance_db = -40", "tolerance_db = -30"))
    assert repeated() == ("image",)
    scene.write_text(scene.read_text().replace("search_m = 0.4", "search_m = 0.3"))
    assert repeated() == steps
    for name, again in (("calibrate.h5", steps), ("image.png", ("image",))):
        path = scene.with_suffix("") / name
        path.write_bytes(path.read_bytes()[:-3])  # damaged
        assert set(repeated()) <= set(again)
        path.unlink()
        assert again[0] in repeated()
    other = clsas.load(scene.parent / "lines.h5").weighted(np.full(260, 2.0))
    assert repeated(lines=other) == steps


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_the_image_is_certified_as_the_scene_says(plain):
    for certificate in ("true", "false"):
        text = plain.read_text()
        assert "\n[image]\n" in text
        given = text.replace("\n[image]\n", f"\n[image]\ncertificate = {certificate}\n")
        plain.write_text(given)
        found = clsas.process(plain)
        plain.write_text(text)
        assert found.repeated == ("image",)
        measured, numbers = found.image.formed.certificate, found["image"].numbers
        if certificate == "true":
            assert numbers["certificate"]["error"] == measured.error
            assert numbers["error"] == measured.describe(found.image.formed.tolerance_db)
        else:
            assert measured is numbers["certificate"] is numbers["error"] is None


def test_a_record_that_cannot_be_read_is_no_licence_to_replace(plain):
    folder = clsas.process(plain).folder
    path, before = folder / "process.json", contents(folder)
    record = json.loads(path.read_text())
    for text, message in (
        ("{", r"process\.json that clsas did not write, or whose .* or remove the file"),
        ("[]", "that clsas did not write"),
        (json.dumps(record | {"version": 1}), "of another version of clsas"),
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match=message):
            clsas.process(plain)
        assert contents(folder) == before | {"process.json": text.encode()}
    path.write_text(json.dumps(record | {"steps": []}))
    with pytest.raises(ValueError, match=r"not contain image\.h5, which image would"):
        clsas.process(plain)


@pytest.mark.parametrize("name", ["image.h5", "image.png", "before.h5"])
def test_files_of_others_are_never_replaced(plain, tmp_path, name):
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / name).write_text("mine")
    message = f"not contain {name}, which image would .*, got '.*mine': choose another folder"
    with pytest.raises(ValueError, match=message):
        clsas.process(plain, output=folder)
    assert contents(folder) == {name: b"mine"}
    (folder / name).rename(folder / "notes.txt")
    clsas.process(plain, output=folder)
    assert (folder / "notes.txt").read_text() == "mine"


def test_two_scenes_do_not_share_a_folder(plain, tmp_path):
    other = tmp_path / "other.toml"
    other.write_text(plain.read_text().replace("tolerance_db = -40", "tolerance_db = -30"))
    folder = clsas.process(plain, output=tmp_path / "both").folder
    before = contents(folder)
    with pytest.raises(ValueError, match=r"another scene, .* '../scene.toml' .* '../other.toml'"):
        clsas.process(other, output=folder)
    assert contents(folder) == before


def test_scene_and_folder_may_move_together(plain, tmp_path, monkeypatch):
    clsas.process(plain)
    moved = tmp_path / "moved"
    moved.mkdir()
    for name in ("lines.h5", "scene.toml", "scene"):
        (tmp_path / name).rename(moved / name)
    monkeypatch.chdir(moved)
    assert clsas.process("scene.toml").repeated == ()


@pytest.mark.slow
def test_a_killed_step_leaves_nothing_in_the_way(plain, monkeypatch):
    """The files of a step appear together when it is done."""
    folder, image = plain.with_suffix(""), STEPS["image"]

    def killed(job):
        image.run(job)
        raise KeyboardInterrupt

    monkeypatch.setitem(STEPS, "image", replace(image, run=killed))
    with pytest.raises(KeyboardInterrupt):
        clsas.process(plain)
    assert not folder.exists()
    monkeypatch.undo()
    clsas.process(plain)
    before = contents(folder)
    plain.write_text(plain.read_text().replace("tolerance_db = -40", "tolerance_db = -30"))
    monkeypatch.setitem(STEPS, "image", replace(image, run=killed))
    with pytest.raises(KeyboardInterrupt):
        clsas.process(plain)
    assert contents(folder) == before


@pytest.mark.slow
def test_what_was_finished_before_an_error_is_kept(scene):
    text = scene.read_text()
    scene.write_text(text + '[process.navigate]\nside = "starboard"\n')
    choose(scene, "calibrate", "navigate", "image")
    message = r"scene.toml: navigate \(\[process.navigate\]\): lines must have at least 2 receivers"
    with pytest.raises(ValueError, match=message):
        clsas.process(scene)
    scene.write_text(text)
    choose(scene, "calibrate", "image")
    assert clsas.process(scene).repeated == ("image",)


@pytest.mark.slow
def test_a_single_step_begins_with_the_lines_that_the_scene_corrects(scene):
    """Whether or not the corrections ran before, and whatever else the folder contains."""
    choose(scene, "inspect", "calibrate", "image")
    found = clsas.process(scene, steps=("image",))
    assert found.repeated == ("calibrate", "image")
    assert found["image"].corrections == ("calibrate",)
    assert found["image"].lines == found["calibrate"].inputs
    with pytest.warns(ClsasWarning):  # the findings of the inspection
        assert clsas.process(scene).repeated == ("inspect",)
    assert clsas.process(scene, steps=("image",)).repeated == ()
    assert clsas.process(scene, steps=("inspect",)).repeated == ()
    assert clsas.process(scene).repeated == ()
    record = json.loads((found.folder / "process.json").read_text())
    assert [step["name"] for step in record["steps"]] == ["inspect", "calibrate", "image"]


@pytest.mark.slow
def test_results_that_no_longer_belong_to_the_lines_are_named(scene):
    choose(scene, "calibrate", "image")
    folder = clsas.process(scene).folder
    scene.write_text(scene.read_text().replace("search_m = 0.4", "search_m = 0.3"))
    message = (
        "results of image in .* are out of date, since its lines .* changed: image.h5, image.png"
    )
    with pytest.warns(ClsasWarning, match=message):
        assert clsas.process(scene, steps=("calibrate",)).repeated == ("calibrate",)
    scene.write_text(scene.read_text().replace("'calibrate', ", ""))
    with pytest.warns(
        ClsasWarning, match="out of date, since the scene leaves it out: calibrate.h5"
    ):
        found = clsas.process(scene)
    assert found["image"].corrections == ()
    # The comparison of the image before and after the corrections is removed with them.
    assert set(contents(folder)) == {"process.json", "calibrate.h5", "image.h5", "image.png"}


def test_a_damaged_recording_leaves_no_folder(plain, tmp_path):
    damaged = tmp_path / "damaged.h5"
    damaged.write_bytes((plain.parent / "lines.h5").read_bytes()[:5000])
    output = tmp_path / "output"
    with pytest.raises(ValueError, match=r"damaged\.h5"):
        clsas.process(plain, lines=damaged, output=output)
    assert not output.exists()


@pytest.mark.slow
def test_usual_steps_and_warnings_of_inspection(scene):
    with pytest.warns(ClsasWarning):
        found = clsas.process(scene)
    assert tuple(step.name for step in found.steps) == ("inspect", *STEPS_HERE)
    assert (found.folder / "inspect.txt").read_text().startswith("quantity")
    assert (found.folder / "inspect.png").exists()
    findings = found["inspect"].numbers["findings"]
    assert len(found["inspect"].warnings) == len(findings) > 0
    for finding, warning in zip(findings, found["inspect"].warnings, strict=True):
        assert warning.startswith(
            f"{finding['name']}: {finding['message']}. "
        )  # the remedy follows
    assert clsas.process(scene).repeated == ()  # without a warning


@pytest.mark.slow
def test_lines_and_echoes_in_memory(scene, tmp_path):
    lines = clsas.load(scene.parent / "lines.h5")
    choose(scene, "image")
    found = clsas.process(scene, lines=lines, output=tmp_path / "own")
    assert found.folder == tmp_path / "own"
    assert "before" not in found["image"].numbers
    np.testing.assert_array_equal(found.lines.samples, lines.samples)
    with pytest.raises(KeyError):
        _ = clsas.process(scene, lines=lines, steps=("calibrate",)).image


@pytest.mark.slow
@pytest.mark.parametrize("steps", [("image",), ("calibrate", "image")])
def test_a_pickled_processing_holds_no_lines_of_files(scene, steps):
    choose(scene, *steps)
    found = clsas.process(scene)
    samples = found.lines.samples
    pickled = pickle.dumps(found)
    assert len(pickled) < samples.nbytes / 10
    np.testing.assert_array_equal(pickle.loads(pickled).lines.samples, samples)


def test_a_pickled_processing_holds_lines_given_in_memory(scene):
    choose(scene, "image")
    lines = clsas.load(scene.parent / "lines.h5")
    read = pickle.loads(pickle.dumps(clsas.process(scene, lines=lines)))
    np.testing.assert_array_equal(read.lines.samples, lines.samples)


@pytest.mark.slow
def test_mosaic_continues(scene):
    pytest.importorskip("zarr")
    scene.write_text(scene.read_text() + "[mosaic]\npatches = [2, 2]\n")
    choose(scene, "calibrate", "mosaic")
    found = clsas.process(scene)
    assert found["mosaic"].numbers["formed"] == 4
    again = clsas.process(scene)
    assert again["mosaic"].numbers["formed"] == 0
    assert clsas.Store.opened(found["mosaic"].numbers["store"]).image().shape == (121, 161)


@pytest.fixture
def joining(scene):
    """A scene whose mosaic has been formed from the uncorrected recording."""
    pytest.importorskip("zarr")
    choose(scene, "mosaic")
    scene.write_text(scene.read_text() + "[mosaic]\npatches = [1, 2]\n")
    clsas.process(scene)
    return scene


def change_recording(scene):
    lines = clsas.load(scene.parent / "lines.h5")
    (scene.parent / "lines.h5").unlink()  # a hard link to the file that all tests share
    clsas.save(scene.parent / "lines.h5", replace(lines, samples=2 * lines.samples[::-1]))


def test_a_mosaic_of_another_recording_is_formed_anew(joining):
    """Like any other step whose inputs changed."""
    before = clsas.Store.opened(joining.with_suffix("") / "mosaic.zarr").read()
    change_recording(joining)
    found = clsas.process(joining)
    assert found["mosaic"].numbers["formed"] == 2
    after = clsas.Store.opened(found["mosaic"].numbers["store"]).read()
    assert np.abs(after - before).max() > 0.1 * np.abs(before).max()
    assert clsas.process(joining)["mosaic"].numbers["formed"] == 0
    assert not list(joining.with_suffix("").glob(".clsas-*"))


@pytest.mark.slow
def test_a_mosaic_of_other_options_is_formed_anew(joining):
    text = joining.read_text()
    for changed in ("tolerance_db = -30", "tolerance_db = -40"):
        joining.write_text(text.replace("tolerance_db = -40", changed))
        assert clsas.process(joining)["mosaic"].numbers["formed"] == 2
    joining.write_text(text.replace("[1, 2]", "[2, 2]"))
    assert clsas.process(joining)["mosaic"].numbers["formed"] == 4


def test_a_mosaic_is_the_steps_own_from_any_working_directory(joining, monkeypatch):
    """The path of the store was recorded from another working directory."""
    text = joining.read_text()
    monkeypatch.chdir(joining.parent)
    joining.write_text(text.replace("tolerance_db = -40", "tolerance_db = -30"))
    assert clsas.process(joining.name)["mosaic"].numbers["formed"] == 2


@pytest.mark.slow
def test_a_mosaic_that_the_step_did_not_make_is_not_replaced(joining, tmp_path):
    """Neither a store that existed before, nor one that took the place of the step's."""
    store = tmp_path / "elsewhere.zarr"
    lines = clsas.load(joining.parent / "lines.h5")
    other = replace(lines, samples=3 * lines.samples[::-1])
    grid = clsas.Grid.plane((1, 5, 161), (13, 15, 121))
    list(clsas.mosaic(other, grid, store, patches=(1, 1)))
    joining.write_text(joining.read_text() + f"store = '{store}'\n")
    for _ in range(2):
        with pytest.raises(ValueError, match=r"\(\[mosaic\]\): .* made with other inputs"):
            clsas.process(joining)
        assert clsas.Store.opened(store).records()
    store.rename(tmp_path / "kept.zarr")
    clsas.process(joining)
    change_recording(joining)
    assert clsas.process(joining)["mosaic"].numbers["formed"] == 2  # made by the step
    change_recording(joining)
    store.rename(tmp_path / "made.zarr")
    (tmp_path / "kept.zarr").rename(store)
    with pytest.raises(ValueError, match="was made with other inputs"):
        clsas.process(joining)
    assert clsas.Store.opened(store).records()


def test_a_refused_mosaic_leaves_the_old_one(joining):
    """A wrong request is refused before anything is removed."""
    before = clsas.Store.opened(joining.with_suffix("") / "mosaic.zarr").read()
    change_recording(joining)
    text = joining.read_text()
    joining.write_text(text.replace("patches = [1, 2]", "patches = [500, 2]"))
    with pytest.raises(ValueError, match="patches"):
        clsas.process(joining)
    after = clsas.Store.opened(joining.with_suffix("") / "mosaic.zarr").read()
    np.testing.assert_array_equal(after, before)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[process]\nsteps = ["images"]', "must be one of"),
        ("[process]\nsteps = []", "steps must name at least one"),
        ('[process]\nsteps = ["calibrate"]', "not include 'calibrate' without `points_m` in"),
        (
            SCENE.replace("lines.h5", "nowhere.h5"),
            r"\[process\] lines must be a file: .* does not exist",
        ),
        ('[process]\noutput = ""', "output must be a path"),
        ("[process]\nstep = 1", "unknown key 'step' in \\[process\\]"),
        ("[process.calibrate]\npoints_m = [[1.0, 2.0]]", "points_m"),
        ("[process.calibrate]\npoints_m = []", "points_m must have shape"),
        ("[process.navigate]\nside = 'left'", "side must be one of"),
        ("[process.navigate]\nrange_m = [5.0, 4.0]", "range_m must be"),
        ("[process.navigate]\nsway_sd_m = 0.0", "sway_sd_m must be"),
        ("[process.focus]\nunknowns = ['yaw']", "every entry of unknowns"),
    ],
)
def test_mistakes_in_the_table_are_named(tmp_path, text, message):
    path = tmp_path / "scene.toml"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        clsas.process(path)


def test_bad_arguments(scene, tmp_path):
    with pytest.raises(TypeError, match="scene must be a path"):
        clsas.process(1)
    with pytest.raises(TypeError, match="progress must be a function"):
        clsas.process(scene, progress=1)
    with pytest.raises(ValueError, match="every entry of steps"):
        clsas.process(scene, steps=("images",))
    with pytest.raises(FileNotFoundError):
        clsas.process(scene, lines=tmp_path / "nowhere.h5")
    empty = tmp_path / "empty.toml"
    empty.write_text("")
    with pytest.raises(ValueError, match="missing table \\[grid\\]"):
        clsas.process(empty)
    with pytest.raises(ValueError, match=r"\[process\] lines must be given"):
        clsas.process(empty, steps=("inspect",))
    with pytest.raises(ValueError, match="output must not be the folder of the recording"):
        clsas.process(scene, output=scene.parent)
    huge = tmp_path / "huge.toml"
    huge.write_text(SCENE.replace("count = 161", "count = 1000000000"))
    with pytest.raises(ValueError, match="\\[grid\\] must ask for at most"):
        clsas.process(huge)
    described = clsas.Grid.plane((0, 1, 2), (0, 1, 2))
    clsas.save(tmp_path / "grid.h5", described)
    output = tmp_path / "output"
    with pytest.raises(ValueError, match="must contain `RangeLines` or `Echoes`, got `Grid`"):
        clsas.process(scene, lines=tmp_path / "grid.h5", output=output)
    assert not output.exists()
    with pytest.raises(ValueError, match=r"existing folder, got .*: there is no .*no/such'"):
        clsas.process(scene, output=tmp_path / "no/such/folder")
    with pytest.raises(ValueError, match=r"output must be a folder, got the file '.*grid.h5'"):
        clsas.process(scene, output=tmp_path / "grid.h5")


@pytest.mark.slow
def test_two_runs_in_one_folder_are_refused(plain, tmp_path, monkeypatch):
    """Otherwise the second would continue from the first one's lines, recorded as its own."""
    other = clsas.load(plain.parent / "lines.h5").weighted(np.full(260, 2.0))
    image = STEPS["image"]
    messages = []

    def image_beside(job):
        monkeypatch.setitem(STEPS, "image", image)
        with pytest.raises(BlockingIOError, match="another process of clsas is at work") as caught:
            clsas.process(plain, lines=other)
        messages.append(CliRunner().invoke(main, ["process", str(plain)]).output)
        assert caught.value.filename == str(plain.with_suffix(""))
        return image.run(job)

    monkeypatch.setitem(STEPS, "image", replace(image, run=image_beside))
    folder = clsas.process(plain).folder
    assert messages == [f"Error: another process of clsas is at work in this folder: {folder}\n"]
    assert ".clsas.lock" not in contents(folder)
    assert clsas.process(plain).repeated == ()
    assert clsas.process(plain, lines=other).repeated == ("image",)


@pytest.mark.parametrize("is_there", [True, False])
def test_a_folder_that_another_first_run_removes_is_made_again(tmp_path, monkeypatch, is_there):
    """The other run created the folder, failed, and removed it before this one locked it."""
    folder, locks = tmp_path / "output", []
    if is_there:
        folder.mkdir()

    def locked_late(path):
        if not locks:
            path.rmdir()
        locks.append(path)
        return locked(path)

    monkeypatch.setattr(record_module, "locked", locked_late)
    with record_module.made(folder):
        assert (folder / ".clsas.lock").exists()
    assert locks == [folder, folder]
    assert not folder.exists()


def test_a_recording_that_changes_while_it_is_processed_is_refused(plain, tmp_path, monkeypatch):
    changing, lines = tmp_path / "changing.h5", clsas.load(plain.parent / "lines.h5")
    clsas.save(changing, lines)
    from clsas.processing import chain

    open_device = chain.open_device

    def open_late(device):
        clsas.save(changing, lines.weighted(np.full(260, 2.0)))
        return open_device(device)

    monkeypatch.setattr(chain, "open_device", open_late)
    with pytest.raises(ValueError, match=r"changing\.h5 has changed since its digest was recorded"):
        clsas.process(plain, lines=changing)
    assert not plain.with_suffix("").exists()


@pytest.mark.slow
def test_results_that_changed_since_are_not_returned(scene):
    choose(scene, "calibrate", "image")
    found = clsas.process(scene)
    lines, image = found.lines, clsas.load(found.folder / "image.h5")
    clsas.save(found.folder / "calibrate.h5", lines.weighted(np.full(260, 2.0)))
    clsas.save(found.folder / "image.h5", replace(image, pixels=2 * image.pixels))
    with pytest.raises(
        ValueError, match=r"calibrate\.h5 has changed since its digest was recorded"
    ):
        _ = found.lines
    with pytest.raises(ValueError, match=r"image\.h5 has changed since its digest was recorded"):
        _ = found.image


def test_a_processing_pickles(plain):
    found = pickle.loads(pickle.dumps(clsas.process(plain)))
    assert found["image"].files
    assert found.lines.channels == 260
    assert found.image.shape == (121, 161)


def test_names_in_a_foreign_record_reach_no_terminal(plain):
    bad = "\x1b[31mred\nError: gone"
    path = clsas.process(plain).folder / "process.json"
    record = json.loads(path.read_text())
    (step,) = record["steps"]
    step["files"][bad] = step["files"]["image.png"]
    (path.parent / bad).write_bytes((path.parent / "image.png").read_bytes())
    others = step, step | {"name": "focus", "inputs": "0"}
    record["steps"] = [with_digest(each) for each in others]
    path.write_text(json.dumps(record))
    printed = CliRunner().invoke(main, ["process", str(plain)]).output
    assert "unchanged" in printed
    assert "Warning: the results of focus" in printed
    assert printed.count(r"\x1b[31mred\nError: gone") == 2
    assert "\x1b" not in printed
    assert "\nError" not in printed


@pytest.mark.slow
def test_command(scene):
    arguments = ["process", str(scene)]
    for step in STEPS_HERE:
        arguments += ["--step", step]
    done = CliRunner().invoke(main, arguments)
    assert done.exit_code == 0, done.output
    assert "dB by the corrections" in done.output
    assert re.search(r"; time offset (200|19\d|20\d)\.?\d* ± [\d.]+ µs\n", done.output)
    done = CliRunner().invoke(main, [*arguments, "--json"])
    results = json.loads(done.output)
    assert results["repeated"] == []
    assert list(results["steps"]) == list(STEPS_HERE)
    assert CliRunner().invoke(main, ["process", str(scene), "--step", "x"]).exit_code == 2


@pytest.mark.slow
def test_the_command_refuses_a_grid_that_no_line_reaches(plain):
    plain.write_text(
        plain.read_text().replace(
            "start_m = 13.0, stop_m = 15.0", "start_m = 13000.0, stop_m = 15000.0"
        )
    )
    refused = CliRunner().invoke(main, ["process", str(plain)])
    assert refused.exit_code == 1
    assert "no pixel of the grid lies within any line's range" in refused.output
    assert not plain.with_suffix("").exists()
    allowed = CliRunner().invoke(main, ["process", str(plain), "--allow-unreached"])
    assert allowed.exit_code == 0, allowed.output
    assert not clsas.load(plain.with_suffix("") / "image.h5").pixels.any()


@pytest.mark.slow
def test_one_of_two_banks_is_imaged(plain):
    """The first one, or the one that the scene names; corrections keep the lines of both."""
    path = plain.parent / "lines.h5"
    lines = clsas.load(path)
    path.unlink()  # a link to the recording of all tests
    banks = np.tile([0, 1], lines.channels // 2)
    apart_m = np.multiply.outer(banks, [0.0, 0.0, 0.2])
    two = replace(lines, rx_m=lines.rx_m + apart_m, bank_numbers=banks)
    clsas.save(path, two)
    grid = clsas.files.scene_files.read_scene(plain).grid

    def imaged():
        clsas.process(plain)  # a warning of two banks in one image would be an error
        return clsas.load(plain.with_suffix("") / "image.h5").pixels

    def exact(number):
        return clsas.backproject(two.bank(number), grid, accuracy_db=-60)

    assert clsas.relative_error_db(imaged(), exact(0)) < -35
    plain.write_text(plain.read_text().replace("[process]\n", "[process]\nbank = 1\n"))
    assert clsas.relative_error_db(imaged(), exact(1)) < -35
    plain.write_text(plain.read_text().replace("bank = 1", "bank = 2"))
    with pytest.raises(ValueError, match=r"\[process\] bank must be one of 0, 1, got 2"):
        clsas.process(plain)
