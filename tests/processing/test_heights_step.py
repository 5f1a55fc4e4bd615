"""The step `heights` of a processing: heights from the corrected lines of two receiver banks."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from reliefs import flat_banks
from tiers import also

import clsas
from clsas.cli import main
from clsas.cli.processing import _in_words
from clsas.engine.data.validate import ClsasWarning
from clsas.files.scene_files import read_scene
from clsas.files.scene_tables import checked_steps
from clsas.mosaics.document import Document
from clsas.processing.record import StepRecord
from clsas.processing.steps import is_mosaic

pytest.importorskip("matplotlib")

POINTS_M = [0.0, 30.6, 0.0], [0.3, 33.4, 0.0]
SCENE = """
[grid]
x = { start_m = -0.5, stop_m = 0.5, count = 51 }
y = { start_m = 31.5, stop_m = 32.5, count = 51 }

[image]
tolerance_db = -40

[process]
lines = "lines.h5"
steps = ["image", "heights"]

[process.heights]
search_m = [-0.5, 0.5]
window_m = 0.2
"""
CALIBRATE = f"""
[process.calibrate]
points_m = {[*POINTS_M]}
unknowns = ["time_offset"]
search_m = 0.3

"""


def together(banks):
    """Return the lines of banks as one recording, ping by ping."""

    def joined(name):
        arrays = [getattr(lines, name) for lines in banks]
        return np.stack(arrays, axis=1).reshape(-1, *arrays[0].shape[1:])

    varying = ("samples", "tx_m", "rx_m", "first_range_m")
    numbers = np.tile(np.arange(len(banks)), banks[0].channels)
    return replace(banks[0], **{name: joined(name) for name in varying}, bank_numbers=numbers)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    path = tmp_path_factory.mktemp("banks") / "lines.h5"
    clsas.save(path, together(flat_banks()))
    return path


@pytest.fixture
def scene(recorded, tmp_path):
    (tmp_path / "lines.h5").symlink_to(recorded)
    path = tmp_path / "scene.toml"
    path.write_text(SCENE)
    return path


def change(scene, old, new):
    text = scene.read_text()
    assert old in text
    scene.write_text(text.replace(old, new))


@pytest.mark.slow
def test_heights_are_those_that_the_library_finds(scene):
    told = []
    found = clsas.process(scene, progress=lambda *each: told.append(each))
    assert found.repeated == ("image", "heights")
    assert {path.name for path in found.folder.iterdir()} == {
        "process.json", "image.h5", "image.png", "heights.h5", "heights.png"
    }  # fmt: skip
    grid = read_scene(scene).grid
    expected = clsas.heights(*flat_banks(), grid, search_m=(-0.5, 0.5), window_m=0.2)
    for name in ("height_m", "sd_m", "mask", "coherence"):
        np.testing.assert_array_equal(getattr(found.heights, name), getattr(expected, name))
    numbers, known = found["heights"].numbers, expected.mask
    assert numbers["valid"] == known.mean() > 0.9
    assert numbers["height_m"] == [np.nanmin(expected.height_m), np.nanmax(expected.height_m)]
    assert numbers["median_sd_m"] == np.median(expected.sd_m[known])
    assert numbers["ambiguity_m"] == pytest.approx(2.06, rel=0.03)
    done, total = [(done, total) for step, done, total in told if step == "heights"][-1]
    assert done == total
    printed = CliRunner().invoke(main, ["process", str(scene)]).output
    low_m, high_m = numbers["height_m"]
    assert (
        f"  heights, unchanged: heights.h5, heights.png; {100 * numbers['valid']:.3g} % of 2601 "
        f"pixels are valid, {low_m:.3f} to {high_m:.3f} m high, median deviation "
        f"{1e3 * numbers['median_sd_m']:.3g} mm\n"
    ) in printed


@pytest.mark.slow
def test_heights_are_measured_again_only_if_something_changed(scene):
    def repeated(**options):
        return clsas.process(scene, **options).repeated

    steps = "image", "heights"
    assert repeated() == steps
    assert repeated() == ()
    change(scene, "window_m = 0.2", "window_m = 0.25")
    assert repeated() == ("heights",)
    # Heights are of both banks, whichever is imaged and how accurately.
    change(scene, "[process]\n", "[process]\nbank = 1\n")
    change(scene, "tolerance_db = -40", "tolerance_db = -30")
    assert repeated() == ("image",)
    (scene.with_suffix("") / "heights.h5").unlink()
    assert repeated() == ("heights",)
    change(scene, "stop_m = 0.5, count = 51", "stop_m = 0.4, count = 46")
    message = "results of image in .* are out of date, since its lines or options have changed"
    with pytest.warns(ClsasWarning, match=message):
        assert repeated(steps=("heights",)) == ("heights",)
    louder = clsas.load(scene.parent / "lines.h5")
    louder = replace(louder, samples=2 * louder.samples)
    with pytest.warns(ClsasWarning, match=message):
        assert repeated(lines=louder, steps=("heights",)) == ("heights",)


@pytest.mark.exhaustive
def test_heights_are_of_the_corrected_lines(scene):
    """A range error of both banks displaces heights, until known points correct it."""
    marks = clsas.PointTargets(POINTS_M, np.full(len(POINTS_M), 8.0))
    late = together([late_with_marks(bank, marks, 0.06) for bank in flat_banks()])
    change(scene, '"image", "heights"', '"heights"')
    change(scene, "[process.heights]", CALIBRATE + "[process.heights]")
    uncorrected = clsas.process(scene, lines=late).heights
    # At 34.2 m of range from 12 m above the seabed, 6 cm are 2.1 cm of height.
    assert np.median(uncorrected.height_m[uncorrected.mask]) == pytest.approx(-0.021, abs=2e-3)
    change(scene, '"heights"', '"calibrate", "heights"')
    found = clsas.process(scene, lines=late)
    assert found.repeated == ("calibrate", "heights")
    assert found["heights"].corrections == ("calibrate",)
    assert abs(np.median(found.heights.height_m[found.heights.mask])) < 2e-3


def late_with_marks(bank, marks, late_m):
    """Return lines with the echoes of reflectors, all of them displaced in range."""
    echoes = clsas.simulate_lines(
        bank.tx_m, bank.rx_m, marks, carrier_hz=bank.carrier_hz, bandwidth_hz=30e3,
        window="hamming", first_range_m=bank.first_range_m[0], length=bank.length,
    )  # fmt: skip
    assert echoes.range_step_m == bank.range_step_m
    # Lines without a carrier keep their phase, so that the phase has to be displaced as well.
    turned = np.exp(-4j * np.pi * bank.carrier_hz / bank.sound_speed_m_s * late_m)
    samples = (turned * (bank.samples + echoes.samples)).astype(np.complex64)
    return replace(bank, samples=samples, first_range_m=bank.first_range_m + late_m)


@pytest.mark.exhaustive
def test_the_first_two_of_several_banks_are_used(scene):
    """Whatever their numbers."""
    low, high = flat_banks()
    silent = replace(high, rx_m=high.rx_m + [0, 0, 0.3], samples=0 * high.samples)
    three = together([low, high, silent])
    renumbered = replace(three, bank_numbers=np.array([1, 4, 6])[three.bank_numbers])
    change(scene, '"image", "heights"', '"heights"')
    with pytest.warns(ClsasWarning) as warned:
        found = clsas.process(scene, lines=renumbered).heights
    (message,) = [str(each.message) for each in warned]
    assert "heights are measured from banks 1 and 4; bank 6 is not used" in message
    expected = clsas.heights(low, high, read_scene(scene).grid, search_m=(-0.5, 0.5), window_m=0.2)
    np.testing.assert_array_equal(found.height_m, expected.height_m)


@pytest.mark.exhaustive
def test_without_a_valid_height_there_is_no_picture(scene):
    """Nor a span or a deviation: the banks contain noise alone."""
    random = np.random.default_rng(1)
    two = clsas.load(scene.parent / "lines.h5")
    noise = random.standard_normal((*two.samples.shape, 2)) @ [1, 1j]
    change(scene, '"image", "heights"', '"heights"')
    change(scene, "window_m = 0.2", "window_m = 0.4\nleast_coherence = 0.9")
    with pytest.warns(ClsasWarning, match="heights: only 0 % of the pixels are coherent"):
        found = clsas.process(scene, lines=replace(two, samples=noise.astype(np.complex64)))
    assert list(found["heights"].files) == ["heights.h5"]
    assert found["heights"].numbers["height_m"] is None
    assert found["heights"].numbers["median_sd_m"] is None
    assert json.loads((found.folder / "process.json").read_text())["steps"][0]["warnings"]


def test_one_bank_is_refused_before_any_step(scene):
    message = (
        r"scene.toml: heights \(\[process.heights\]\): lines must have at least 2 receiver "
        r"banks, got 1"
    )
    for lines in (flat_banks()[0], replace(flat_banks()[0], bank_numbers=np.zeros(120, int))):
        with pytest.raises(ValueError, match=message):
            clsas.process(scene, lines=lines)
        assert not scene.with_suffix("").exists()


@pytest.mark.slow
def test_one_bank_is_refused_instead_of_two(scene):
    """The results of the former recording are kept."""
    change(scene, '"image", "heights"', '"heights"')
    found = clsas.process(scene)
    with pytest.raises(ValueError, match="at least 2 receiver banks"):
        clsas.process(scene, lines=flat_banks()[0])
    assert found.heights.mask.any()


def test_heights_run_only_if_asked_for(scene):
    change(scene, 'steps = ["image", "heights"]\n', "")
    assert read_scene(scene).process["heights"] == {"search_m": (-0.5, 0.5), "window_m": 0.2}
    assert checked_steps(None, read_scene(scene).process) == ("inspect", "image", "heights")
    assert checked_steps(None, {}) == ("inspect", "image")
    change(scene, "[process]\n", '[process]\nsteps = ["image"]\n')
    found = clsas.process(scene)
    assert found.repeated == ("image",)
    with pytest.raises(KeyError):
        _ = found.heights


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("search_m = [-0.5, 0.5]\n", "", r"missing key 'search_m' in \[process.heights\]"),
        ("[-0.5, 0.5]", "[0.5, -0.5]", r"\[process.heights\] search_m must be two ascending"),
        ("[-0.5, 0.5]", "[0.5]", "search_m"),
        ("window_m = 0.2", "window_m = 0.0", r"\[process.heights\] window_m must be"),
        ("window_m = 0.2", "least_coherence = 1.0", r"\[process.heights\] least_coherence must be"),
        ("window_m = 0.2", "tolerance_db = -5.0", r"\[process.heights\] tolerance_db must be"),
        ("window_m = 0.2", "window = 0.2", r"unknown key 'window' in \[process.heights\]"),
        (SCENE[SCENE.index("[process.heights]") :], "", "not include 'heights' without `search_m`"),
        (SCENE[: SCENE.index("[image]")], "", r"missing table \[grid\]"),
    ],
)
def test_mistakes_are_named(scene, old, new, message):
    change(scene, old, new)
    with pytest.raises(ValueError, match=message):
        clsas.process(scene)
    assert not scene.with_suffix("").exists()


def test_a_vertical_grid_is_refused_before_any_step(scene):
    start = scene.read_text().index("[image]")
    grid = """[grid]
    origin_m = [-0.5, 32.0, -0.5]
    row_step_m = [0.0, 0.0, 0.02]
    column_step_m = [0.02, 0.0, 0.0]
    shape = [51, 51]
    """
    scene.write_text(grid + scene.read_text()[start:])
    with pytest.raises(ValueError, match=r"heights \(.*\): grid must be a plane.*a vertical one"):
        clsas.process(scene)
    assert not scene.with_suffix("").exists()


@pytest.mark.exhaustive
def test_the_search_starts_from_the_relief_of_the_scene(scene):
    relief = 0.3 + np.linspace(0, 0.1, 51)[:, None] + np.zeros(51)
    np.savetxt(scene.parent / "relief.csv", relief, delimiter=",")
    change(scene, "[grid]\n", '[grid]\nz_m = -0.3\nheight_file = "relief.csv"\n')
    change(scene, "search_m = [-0.5, 0.5]", "search_m = [-0.2, 0.2]")
    found = clsas.process(scene, steps=("heights",)).heights
    grid = read_scene(scene).grid
    expected = clsas.heights(*flat_banks(), grid, search_m=(-0.2, 0.2), window_m=0.2)
    np.testing.assert_array_equal(found.height_m, expected.height_m)
    assert np.nanmedian(found.height_m) == pytest.approx(0.3, abs=0.01)


@pytest.mark.parametrize("name", ["heights.h5", "heights.png"])
def test_files_of_others_are_never_replaced(scene, name):
    folder = scene.with_suffix("")
    folder.mkdir()
    (folder / name).write_text("mine")
    with pytest.raises(ValueError, match=f"not contain {name}, which heights would replace"):
        clsas.process(scene)
    assert (folder / name).read_text() == "mine"


@pytest.mark.exhaustive
def test_heights_larger_than_memory_are_a_mosaic(scene):
    """Its patches are continued, and it is replaced if options have changed."""
    change(scene, '"image", "heights"', '"heights"')
    change(scene, "window_m = 0.2", "window_m = 0.2\npatch_m = 0.6")
    found = clsas.process(scene)
    store = clsas.Store.opened(found.folder / "heights.zarr")
    assert len(store.records()) == 4
    assert {path.name for path in found.folder.iterdir()} == {
        "process.json", "heights.zarr", "heights.png"
    }  # fmt: skip
    grid = read_scene(scene).grid
    expected = clsas.heights(*flat_banks(), grid, search_m=(-0.5, 0.5), window_m=0.2)
    np.testing.assert_allclose(
        np.nanmedian(found.heights.height_m), np.nanmedian(expected.height_m), atol=1e-3
    )
    assert found["heights"].numbers["valid"] > 0.9
    before = {path: path.read_bytes() for path in store.path.rglob("*") if path.is_file()}
    assert clsas.process(scene).repeated == ("heights",)
    assert {path: path.read_bytes() for path in store.path.rglob("*") if path.is_file()} == before
    change(scene, "[-0.5, 0.5]", "[-0.4, 0.5]")
    clsas.process(scene)
    assert Document.read(store.path).inputs["search_m"] == [-0.4, 0.5]
    # A store elsewhere that somebody else made is not replaced.
    clsas.mosaic_heights(
        *flat_banks(), grid, scene.parent / "own.zarr", search_m=(-0.3, 0.3), window_m=0.2
    )
    change(scene, "patch_m = 0.6", 'store = "own.zarr"')
    with pytest.raises(ValueError, match=r"heights.*own.zarr was made with other inputs"):
        clsas.process(scene)


@pytest.mark.exhaustive
@pytest.mark.parametrize("patches", [False, *also(True)])
def test_errors_of_the_pair_are_corrected(scene, patches):
    """A phase of the second bank displaces heights, until a level seabed corrects it."""
    low, high = flat_banks()
    shifted = together([low, high.weighted(np.full(high.channels, np.exp(0.5j)))])
    change(scene, '"image", "heights"', '"heights"')
    if patches:
        change(scene, "window_m = 0.2", "window_m = 0.2\npatch_m = 0.6")
    displaced = clsas.process(scene, lines=shifted).heights
    assert abs(np.nanmedian(displaced.height_m)) > 0.1
    change(scene, 'steps = ["heights"]', 'steps = ["heights", "pair_errors"]')
    of_pair = '[process.pair_errors]\nknown_height_m = 0.0\nunknowns = ["phase"]\n\n'
    change(scene, "[process.heights]", of_pair + "[process.heights]")
    found = clsas.process(scene, lines=shifted)
    assert found.repeated == ("pair_errors", "heights")
    assert found["heights"].corrections == ("pair_errors",)
    numbers = found["pair_errors"].numbers
    assert numbers["unknowns"] == ["phase"]
    assert abs(numbers["values"][0] - 0.5) < 4 * numbers["sd"][0]
    assert abs(np.nanmedian(found.heights.height_m)) < 5e-3
    assert found.lines.banks == 2
    np.testing.assert_array_equal(found.lines.bank(0).samples, low.samples)
    names = {path.name for path in found.folder.iterdir()}
    assert names - {"heights.zarr", "heights.h5"} == {
        "process.json", "pair_errors.h5", "heights.png"
    }  # fmt: skip
    printed = CliRunner().invoke(main, ["process", str(scene)])
    assert printed.exit_code == 0, printed.output
    assert re.search(r"pair_errors\.h5; phase -?[\d.]+ ± [\d.]+ \w?rad\n", printed.output)


@pytest.mark.parametrize(
    ("name", "value", "sd", "expected"),
    [
        ("phase", -0.2207, 0.081, "phase -0.221 ± 0.081 rad"),
        ("delay", -3.486e-7, 2.1e-8, "delay -0.349 ± 0.021 µs"),
        ("delay", 3.486e-9, 2.1e-10, "delay 0.00349 ± 0.00021 µs"),
        ("roll", 2e-3, 2e-4, "roll 2.00 ± 0.20 mrad"),
    ],
)
def test_printed_errors_have_units(name, value, sd, expected):
    numbers = {"unknowns": [name], "values": [value], "sd": [sd]}
    step = StepRecord("pair_errors", "", numbers=numbers)
    assert _in_words(step) == f"; {expected}"


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("", "known_height_m must be given, or `points_m`, and only one, got neither"),
        ("known_height_m = 0.0\npoints_m = [[0, 32, 0]]", "got `known_height_m` and `points_m`"),
        ("known_height_m = 0.0\nknown_sd_m = -1", "known_sd_m must be"),
        ('known_height_m = 0.0\nunknowns = ["heave"]', "unknowns"),
        ("known_height_m = 1e300", r"\[process.pair_errors\] known_height_m must be finite and"),
        ("points_m = [[0, 32, 1e300]]", "points_m must be finite and <= 1e"),
        ("known_height_m = 0.0\nknown_sd_m = 1e300", "known_sd_m must be finite and"),
        ("points_m = [[0, 32]]", "points_m"),
        ("height = 0", "unknown key 'height'"),
    ],
)
def test_mistakes_of_pair_errors_are_named(scene, table, message):
    scene.write_text(scene.read_text() + f"\n[process.pair_errors]\n{table}\n")
    with pytest.raises(ValueError, match=message):
        clsas.process(scene)
    assert not scene.with_suffix("").exists()


def test_the_example_of_the_documentation_is_a_scene(scene):
    page = (Path(__file__).parents[2] / "docs" / "scene-files.md").read_text()
    _, example = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    scene.write_text(SCENE[: SCENE.index("[process]")] + example)
    described = read_scene(scene)
    assert checked_steps(None, described.process)[-2:] == ("image", "heights")
    assert described.process["steps"] == ("pair_errors", "heights")
    assert is_mosaic("heights", described)


def test_pair_errors_need_both_tables(scene):
    change(scene, '"image", "heights"', '"pair_errors"')
    with pytest.raises(ValueError, match=r"`known_height_m` or `points_m` in \[process.pair"):
        clsas.process(scene)
    change(
        scene,
        SCENE[SCENE.index("[process.heights]") :],
        "[process.pair_errors]\nknown_height_m = 0",
    )
    with pytest.raises(ValueError, match=r"without `search_m` in \[process.heights\]"):
        clsas.process(scene)
    change(scene, 'steps = ["pair_errors"]\n', "")  # its table alone asks for the step
    needed = r"scene.toml: \[process.heights\] must be given with `search_m` for \[process.pair_e"
    with pytest.raises(ValueError, match=needed) as raised:
        clsas.process(scene)
    assert "steps" not in str(raised.value)


@pytest.mark.parametrize(
    ("step", "required"),
    [
        ("calibrate", "points_m = [[0, 32, 0]]"),
        ("navigate", ""),
        ("focus", ""),
        ("pair_errors", "known_height_m = 0"),
    ],
)
@pytest.mark.parametrize("unknowns", ["", '"name", "name"'])
def test_no_and_repeated_unknowns_are_refused(step, required, unknowns, scene):
    first = {"calibrate": "time_offset", "pair_errors": "phase"}.get(step, "sway")
    chosen = unknowns.replace("name", first)
    scene.write_text(f"{SCENE}\n[process.{step}]\n{required}\nunknowns = [{chosen}]\n")
    with pytest.raises(ValueError, match=rf"\[process.{step}\] unknowns must be one or several of"):
        read_scene(scene)
