"""The command `clsas show`."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from cases import along_x, lines_over
from click.testing import CliRunner

import clsas
from clsas.cli import main
from clsas.engine.data.image import Formed
from clsas.mosaics.store_files import StoreFiles

pytest.importorskip("matplotlib")

PLANE = clsas.Grid.plane((-1, 1, 81), (20, 22, 41))
LINES = lines_over(PLANE, along_x(32, 0.05), carrier_hz=1e5, step_m=0.01)


def pixels(shape, peak):
    """Noise of amplitude 1e-3 with one bright pixel."""
    rng = np.random.default_rng(3)
    found = 1e-3 * np.exp(2j * np.pi * rng.random(shape))
    found[peak] = 1.0
    return found.astype(np.complex64)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """One file of every kind that can be drawn."""
    folder = tmp_path_factory.mktemp("files")
    z, y, x = np.meshgrid(np.linspace(0, 1, 5), np.linspace(3, 4, 6), np.arange(7), indexing="ij")
    box = clsas.Grid.points(np.stack([x, y, z], axis=-1))
    ring = np.linspace(0, 2 * np.pi, 90)
    points = clsas.Grid.points(np.stack([np.cos(ring), np.sin(ring), 0 * ring], axis=-1))
    clsas.save(folder / "image.h5", clsas.Image(pixels((41, 81), (10, 60)), PLANE))
    clsas.save(folder / "volume.h5", clsas.Image(pixels((5, 6, 7), (2, 3, 4)), box))
    clsas.save(folder / "points.h5", clsas.Image(pixels((90,), (7,)), points))
    clsas.save(folder / "lines.h5", LINES)
    clsas.save(folder / "grid.h5", PLANE)
    echoes = clsas.Echoes(
        LINES.samples, np.linspace(0.026, 0.027, 32), 1e5, 1e5, LINES.tx_m, LINES.rx_m, 1500.0
    )
    clsas.save(folder / "echoes.h5", echoes)
    plan = clsas.plan(LINES, PLANE, tolerance_db=-40)
    (folder / "plan.json").write_text(plan.to_json())
    (folder / "short.json").write_text(plan.to_json(filters=False))
    (folder / "scene.toml").write_text("")
    (folder / "text.h5").write_text("no HDF5")
    return folder


@pytest.fixture
def folder(files, tmp_path, monkeypatch):
    """A folder with links to all files."""
    for file in files.iterdir():
        (tmp_path / file.name).symlink_to(file)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(*args, code=0):
    result = CliRunner().invoke(main, ["show", *map(str, args)], prog_name="clsas")
    assert result.exit_code == code, result.output
    return result.stdout if code == 0 else result.stderr


def labels(figure):
    axes = figure.axes[0]
    return axes.get_xlabel(), axes.get_ylabel()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "kind", "axes", "bar"),
    [
        ("image.h5", "Image", ("Along-track (m)", "Across-track (m)"), "dB re max"),
        ("points.h5", "Image", ("Along-track (m)", "Across-track (m)"), "dB re max"),
        ("volume.h5", "Image", ("", "Across-track (m)"), "dB re max"),
        ("lines.h5", "RangeLines", ("Channel", "Range (m)"), "dB re max"),
        ("echoes.h5", "Echoes", ("Channel", "Time after transmission (ms)"), "dB re max"),
        ("plan.json", "Plan", ("Predicted time (ms)", ""), None),
    ],
)
def test_every_kind_is_drawn_beside_its_file(folder, figures, name, kind, axes, bar):
    result = json.loads(run(name, "--json"))
    picture = Path(name).with_suffix(".png")
    assert result == {"file": name, "picture": str(picture), "kind": kind}
    assert picture.read_bytes().startswith(b"\x89PNG")
    (figure,) = figures
    assert labels(figure) == axes
    names = [each.get_ylabel() for each in figure.axes]
    assert any(bar in text for text in names) if bar else not any("dB" in text for text in names)


@pytest.mark.slow
def test_a_recording_of_another_kind_is_drawn(folder, figures):
    pytest.importorskip("sarkit")
    clsas.save("lines.cphd", LINES)
    assert run("lines.cphd", "-o", "a.pdf").startswith("a.pdf: RangeLines(32 channels")
    assert Path("a.pdf").read_bytes().startswith(b"%PDF")
    assert labels(figures[0]) == ("Channel", "Range (m)")


def test_axes_are_in_metres_and_equal_lengths_look_equal(folder, figures):
    run("image.h5")
    axes = figures[0].axes[0]
    (drawn,) = axes.get_images()
    np.testing.assert_allclose(drawn.get_extent(), (-1.0125, 1.0125, 19.975, 22.025))
    assert axes.get_aspect() == 1.0
    assert drawn.get_clim() == (-60, 0)
    level = drawn.get_array()
    assert np.unravel_index(level.argmax(), level.shape) == (10, 60)
    assert level.max() == 0


@pytest.mark.slow
def test_levels_and_colours(folder, figures):
    run("image.h5", "--db", 30, "--percentile", 50, "--colours", "sonar")
    run("lines.h5", "--dynamic-range-db", 40, "--percentile", 90, "--colour-map", "gray")
    image, lines = (figure.axes[0].get_images()[0] for figure in figures)
    assert (image.get_clim(), image.get_cmap().name) == ((-30, 0), "sonar")
    assert (lines.get_clim(), lines.get_cmap().name) == ((-40, 0), "gray")
    # All pixels but one have the median's amplitude, 60 dB below it.
    assert np.median(np.asarray(image.get_array())) == pytest.approx(0, abs=0.01)
    assert image.get_array().max() == pytest.approx(60, abs=0.01)
    amplitude = np.abs(LINES.samples)
    reference = np.percentile(amplitude[amplitude > 0], 90)
    assert lines.get_array().max() == pytest.approx(
        20 * np.log10(amplitude.max() / reference), abs=0.01
    )
    assert figures[0].axes[0].get_title() == "image.h5 (0 dB: percentile 50)"
    assert "dB re 0.001" in figures[0].axes[1].get_ylabel()


def test_an_image_of_zeros_is_drawn_at_every_percentile(folder):
    clsas.save("zero.h5", clsas.Image(np.zeros(PLANE.shape, np.complex64), PLANE))
    run("zero.h5", "--percentile", 99)
    assert Path("zero.png").exists()


def test_how_an_image_was_formed_is_printed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    formed = Formed("exact", -40, "4 \x1b taps", -41.2, None, (), "GPU", "1", "a")
    clsas.save("image.h5", clsas.Image(pixels((41, 81), (10, 60)), PLANE, formed))
    printed = run("image.h5", "--near", "0.5,20.5")
    assert "\n  exact, tolerance -40 dB, predicted error -41.2 dB" in printed
    assert "\x1b" not in printed
    assert json.loads(run("image.h5", "--json"))["formed"] == formed.describe()


@pytest.mark.slow
def test_the_part_around_a_position(folder, figures):
    run("image.h5", "--near", "0.5,20.5", "--extent-m", 0.2)
    run("image.h5", "--near", "0.5,20.5,0", "--extent-m", 0.2)
    run("image.h5", "--near", "-1,22")
    extents = [figure.axes[0].get_images()[0].get_extent() for figure in figures]
    np.testing.assert_allclose(extents[0], (0.2875, 0.7125, 20.275, 20.725))
    np.testing.assert_allclose(extents[1], extents[0])
    np.testing.assert_allclose(extents[2], (-1.0125, 0.6125, 20.375, 22.025))  # 32 pixels of 5 cm


def test_slices_of_a_volume_through_a_position(folder, figures):
    run("volume.h5", "--near", "4,3.6,0.5")
    titles = [axes.get_title() for axes in figures[0].axes]
    assert titles[:3] == ["z = 0.5 m", "x = 4 m", "y = 3.6 m"]


def test_the_causes_of_a_plans_error_are_drawn(folder, figures):
    run("plan.json")
    times, errors = figures[0].axes
    plan = clsas.Plan.from_json(Path("plan.json").read_text())
    assert sum(bar.get_width() for bar in times.patches) == pytest.approx(
        1e3 * plan.predicted_seconds, rel=0.01
    )
    ends = [bar.get_x() + bar.get_width() for bar in errors.patches]
    power = sum(10 ** (end / 10) for end in ends)
    assert 10 * np.log10(power) == pytest.approx(plan.errors.total_db, abs=0.2)
    assert "Plan: tolerance -40 dB" in figures[0].get_suptitle()


@pytest.mark.slow
def test_stages_of_a_plan_are_drawn(tmp_path, monkeypatch, figures):
    monkeypatch.chdir(tmp_path)
    plan = clsas.plan(LINES, PLANE, stages=[(2, 2), (2, 2)])
    Path("plan.json").write_text(plan.to_json())
    run("plan.json")
    names = [text.get_text() for text in figures[0].axes[0].get_yticklabels()]
    assert [name.split(":")[0] for name in names[:3]] == ["stage 1", "stage 2", "leaves"]


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    pytest.importorskip("zarr")
    path = tmp_path_factory.mktemp("mosaic") / "image.zarr"
    for _ in clsas.mosaic(LINES, PLANE, path, tolerance_db=-40, patches=(3, 4)):
        pass
    return path


@pytest.mark.slow
def test_a_mosaic_and_a_part_of_it(store, figures):
    assert run(store, "--json")
    assert store.with_name("image.png").read_bytes().startswith(b"\x89PNG")
    run(store, "-o", store.with_name("part.svg"), "--near", "0.5,20.5", "--extent-m", 0.2)
    part = clsas.Store.opened(store).image(slice(6, 15), slice(52, 69))
    drawn = figures[1].axes[0].get_images()[0]
    np.testing.assert_allclose(drawn.get_extent(), (0.2875, 0.7125, 20.275, 20.725))
    np.testing.assert_allclose(drawn.get_array(), np.maximum(part.db(), -60), atol=1e-4)
    assert "must not lie in the store" in run(store, "-o", store / "a.png", code=2)


@pytest.mark.slow
def test_a_mosaic_is_read_patch_by_patch(store, monkeypatch):
    """So one larger than memory is drawn as well."""
    read, sizes = StoreFiles.read, []

    def recorded(self, *window):
        found = read(self, *window)
        sizes.append(found.size)
        return found

    monkeypatch.setattr(StoreFiles, "read", recorded)
    run(store)
    assert sum(sizes) == PLANE.size
    assert max(sizes) <= 14 * 21  # pixels of a patch


@pytest.mark.parametrize(
    ("args", "code", "message"),
    [
        (["none.h5"], 2, "'none.h5' does not exist"),
        (["image.h5", "-o", "a.tif"], 2, "must end in .png or .pdf or .svg"),
        (["image.h5", "-o", "none/a.png"], 2, "there is no folder 'none'"),
        (["image.h5", "--db", "0"], 2, "'--db': must be finite and > 0 and <="),
        (["image.h5", "--db", "nan"], 2, "'--db': must be finite"),
        (["image.h5", "--percentile", "0"], 2, "'--percentile': must be finite and > 0 and <= 100"),
        (["image.h5", "--percentile", "101"], 2, "got 101"),
        (["image.h5", "--colours", "rainbows"], 2, "--colour-map must be 'sonar' or one of"),
        (["image.h5", "--near", "1"], 2, "must be X,Y or X,Y,Z in metres"),
        (["image.h5", "--near", "9,20"], 1, "near must be inside the image, x from -1 to 1 m"),
        (
            ["image.h5", "--near", "0,21", "--extent-m", "-1"],
            2,
            "'--extent-m': must be finite and > 0",
        ),
        (["image.h5", "--extent-m", "1"], 2, "--extent-m requires --near"),
        (["lines.h5", "--near", "0,21"], 2, "--near cannot be used with range lines or echoes"),
        (["points.h5", "--near", "0,1"], 2, "--near cannot be used with an image on points"),
        (["volume.h5", "--near", "0,9,0"], 1, "at must lie in the volume"),
        (["volume.h5", "--near", "4,3.6,0", "--extent-m", "1"], 2, "--extent-m cannot be used"),
        (["plan.json", "--db", "30"], 2, "--dynamic-range-db cannot be used with a plan"),
        (["short.json"], 1, "must be a plan of `clsas plan --json --filters`: it lacks 'digest'"),
        (["scene.toml"], 1, "scene.toml is a scene"),
        (["grid.h5"], 1, "must hold an image, range lines or echoes, got only a grid"),
        (["text.h5"], 1, "text.h5 is of none of the formats that clsas reads"),
        (["."], 1, "is not a mosaic of clsas"),
    ],
)
def test_what_cannot_be_drawn_is_one_message(folder, args, code, message):
    if args == ["."]:
        pytest.importorskip("zarr")
    before = set(folder.iterdir())
    stderr = run(*args, code=code)
    assert message in " ".join(stderr.split())
    assert len(re.findall("^Error: ", stderr, re.MULTILINE)) == 1
    assert set(folder.iterdir()) == before


def test_a_name_with_dollar_signs_is_drawn_as_it_is(folder, figures):
    Path("a$b_$.h5").symlink_to("image.h5")
    run("a$b_$.h5")
    assert figures[0].axes[0].get_title() == r"a\$b_\$.h5"


def test_without_matplotlib_nothing_is_read(folder, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert "pip install 'matplotlib>=3.10'" in run("image.h5", code=1)
