import json

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


def test_mistakes_are_reported(files, tmp_path):
    output = "-o", tmp_path / "heights.h5"
    crossed = run("heights", *files, *GRID, "--search-m", "1:-1", *output, code=2)
    assert "LOW:HIGH, two ascending heights in metres" in crossed.stderr
    alone = run("heights", files[0], files[0], *GRID, "--search-m", "-1:1", *output, code=1)
    assert "apart across the line of sight" in alone.stderr
    assert not (tmp_path / "heights.h5").exists()
    shown = tmp_path / "plane.h5"
    clsas.save(shown, clsas.heights(
        *flat_banks(), clsas.Grid.plane((-0.5, 0.5, 51), (31.5, 32.5, 51)), search_m=(-0.5, 0.5)
    ))  # fmt: skip
    refused = run("show", shown, "-o", tmp_path / "a.png", code=1)
    assert "got only a Heights" in refused.stderr
