"""The command `clsas export`."""

import json
import os
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from placed import UTM_NORTH, local, scene
from stores import LINES, PLANE

import clsas
from clsas.cli import main
from clsas.maps.exporting import SUFFIXES

rasterio = pytest.importorskip("rasterio")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with an image that has a place, and one that has none."""
    image, _ = scene(local(217.0))
    clsas.save(tmp_path / "image.h5", image)
    nowhere = clsas.Image(image.pixels, replace(image.grid, georeference=None))
    clsas.save(tmp_path / "nowhere.h5", nowhere)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(*arguments):
    done = CliRunner().invoke(main, ["export", *map(str, arguments)], catch_exceptions=False)
    return done.exit_code, done.output


def test_an_image_becomes_a_map(folder):
    code, output = run("image.h5", "a.tif", "--as", "8bit", "--db", 40, "--north-up", "--json")
    assert code == 0
    said = json.loads(output)
    assert said["file"] == "a.tif"
    assert said["bytes"] == (folder / "a.tif").stat().st_size
    with rasterio.open(folder / "a.tif") as file:
        assert file.dtypes == ("uint8",)
        assert file.transform.b == 0
        assert file.scales[0] == pytest.approx(40 / 254)
    code, output = run("image.h5", "a.nc")
    assert (code, output[:6]) == (0, "a.nc: ")


def test_a_folder_is_a_viewer(folder):
    place = ("--origin", "60.39,5.32,-12", "--heading-deg", 217)
    code, output = run("nowhere.h5", "web/", *place, "--db", 40, "--json")
    assert code == 0
    said = json.loads(output)
    assert said["file"] == "web"
    assert said["bytes"] > 1000
    assert '"latitude"' in (folder / "web" / "scene.js").read_text()
    assert '"names": ["nowhere.h5"]' in (folder / "web" / "scene.js").read_text()
    code, output = run("image.h5", "web", "--as", "8bit")
    assert (code, "--as must be left out" in output) == (1, True)


def test_options_place_an_image(folder):
    for options, place in (
        (("--origin", "60.39,5.32,-12", "--heading-deg", 217), local(217.0)),
        (("--crs", "EPSG:32632"), UTM_NORTH),
    ):
        assert run("nowhere.h5", "a.tif", *options)[0] == 0
        with rasterio.open(folder / "a.tif") as file:
            expected = rasterio.crs.CRS.from_wkt(place.wkt())
            assert file.crs == expected
    clsas.save("lines.h5", LINES)
    plan = clsas.plan(LINES, PLANE, tolerance_db=-40)
    (folder / "plan.json").write_text(plan.to_json())
    assert run("image.h5", "a.tif", "--plan", "plan.json", "--lines", "lines.h5")[0] == 0
    with rasterio.open(folder / "a.tif") as file:
        assert float(file.tags()["TOLERANCE_DB"]) == -40
        assert float(file.tags()["CARRIER_HZ"]) == LINES.carrier_hz


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("nowhere.h5", "a.tif"), 1, "INPUT must have a georeference for a GeoTIFF"),
        (("nowhere.h5", "a.tif", "--origin", "60,5"), 2, "must be given together"),
        (("nowhere.h5", "a.tif", "--origin", "x"), 2, "LATITUDE,LONGITUDE in degrees"),
        (("nowhere.h5", "a.tif", "--crs", "EPSG:1", "--origin", "60,5"), 2, "--crs excludes"),
        (("nowhere.h5", "a.tif", "--crs", "EPSG:99999"), 1, "crs must be one that PROJ knows"),
        (
            ("nowhere.h5", "a.tif", "--origin", "151.2,-33.9", "--heading-deg", 0), 1,
            "are probably swapped",
        ),
        (("image.h5", "a.tif", "--crs", "EPSG:32632"), 1,
         "--crs (or --origin) must be left out"),
        (("image.h5", "a.bmp"), 2, f"must end in {' or '.join(SUFFIXES)}"),
        (("image.h5", "a.nc", "--as", "db"), 1, "--as must be left out"),
        (("image.h5", "a.tif", "--plan", "image.h5"), 1, "image.h5 must be a plan of"),
        (("image.h5", "a.tif", "--plan", "bad.json"), 1, "bad.json must be a plan of"),
        (("image.h5", ".tif"), 2, "its name must not begin or end with a dot"),
        (("image.h5", "bad."), 2, "its name must not begin or end with a dot"),
        (("image.h5", "image.h5"), 2, "must be two files"),
        (("none.h5", "a.tif"), 2, "does not exist"),
    ],
)  # fmt: skip
def test_mistakes_are_one_message(folder, arguments, code, message):
    (folder / "bad.json").write_text('{"plan": ')
    found, output = run(*arguments)
    assert (found, message in output) == (code, True), output
    assert not {"a.tif", ".tif", "bad."} & set(os.listdir(folder))


def test_images_keep_the_place_of_a_scene(folder):
    """From the scene file over the command line to the map."""
    (folder / "scene.toml").write_text(
        "[georeference]\nlatitude_deg = 60.39\nlongitude_deg = 5.32\nheading_deg = 217.0\n"
        "[grid]\nx = { start_m = -1.0, stop_m = 1.0, count = 11 }\n"
        "y = { start_m = 30.0, stop_m = 31.0, count = 6 }\n"
    )
    clsas.save("lines.h5", LINES)
    for options in ((), ("--x", "-1:1:11", "--y", "30:31:6")):
        arguments = ["image", "lines.h5", "--scene", "scene.toml", "-o", "new.h5", *options]
        done = CliRunner().invoke(main, [*arguments, "--exact"], catch_exceptions=False)
        assert done.exit_code == 0, done.output
        image = clsas.load("new.h5")
        assert image.georeference == clsas.Georeference.local(60.39, 5.32, heading_deg=217)
        assert np.abs(image.pixels).max() > 0


def test_the_error_of_a_turned_complex_image_states_the_grid_to_form_it_on(folder):
    place = local(217.0)
    lines, grid = replace(LINES, georeference=place), replace(PLANE, georeference=place)
    clsas.save("lines.h5", lines)
    clsas.save("turned.h5", clsas.backproject(lines, grid))
    code, output = run("turned.h5", "a.tif", "--as", "complex", "--north-up")
    assert (code, "--as must not be complex with --north-up" in output) == (1, True), output
    assert "form the image on a north-up grid with clsas image --scene" in output
    (folder / "scene.toml").write_text(output[output.index("[grid]") :])
    arguments = ["image", "lines.h5", "--scene", "scene.toml", "-o", "new.h5", "--exact"]
    done = CliRunner().invoke(main, arguments, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    image = clsas.load("new.h5")
    expected_m = place.north_up(grid).positions_m()
    np.testing.assert_array_equal(image.grid.positions_m(), expected_m)
    for options in ((), ("--north-up",)):  # it lies so already
        assert run("new.h5", "a.tif", "--as", "complex", *options)[0] == 0
        with rasterio.open("a.tif") as file:
            assert file.transform.b == file.transform.d == 0
            np.testing.assert_array_equal(file.read(1)[::-1], image.pixels)


def test_show_draws_the_marks_of_a_map(folder, figures):
    command = ["show", "image.h5", "--north-arrow", "--scale-bar"]
    assert CliRunner().invoke(main, command, catch_exceptions=False).exit_code == 0
    (figure,) = figures
    assert [text.get_text() for text in figure.axes[0].texts] == ["N", "10 m"]
    clsas.save("lines.h5", LINES)
    done = CliRunner().invoke(main, ["show", "lines.h5", "--scale-bar"])
    assert done.exit_code == 2
    assert "--scale-bar cannot be used with range lines" in done.output


@pytest.mark.slow
def test_a_radar_image_becomes_sicd_by_its_lines_and_its_beam(folder):
    pytest.importorskip("sarkit", reason="sarkit (extra radar) is not installed")
    import sarkit.sicd

    place, light_m_s = local(217.0), 299_792_458.0
    grid = clsas.Grid.plane((-1, 1, 11), (997, 1003, 7), georeference=place)
    clsas.save("radar.h5", clsas.Image(np.ones(grid.shape, complex), grid))
    track_m = np.stack([np.linspace(-20, 20, 41), np.zeros(41), np.full(41, 500.0)], axis=1)
    samples = np.tile(np.sinc(np.arange(-200, 200) / 2), (41, 1)).astype(complex)
    lines = clsas.RangeLines(samples, 1000.0, 1.0, track_m, track_m, 9.6e9, light_m_s)
    clsas.save("radar-lines.h5", lines)
    (folder / "scene.toml").write_text("[image]\nbeam = {width_deg = 1.0}\n")
    assert run("radar.h5", "a.nitf", "--lines", "radar-lines.h5")[0] == 0
    assert run("radar.h5", "b.nitf", "--lines", "radar-lines.h5", "--scene", "scene.toml")[0] == 0
    bandwidths = []
    for name in ("a.nitf", "b.nitf"):
        with (folder / name).open("rb") as file, sarkit.sicd.NitfReader(file) as reader:
            root = sarkit.sicd.ElementWrapper(reader.metadata.xmltree.getroot())
            bandwidths.append(root["Grid"]["Col"]["ImpRespBW"])
    assert bandwidths[1] < 0.6 * bandwidths[0]
    code, output = run("radar.h5", "c.nitf")
    assert (code, "--lines must be given for SICD" in output) == (1, True)
    code, output = run("radar.h5", "c.tif", "--scene", "scene.toml")
    assert (code, "--scene must be left out, since it has no effect on .tif" in output) == (1, True)
    (folder / "scene.toml").write_text("")
    code, output = run("radar.h5", "c.nitf", "--lines", "radar-lines.h5", "--scene", "scene.toml")
    assert (code, "--scene scene.toml must have a beam" in output) == (2, True)
