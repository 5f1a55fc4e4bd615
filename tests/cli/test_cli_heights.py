import json
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from reliefs import flat_banks

import clsas
from clsas import cli

GRID = "--x", "-0.5:0.5:51", "--y", "31.5:32.5:51"


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("banks")
    paths = [folder / name for name in ("low.h5", "high.h5")]
    for path, lines in zip(paths, flat_banks(), strict=True):
        clsas.save(path, lines)
    return paths


def run(*args, code=0):
    result = CliRunner().invoke(cli.main, [str(arg) for arg in args], prog_name="clsas")
    assert result.exit_code == code, (result.output, result.exception)
    return result


@pytest.mark.slow
def test_command_saves_what_the_library_finds(files, tmp_path):
    output = tmp_path / "heights.h5"
    given = (*files, *GRID, "--search-m", "-0.5:0.5", "--window-m", 0.2, "-o", output)
    results = json.loads(run("heights", *given, "--json").stdout)
    found = clsas.load(output)
    grid = clsas.Grid.plane((-0.5, 0.5, 51), (31.5, 32.5, 51))
    expected = clsas.heights(*flat_banks(), grid, search_m=(-0.5, 0.5), window_m=0.2)
    assert np.array_equal(found.height_m, expected.height_m, equal_nan=True)
    assert results["valid"] == found.mask.mean() > 0.9
    assert results["ambiguity_m"] == pytest.approx(2.06, rel=0.03)
    assert results["height_m"] == [np.nanmin(found.height_m), np.nanmax(found.height_m)]
    text = run("heights", *given).stdout
    assert "of 2601 pixels are valid" in text
    assert "median deviation" in text
    assert "height of ambiguity 2.0" in text


@pytest.mark.exhaustive
def test_the_search_may_start_from_a_relief(files, tmp_path):
    output, relief = tmp_path / "heights.h5", tmp_path / "relief.npy"
    heights_m = np.full((51, 51), 0.3) + np.linspace(0, 0.1, 51)
    np.save(relief, heights_m)
    below = (*GRID, "--z", -0.3)
    given = *files, "--search-m", "-0.3:0.3", "--window-m", 0.2, "-o", output
    run("heights", *given, *below, "--relief", relief)
    found = clsas.load(output)
    plane = clsas.Grid.plane((-0.5, 0.5, 51), (31.5, 32.5, 51), z=-0.3)
    start = plane.with_height(heights_m)
    expected = clsas.heights(*flat_banks(), start, search_m=(-0.3, 0.3), window_m=0.2)
    assert np.array_equal(found.height_m, expected.height_m, equal_nan=True)
    assert np.nanmedian(found.height_m) == pytest.approx(0.3, abs=0.01)

    np.save(relief, heights_m[1:])
    wrong = run("heights", *given, *below, "--relief", relief, code=1)
    assert "--relief must hold 51 x 51 heights" in wrong.stderr
    np.save(relief, heights_m)
    scene = tmp_path / "scene.toml"
    scene.write_text(
        "[grid]\nx = { start_m = -0.5, stop_m = 0.5, count = 51 }\n"
        "y = { start_m = 31.5, stop_m = 32.5, count = 51 }\n"
        'z_m = -0.3\nheight_file = "relief.npy"\n'
    )
    run("heights", *given, "--scene", scene)
    assert np.array_equal(clsas.load(output).height_m, found.height_m, equal_nan=True)
    twice = run("heights", *given, "--scene", scene, "--relief", relief, code=2)
    assert "the grid of the scene has heights" in twice.stderr


@pytest.mark.slow
def test_a_store_is_measured_drawn_and_exported(files, tmp_path):
    pytest.importorskip("zarr")
    rasterio = pytest.importorskip("rasterio")
    output = tmp_path / "heights.zarr"
    given = *files, *GRID, "--search-m", "-0.5:0.5", "--window-m", 0.2
    mosaic = *given, "-o", output, "--patch-m", 0.6
    results = json.loads(run("heights", *mosaic, "--json").stdout)
    assert results["patches"] == [2, 2]
    assert results["patch_shape"] == [26, 26]
    store = clsas.Store.opened(output)
    found = store.heights()
    assert results["valid"] == found.mask.mean() > 0.9
    text = run("heights", *mosaic).stdout
    assert "2 x 2 patches of 26 x 26 pixels" in text
    assert "% of 2601 pixels are valid" in text

    run("show", output, "-o", tmp_path / "part.png", "--near", "0,32", "--extent-m", 0.4)
    assert (tmp_path / "part.png").stat().st_size > 10_000
    refused = run("show", output, "--db", 40, code=2)
    assert "cannot be used with a mosaic of heights" in refused.stderr

    place = "--origin", "60.39,5.32", "--heading-deg", 0
    run("export", output, tmp_path / "heights.tif", *place)
    clsas.save(tmp_path / "heights.h5", found)
    run("export", tmp_path / "heights.h5", tmp_path / "single.tif", *place)
    with (
        rasterio.open(tmp_path / "heights.tif") as one,
        rasterio.open(tmp_path / "single.tif") as other,
    ):
        assert (
            one.descriptions
            == other.descriptions
            == (
                "Height (m)",
                "Standard deviation (m)",
                "Coherence",
            )
        )
        assert np.array_equal(one.read(), other.read(), equal_nan=True)
        assert one.tags()["WINDOW_M"] == "0.2"
    run("export", output, tmp_path / "heights.nc", *place)
    run("export", output, tmp_path / "heights.png")
    refused = run("export", output, tmp_path / "heights.nitf", code=1)
    assert "for heights, got" in refused.stderr

    alone = run("heights", *given, "-o", tmp_path / "heights.h5", "--patch-m", 1, code=2)
    assert "--patch-m requires an output that ends in .zarr" in alone.stderr


def test_mistakes_are_reported(files, tmp_path):
    output = "-o", tmp_path / "heights.h5"
    crossed = run("heights", *files, *GRID, "--search-m", "1:-1", *output, code=2)
    assert "must be two ascending numbers in m" in crossed.stderr
    alone = run("heights", files[0], files[0], *GRID, "--search-m", "-1:1", *output, code=1)
    assert "apart across the line of sight" in alone.stderr
    assert not (tmp_path / "heights.h5").exists()


@pytest.mark.exhaustive
def test_one_file_may_hold_both_banks(tmp_path):
    low, high = flat_banks()
    both = replace(
        low,
        samples=np.concatenate([low.samples, high.samples]),
        **{
            name: np.concatenate([getattr(low, name), getattr(high, name)])
            for name in ("first_range_m", "tx_m", "rx_m")
        },
        bank_numbers=np.repeat([0, 1], low.channels),
    )
    clsas.save(tmp_path / "lines.h5", both)
    clsas.save(tmp_path / "low.h5", low)
    output = tmp_path / "heights.h5"
    given = (*GRID, "--search-m", "-0.5:0.5", "-o", output)
    run("heights", tmp_path / "lines.h5", *given)
    found = clsas.load(output)
    assert np.nanmedian(np.abs(found.height_m)) < 3 * np.nanmedian(found.sd_m)
    # Lines of two banks out of more keep their numbers.
    clsas.save(tmp_path / "upper.h5", replace(both, bank_numbers=both.bank_numbers + 1))
    run("heights", tmp_path / "upper.h5", *given)
    assert np.array_equal(clsas.load(output).height_m, found.height_m, equal_nan=True)
    alone = run("heights", tmp_path / "low.h5", *given, code=1)
    assert "low.h5 must have at least 2 receiver banks, got 1: give" in alone.stderr
    # Of three banks, the first two are taken, as by clsas process.
    three = replace(
        both,
        samples=np.concatenate([both.samples, 0 * low.samples]),
        **{
            name: np.concatenate([getattr(both, name), getattr(low, name)])
            for name in ("first_range_m", "tx_m", "rx_m")
        },
        bank_numbers=np.repeat([0, 1, 2], low.channels),
    )
    clsas.save(tmp_path / "three.h5", three)
    warned = run("heights", tmp_path / "three.h5", *given)
    assert warned.stderr == (
        "Warning: heights are measured from banks 0 and 1; bank 2 is not used. To choose others, "
        "give lines of one bank each: clsas convert --bank n\n"
    )
    assert np.array_equal(clsas.load(output).height_m, found.height_m, equal_nan=True)


@pytest.mark.exhaustive
def test_heights_and_interferograms_are_drawn(files, tmp_path):
    grid = clsas.Grid.plane((-0.5, 0.5, 51), (31.5, 32.5, 51))
    images = [clsas.backproject(lines, grid) for lines in flat_banks()]
    for name, found in {
        "heights": clsas.heights(*flat_banks(), grid, search_m=(-0.5, 0.5)),
        "fringes": clsas.interferogram(*images, window_m=0.2),
    }.items():
        clsas.save(tmp_path / f"{name}.h5", found)
        run("show", tmp_path / f"{name}.h5")
        assert (tmp_path / f"{name}.png").stat().st_size > 10_000
        refused = run("show", tmp_path / f"{name}.h5", "--db", 40, code=2)
        assert "cannot be used with" in refused.stderr
