"""Receiver banks of sonars, echoes and range lines."""

from dataclasses import replace

import numpy as np
import pytest

import clsas
from clsas.engine.data.digests import lines_digest
from clsas.engine.data.lines import first_two_banks
from clsas.engine.data.system import line_array, stacked
from clsas.mosaics.survey import open_survey

PULSE = clsas.Pulse(carrier_hz=100e3, bandwidth_hz=20e3, duration_s=1e-3)
RX_M, NUMBERS = stacked(line_array(3, 0.05), (-0.1, 0.2))
SONAR = clsas.Sonar(PULSE, RX_M, bank_numbers=NUMBERS)
TRACK = clsas.Track.straight([0, 0, 10], [2, 0, 0], pings=5, ping_interval_s=0.05)
POINTS = clsas.PointTargets([[0.2, 40, 0], [0.4, 41, 0.5]])
GRID = clsas.Grid.plane((0, 0.4, 9), (39.5, 41, 16))


@pytest.fixture(scope="module")
def lines():
    return clsas.compress(clsas.simulate(SONAR, TRACK, POINTS))


def test_a_bank_is_the_sonar_with_its_receivers():
    assert SONAR.banks == 2
    assert replace(SONAR, bank_numbers=None).banks == 1
    lower, upper = SONAR.bank(0), SONAR.bank(1)
    np.testing.assert_array_equal(lower.rx_m, RX_M[:3])
    np.testing.assert_array_equal(upper.rx_m[:, 2], 0.2)
    assert upper.bank_numbers is None
    assert upper.bank(0) is upper
    assert "2 banks of 3 receivers" in repr(SONAR)


def test_the_two_banks_of_heights_are_the_first_and_others_are_named():
    assert first_two_banks(np.array([3, 1, 1])) == (1, 3)  # warnings are errors
    with pytest.warns(
        clsas.ClsasWarning, match="from banks 0 and 1; bank 2 is not used. To choose"
    ):
        assert first_two_banks(np.array([0, 1, 2])) == (0, 1)
    with pytest.warns(clsas.ClsasWarning, match="banks 1 and 4; banks 5, 6 and 9 are not used"):
        assert first_two_banks(np.array([9, 6, 5, 4, 1])) == (1, 4)


@pytest.mark.parametrize(
    ("numbers", "error", "message"),
    [
        ([0, 0, 1, 1, 1, 1], ValueError, "the same number of receivers, got 2, 4"),
        ([0, 0, 0, 2, 2, 2], ValueError, r"without a gap, got \[0, 2\]"),
        ([1, 1, 1, 1, 1, 1], ValueError, r"from 0 without a gap"),
        ([0, 1], ValueError, r"one number for each of 6 receivers, got shape \(2,\)"),
        ([0.0] * 6, TypeError, "bank_numbers must be whole numbers"),
        ([-1] * 6, ValueError, "bank_numbers must be from 0"),
    ],
)
def test_wrong_banks_of_a_sonar_are_refused(numbers, error, message):
    with pytest.raises(error, match=message):
        clsas.Sonar(PULSE, RX_M, bank_numbers=numbers)


def test_lines_of_a_bank_are_those_of_a_sonar_with_this_bank(lines):
    assert lines.banks == 2
    np.testing.assert_array_equal(lines.bank_numbers, np.tile(NUMBERS, 5))
    both = clsas.compress(clsas.simulate(SONAR, TRACK, POINTS, range_m=(40, 43)))
    for number in range(2):
        echoes = clsas.simulate(SONAR.bank(number), TRACK, POINTS, range_m=(40, 43))
        alone, bank = clsas.compress(echoes), both.bank(number)
        assert bank.bank_numbers is None
        np.testing.assert_array_equal(bank.rx_m, alone.rx_m)
        np.testing.assert_array_equal(bank.first_range_m, alone.first_range_m)
        np.testing.assert_allclose(bank.samples, alone.samples, atol=1e-6)


def test_selections_keep_banks(lines):
    upper = lines.select(slice(3, 6))
    assert upper.banks == 1
    assert upper.bank(1).channels == 3
    with pytest.raises(ValueError, match="number must be 1, since there is one bank, got 0"):
        upper.bank(0)
    with pytest.raises(ValueError, match="number must be one of the banks 0, 1, got 2"):
        lines.bank(2)
    with pytest.raises(TypeError, match="number must be"):
        lines.bank("upper")
    with pytest.raises(ValueError, match="since there is one bank, got 1"):
        lines.bank(0).bank(1)
    with pytest.raises(ValueError, match="one number for each of 30 channels"):
        replace(lines, bank_numbers=[0, 1])


def test_files_keep_banks(lines, tmp_path):
    clsas.save(tmp_path / "lines.h5", lines)
    np.testing.assert_array_equal(
        clsas.load(tmp_path / "lines.h5").bank_numbers, lines.bank_numbers
    )
    echoes = clsas.simulate(SONAR, TRACK, POINTS)
    clsas.save(tmp_path / "echoes.h5", echoes)
    again = clsas.load(tmp_path / "echoes.h5")
    np.testing.assert_array_equal(again.bank_numbers, lines.bank_numbers)
    data = lines_to_netcdf(lines, tmp_path / "lines.nc")
    np.testing.assert_array_equal(data, lines.bank_numbers)


def lines_to_netcdf(lines, path):
    xarray = pytest.importorskip("xarray")
    clsas.to_xarray(lines).drop_vars("samples").to_netcdf(path, engine="h5netcdf")
    with xarray.open_dataset(path, engine="h5netcdf") as data:
        assert data.bank_numbers.long_name == "Receiver bank"
        return data.bank_numbers.values


def test_surveys_of_several_files_keep_banks(lines, tmp_path):
    for number in range(2):
        clsas.save(tmp_path / f"{number}.h5", lines)
    geometry = open_survey(tmp_path).geometry
    np.testing.assert_array_equal(geometry.bank_numbers, np.tile(NUMBERS, 10))
    clsas.save(tmp_path / "2.h5", lines.bank(0))
    with pytest.raises(ValueError, match="bank_numbers must be in all files of the survey"):
        open_survey(tmp_path)


def test_cphd_refuses_banks(lines, tmp_path):
    pytest.importorskip("sarkit")
    with pytest.raises(ValueError, match=r"one bank, got 2: write `lines.bank\(0\)`"):
        clsas.write_cphd(tmp_path / "lines.cphd", lines)


def test_banks_do_not_change_images(lines):
    """Plans and stores of lines whose banks become known stay valid."""
    assert lines_digest(lines) == lines_digest(replace(lines, bank_numbers=None))


@pytest.mark.parametrize(
    "form",
    [
        lambda lines: clsas.plan(lines, GRID, tolerance_db=-30),
        lambda lines: clsas.backproject(lines, GRID, accuracy_db=-40),
        lambda lines: clsas.Imager(lines, GRID, tolerance_db=-30),
        lambda lines: clsas.mosaic(lines, GRID, tolerance_db=-30),
    ],
)
def test_one_image_of_two_banks_warns(lines, form):
    with pytest.warns(clsas.ClsasWarning, match=r"2 banks, 0.3 m apart.*lines.bank\(0\)") as heard:
        form(lines)
    assert len(heard) == 1
    form(lines.bank(0))  # warnings are errors
    form(replace(lines, bank_numbers=None))


@pytest.mark.slow
def test_two_banks_cancel_in_one_image_off_the_grid():
    """What the warning says: half a cycle of height away from the grid, the echoes cancel."""
    sonar = clsas.Sonar(PULSE, [[0, 0, -0.1], [0, 0, 0.1]], bank_numbers=[0, 1])
    track = clsas.Track.straight([-1, 0, 10], [2, 0, 0], pings=100, ping_interval_s=0.01)
    height_m = sonar.wavelength_m * np.hypot(40, 10) / 0.2 / 2  # half the height of ambiguity
    levels = []
    for z in (0.0, height_m):
        # The point that has the range of a point on the plane, higher up and farther away.
        y = np.sqrt(40.0**2 + 10.0**2 - (10.0 - z) ** 2)
        lines = clsas.compress(clsas.simulate(sonar, track, clsas.PointTargets([[0, y, z]])))
        grid = clsas.Grid.plane((-0.05, 0.05, 11), (39.9, 40.1, 81))
        both = clsas.backproject(replace(lines, bank_numbers=None), grid, accuracy_db=-60)
        one = clsas.backproject(lines.bank(0), grid, accuracy_db=-60)
        levels.append(np.abs(both.pixels).max() / np.abs(one.pixels).max())
    assert levels[0] == pytest.approx(2, rel=0.01)
    assert levels[1] < 0.3


def test_assessments_are_of_one_bank(lines):
    with pytest.raises(ValueError, match=r"one bank, got 2: use `lines.bank\(0\)`"):
        clsas.assess(lines, GRID)
    survey = clsas.survey_lines(SONAR, TRACK, GRID)
    assert survey.banks == 2
    found = clsas.assess(survey.bank(1), GRID, sonar=SONAR.bank(1), track=TRACK)
    assert found.channels == 15
