import json
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from reliefs import flat_banks

import clsas
from clsas import cli

GRID = clsas.Grid.plane((-0.5, 0.5, 51), (31.5, 32.5, 51))


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Files of both banks, of which the second has a phase of 0.5 rad, and of their heights."""
    folder = tmp_path_factory.mktemp("banks")
    low, high = flat_banks()
    high = high.weighted(np.full(high.channels, np.exp(0.5j)))
    arrays = {
        name: np.concatenate([getattr(low, name), getattr(high, name)])
        for name in ("samples", "first_range_m", "tx_m", "rx_m")
    }
    both = replace(low, **arrays, bank_numbers=np.repeat([1, 3], low.channels))
    clsas.save(folder / "lines.h5", both)
    clsas.save(folder / "low.h5", low)
    found = clsas.heights(low, high, GRID, search_m=(-0.5, 0.5), window_m=0.2)
    clsas.save(folder / "heights.h5", found)
    return folder


def run(*args, code=0):
    result = CliRunner().invoke(cli.main, [str(arg) for arg in args], prog_name="clsas")
    assert result.exit_code == code, (result.output, result.exception)
    return result


def test_command_corrects_the_second_bank(files, tmp_path):
    output = tmp_path / "corrected.h5"
    given = files / "lines.h5", files / "heights.h5", "--known-height-m", 0, "--unknown", "phase"
    results = json.loads(run("pair-errors", *given, "-o", output, "--json").stdout)
    lines, corrected = clsas.load(files / "lines.h5"), clsas.load(output)
    pair = lines.bank(1), lines.bank(3)
    expected = clsas.pair_errors(
        *pair, clsas.load(files / "heights.h5"), known_height_m=0.0, unknowns=["phase"]
    )
    assert results["values"] == expected.values.tolist()
    assert results["unknowns"] == ["phase"]
    assert np.array_equal(corrected.bank(3).samples, expected.corrected(*pair).samples)
    assert np.array_equal(corrected.bank(1).samples, pair[0].samples)
    assert np.array_equal(corrected.bank_numbers, lines.bank_numbers)
    text = run("pair-errors", *given, "-o", output).stdout
    assert expected.describe().splitlines()[0] in text
    assert "mm in heights at" in text


@pytest.mark.exhaustive
def test_heights_may_be_those_of_a_store(files, tmp_path):
    output, store = tmp_path / "corrected.h5", tmp_path / "heights.zarr"
    lines = clsas.load(files / "lines.h5")
    pair = lines.bank(1), lines.bank(3)
    clsas.mosaic_heights(*pair, GRID, store, search_m=(-0.5, 0.5), window_m=0.2, patch_m=0.6)
    given = files / "lines.h5", store, "--unknown", "phase", "-o", output
    known = "--known-height-m", 0
    results = json.loads(run("pair-errors", *given, *known, "--json").stdout)
    whole = clsas.load(files / "heights.h5")
    (expected,) = clsas.pair_errors(*pair, whole, known_height_m=0, unknowns=["phase"]).values
    assert results["values"] == [pytest.approx(expected, abs=0.3 * results["sd"][0])]
    points = "--other", files / "lines.h5", store
    same = run("pair-errors", *given, *points, code=1)
    assert "--unknown must be observable from these heights" in same.stderr
    inside = run("pair-errors", *given[:-1], store / "a.h5", *known, code=2)
    assert "--output must not lie in the store" in inside.stderr
    clsas.mosaic(pair[0], GRID, tmp_path / "image.zarr", tolerance_db=-20).image()
    images = run("pair-errors", given[0], tmp_path / "image.zarr", *given[2:], *known, code=1)
    assert "must be a mosaic of heights" in images.stderr
    swapped = run("pair-errors", *given, "--other", store, files / "lines.h5", code=2)
    assert "first value of --other must be a file of range lines, got the folder" in swapped.stderr
    assert "heights.zarr" in swapped.stderr


def test_control_points_and_warnings(files, tmp_path):
    output = tmp_path / "corrected.h5"
    points = "--point", "0,32", "--point", "0.3,31.8,0.0"
    given = files / "lines.h5", files / "heights.h5", *points, "-o", output
    result = run("pair-errors", *given, "--unknown", "phase", "--unknown", "roll", "--json")
    assert json.loads(result.stdout)["held"] == ["roll"]
    assert "roll is not observable here" in result.stderr


def test_mistakes_are_reported(files, tmp_path):
    given = files / "lines.h5", files / "heights.h5", "-o", tmp_path / "corrected.h5"
    none = run("pair-errors", *given, code=2)
    assert "give one of --known-height-m, --point and --other, got none" in none.stderr
    two = run("pair-errors", *given, "--known-height-m", 0, "--point", "0,32", code=2)
    assert "got --known-height-m and --point" in two.stderr
    other = "--other", files / "lines.h5", files / "heights.h5"
    same = run("pair-errors", *given, *other, "--unknown", "phase", code=1)
    assert "--unknown must be observable from these heights" in same.stderr
    one = run("pair-errors", files / "low.h5", *given[1:], "--known-height-m", 0, code=1)
    assert "must have at least 2 receiver banks, got 1\n" in one.stderr
    no = run("pair-errors", given[0], given[0], *given[2:], "--known-height-m", 0, code=1)
    assert "must hold heights (clsas heights makes them), got range lines" in no.stderr
    for folder in ((files, "--known-height-m", 0), (files / "heights.h5", *other[:2], files)):
        no = run("pair-errors", given[0], *folder, "-o", files / "corrected.h5", code=1)
        assert f"{files} exists and is not a mosaic of clsas" in no.stderr
    assert not (tmp_path / "corrected.h5").exists()


@pytest.mark.parametrize(
    ("option", "value", "code", "message"),
    [
        ("--known-height-m", 1e300, 2, "'--known-height-m': must be finite and >= -1e+09"),
        ("--known-height-m", 1e9, 1, "--known-height-m must lie close enough to the heights"),
        ("--point", "0,32,1e300", 2, "'--point': must be finite and <= 1e+09"),
        ("--point", "0,32,1e9", 1, "--point must lie close enough to the heights"),
    ],
)
def test_heights_beyond_all_reason_give_one_message(option, value, code, message, files, tmp_path):
    given = files / "lines.h5", files / "heights.h5", "-o", tmp_path / "corrected.h5"
    refused = run("pair-errors", *given, option, value, "--unknown", "phase", code=code)
    assert message in refused.stderr
    assert "Warning" not in refused.stderr


def test_another_track_may_be_given_before_the_output(files, tmp_path):
    given = files / "lines.h5", files / "heights.h5", "--other", files / "lines.h5"
    other = *given, files / "heights.h5", "--unknown", "phase"
    same = run("pair-errors", *other, "-o", tmp_path / "corrected.h5", code=1)
    assert "--unknown must be observable from these heights" in same.stderr
    replaced = run("pair-errors", *other, "-o", files / "heights.h5", code=2)
    assert "must be two files" in replaced.stderr
