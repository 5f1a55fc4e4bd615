"""Surveys are read in slices, and imaged as if they had been read whole."""

import warnings
from dataclasses import replace

import h5py
import numpy as np
import pytest
from cases import along_x, lines_over

from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.geometry import pairwise_range_m
from clsas.engine.data.georeference import Georeference
from clsas.engine.data.grid import Grid
from clsas.engine.data.image_error import relative_error_db
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.sound_speed import SoundSpeed
from clsas.engine.data.validate import ClsasWarning
from clsas.engine.imaging import backproject
from clsas.files.hdf5 import FileFormatError, load, save
from clsas.mosaics.mosaic import mosaic
from clsas.mosaics.survey import (
    END,
    SurveyVisibility,
    files_of,
    has_ended,
    largest_gap_m,
    open_files,
    open_survey,
    warn_of_order,
)

GRID = Grid.plane((-3, 3, 61), (30, 90, 121))
TRACK = along_x(120, 0.05)
LINES = lines_over(GRID, TRACK, carrier_hz=100e3, step_m=0.03)
PATCH = GRID.window(slice(40, 60), slice(20, 50))


@pytest.fixture
def folder(tmp_path):
    for index, channels in enumerate((slice(0, 50), slice(50, 51), slice(51, 120))):
        save(tmp_path / f"{index}.h5", LINES.select(channels))
    return tmp_path


def ranges_of(grid):
    range_m = pairwise_range_m(grid.positions_m().reshape(-1, 3), TRACK, TRACK, None, 1500.0)
    return range_m.min(axis=0), range_m.max(axis=0)


def test_geometry_is_that_of_the_lines(folder):
    survey = open_survey(folder)
    for name in ("tx_m", "rx_m", "first_range_m"):
        np.testing.assert_array_equal(getattr(survey.geometry, name), getattr(LINES, name))
    assert survey.channels == 120
    assert set(survey.lengths) == {LINES.length}
    assert survey.geometry.samples.shape == (120, 1)


@pytest.mark.parametrize("how", ["memory", "file", "folder"])
def test_what_is_read_is_what_was_recorded(how, folder, tmp_path):
    save(tmp_path / "whole.hdf5", LINES)
    survey = open_survey({"memory": LINES, "file": tmp_path / "whole.hdf5", "folder": folder}[how])
    seen = np.zeros(120, bool)
    seen[[3, 4, 48, 50, 52, 119]] = True
    near_m, far_m = ranges_of(PATCH)
    lines, missing = survey.read(seen, near_m, far_m)
    assert not missing.any()
    assert lines.length < LINES.length / 2
    assert survey.extent(seen, near_m, far_m) == (lines.channels, lines.length)
    np.testing.assert_array_equal(lines.tx_m, TRACK[seen])
    for line, channel in zip(range(6), np.flatnonzero(seen), strict=True):
        place = (lines.first_range_m[line] - LINES.first_range_m[channel]) / LINES.range_step_m
        assert place == pytest.approx(round(place), abs=1e-6)
        first = int(np.floor((near_m[channel] - lines.first_range_m[line]) / lines.range_step_m))
        last = int(np.ceil((far_m[channel] - lines.first_range_m[line]) / lines.range_step_m))
        assert first >= 32
        inside = slice(first - 32, last + 33)
        there = LINES.samples[channel, round(place) :][: lines.length]
        np.testing.assert_array_equal(lines.samples[line, inside], there[inside])


def test_cut_lines_give_the_same_image(platform):
    survey = open_survey(LINES)
    lines, _ = survey.read(np.ones(120, bool), *ranges_of(PATCH))
    exact = backproject(LINES, PATCH, device=platform, accuracy_db=-85)
    cut = backproject(lines, PATCH, device=platform, accuracy_db=-85)
    assert relative_error_db(cut, exact) < -78


def test_nothing_is_read_beyond_what_is_recorded():
    survey = open_survey(LINES)
    lines, _ = survey.read(np.ones(120, bool), np.full(120, -1e3), np.full(120, 1e3))
    np.testing.assert_array_equal(lines.samples, LINES.samples)
    beyond = Grid.plane((-3, 3, 61), (1e3, 2e3, 121))
    assert not SurveyVisibility.of(survey, None).channels(beyond).any()


@pytest.mark.parametrize("velocity_m_s", [None, np.array([[30.0, 0, 0]])])
def test_a_line_contributes_to_pixels_just_beyond_its_ends(velocity_m_s, platform):
    """As in an image of the whole grid, whose interpolation reads the samples at the end."""
    antenna_m, pixel = np.zeros((1, 3)), Grid.plane((3, 3, 1), (40, 40, 1))
    range_m = pairwise_range_m(pixel.spread(1), antenna_m, antenna_m, velocity_m_s, 1500.0)[0]
    samples, contributing, expected = np.ones((1, 16), complex), [], []
    for beyond in (*range(-1, -9, -1), *range(16, 24), -100, 115):
        line = RangeLines(
            samples, range_m - 0.03 * (beyond + 0.5), 0.03, antenna_m, antenna_m, 1e4, 1500.0,
            velocity_m_s,
        )  # fmt: skip
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ClsasWarning)
            image = backproject(line, pixel, device=platform, taps=8, upsampling=1.0)
        expected.append(bool(image.pixels.any()))
        contributing.append(bool(SurveyVisibility.of(open_survey(line), None).channels(pixel)[0]))
    assert contributing == expected == 15 * [True] + 3 * [False]


def test_channels_without_samples_are_told(tmp_path):
    save(tmp_path / "lines.h5", LINES)
    with h5py.File(tmp_path / "lines.h5", "r+") as file:
        file["samples"][7] = np.nan
        file["samples"][9] = 0
    lines, missing = open_survey(tmp_path / "lines.h5").read(np.ones(120, bool), *ranges_of(PATCH))
    assert list(np.flatnonzero(missing)) == [7, 9]
    assert not lines.samples[[7, 9]].any()
    assert np.isfinite(lines.samples).all()


def test_gaps_between_pings():
    none = np.zeros(120, bool)
    assert largest_gap_m(LINES.phase_centres_m, none) == 0
    missing = none.copy()
    missing[60:64] = True
    assert largest_gap_m(LINES.phase_centres_m, missing) == pytest.approx(0.25)
    dropped = LINES.select(~missing)
    assert largest_gap_m(dropped.phase_centres_m, np.zeros(116, bool)) == pytest.approx(0.25)


def growing_track(case):
    """Positions of channels, and how many of them are there before the survey grows."""
    if case == "a jump just before the end":
        x_m = np.concatenate([np.arange(60), 300 + np.arange(44)]) * 0.1
        sway_m = 0.05 * np.sin(np.arange(104) / 3)
        return np.stack([x_m, sway_m, 0 * x_m], axis=1)[:, None], 64
    ping_m = np.stack([0.1 * np.arange(104), 0.1 * np.sin(np.arange(104) / 5), np.zeros(104)], 1)
    return ping_m[:, None] + np.outer(np.linspace(-1, 1, 9), [1.0, 0, 0]), 9 * 64


@pytest.mark.parametrize("case", ["a jump just before the end", "an array of many steps"])
def test_later_pings_do_not_turn_the_beam_of_settled_channels(case):
    rx_m, count = growing_track(case)
    tx_m = np.repeat(rx_m.mean(axis=1), rx_m.shape[1], axis=0)
    samples = np.ones((len(tx_m), 4), np.complex64)
    lines = RangeLines(samples, 20.0, 0.1, tx_m, rx_m.reshape(-1, 3), 100e3, 1500.0)
    beam = BeamWindow(10.0, "hann", track_pings=21)
    before, after = (
        SurveyVisibility.of(open_survey(each), beam)
        for each in (lines.select(slice(0, count)), lines)
    )
    assert before.settled > 0
    settled = slice(0, before.settled)
    np.testing.assert_allclose(after.along[settled], before.along[settled], atol=1e-9)


def test_a_digest_changes_with_what_it_is_of():
    digest = open_survey(LINES).digests()
    assert digest == open_survey(replace(LINES)).digests()
    moved = replace(LINES, tx_m=LINES.tx_m + 1e-6)
    louder = replace(LINES, samples=2 * LINES.samples)
    assert len({*digest, *open_survey(moved).digests(), *open_survey(louder).digests()}) == 3


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("bank_numbers", np.arange(120) % 2),
        ("sound_speed", SoundSpeed([0, 80], [1500, 1490], surface_z_m=10.0)),
        ("rx_velocity_m_s", [1.0, 0, 0]),
    ],
)
@pytest.mark.parametrize("in_file", [False, True], ids=["memory", "file"])
def test_a_digest_changes_with_every_field(tmp_path, name, value, in_file):
    found = []
    for number, lines in enumerate([LINES, replace(LINES, **{name: value})]):
        save(path := tmp_path / f"{number}.h5", lines)
        found += open_survey(path if in_file else lines).digests()
    assert len(set(found)) == 2


def test_a_look_direction_which_later_files_may_lack_is_not_in_digests():
    looking = replace(LINES, look_direction=[0, 1.0, 0])
    assert open_survey(looking).digests() == open_survey(LINES).digests()


def test_a_survey_grows_by_files_that_follow(folder):
    before = open_survey(folder)
    save(folder / "3.h5", LINES.select(slice(0, 10)))
    grown = open_files(files_of(folder), before)
    assert grown.channels == 130
    assert grown.digests(3) == grown.digests()[3:]
    assert grown.digests()[:3] == before.digests()
    save(folder / "2b.h5", LINES.select(slice(0, 10)))
    with pytest.raises(ValueError, match=r"whose names sort after the last one, 3\.h5, got 2b\.h5"):
        open_files(files_of(folder), grown)
    (folder / "2b.h5").unlink()
    (folder / "3.h5").unlink()
    with pytest.raises(ValueError, match="got fewer files"):
        open_files(files_of(folder), grown)


def test_a_file_that_changed_is_not_read(folder):
    survey = open_survey(folder)
    save(folder / "0.h5", LINES.select(slice(0, 49)))
    with pytest.raises(FileFormatError, match=r"0\.h5 has changed since"):
        survey.read(np.ones(120, bool), *ranges_of(PATCH))


def test_a_folder_ends_with_a_file_named_end(folder):
    assert not has_ended(folder)
    (folder / END).touch()
    assert has_ended(folder)
    assert [path.name for path in files_of(folder)] == ["0.h5", "1.h5", "2.h5"]


@pytest.mark.parametrize(
    "names",
    [
        ["ping_1", "ping_2", "ping_9", "ping_10", "ping_100"],
        ["line2-9", "line2-10", "line10-1"],
        ["a", "A2", "a10", "b"],
        ["007", "7", "08", "9"],
        ["2026-01-02T03", "2026-01-02T10", "2026-01-11T00"],
    ],
)
def test_numbers_in_names_count_as_numbers(names, tmp_path):
    for name in np.random.default_rng(1).permutation(names):
        (tmp_path / f"{name}.h5").touch()
    assert [path.stem for path in files_of(tmp_path)] == names


@pytest.mark.parametrize("name", ["ping_{}", "{}", "2026-line{}b"])
def test_files_without_leading_zeros_are_in_the_order_of_their_pings(name, tmp_path):
    for number, channels in enumerate(np.split(np.arange(120), 12)):
        save(tmp_path / f"{name.format(number + 1)}.h5", LINES.select(channels))
    np.testing.assert_array_equal(open_survey(tmp_path).geometry.tx_m, TRACK)


def test_a_look_direction_is_known_if_every_file_states_it(folder):
    for path in files_of(folder)[:2]:
        save(path, replace(load(path), look_direction=[0, 1, 0]))
    assert open_survey(folder).geometry.look_direction is None
    first = open_files(files_of(folder)[:2])
    np.testing.assert_array_equal(first.geometry.look_direction, np.tile([0, 1, 0], (51, 1)))
    assert open_files(files_of(folder), first).geometry.look_direction is None
    digests = open_survey(folder).digests()
    save(folder / "2.h5", replace(load(folder / "2.h5"), look_direction=[0, 1, 0]))
    survey = open_survey(folder)
    np.testing.assert_array_equal(survey.geometry.look_direction, np.tile([0, 1, 0], (120, 1)))
    assert survey.digests() == digests  # a mosaic goes on, since its pixels stay
    np.testing.assert_array_equal(survey.last_range_m, LINES.last_range_m)


def test_errors(folder, tmp_path):
    with pytest.raises(TypeError, match="source must be a path, got 3"):
        open_survey(3)
    with pytest.raises(FileNotFoundError):
        open_survey(tmp_path / "none.h5")
    save(folder / "3.h5", replace(LINES, carrier_hz=99e3))
    with pytest.raises(ValueError, match=r"3.h5: carrier_hz must equal .* 100000, got 99000"):
        open_survey(folder)
    save(folder / "3.h5", replace(LINES, rx_velocity_m_s=[1.0, 0, 0]))
    with pytest.raises(ValueError, match="rx_velocity_m_s must be in all files"):
        open_survey(folder)
    save(folder / "3.h5", replace(LINES, georeference=Georeference(crs="EPSG:32632")))
    with pytest.raises(ValueError, match=r"3.h5: georeference must equal .* None, got EPSG:32632"):
        open_survey(folder)
    save(folder / "3.h5", GRID)
    with pytest.raises(FileFormatError, match="must contain range lines, got 'grid'"):
        open_survey(folder)
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(ValueError, match=r"must contain range lines, got .*empty, which has no"):
        open_survey(empty)


def survey_of_files(tmp_path, position_m, order):
    """Two pings per file, whose names follow `order`."""
    for number, name in enumerate(order):
        at_m = position_m[2 * number : 2 * number + 2]
        lines = RangeLines(np.ones((2, 4), complex), 20.0, 0.05, at_m, at_m, 100e3, 1500.0)
        save(tmp_path / f"ping_{name}.h5", lines)
    return open_survey(tmp_path)


@pytest.mark.parametrize(
    "order", [np.arange(24)[::-1], np.random.default_rng(1).permutation(24), np.arange(24) * 7 % 24]
)
def test_names_that_contradict_the_track_are_warned_of(order, tmp_path):
    survey = survey_of_files(tmp_path, along_x(48, 0.05), order)
    with pytest.warns(ClsasWarning, match="do not follow the track in the order of their names"):
        warn_of_order(survey)


def test_nothing_is_said_of_files_in_order_or_of_parallel_passes(tmp_path):
    passes = [along_x(8, 0.05, y=10.0 * row)[:: (-1) ** row] for row in range(6)]
    there = [along_x(12, 0.05, y=10.0 * row) for row in range(4)]
    for number, position_m in enumerate((along_x(48, 0.05), *map(np.concatenate, (passes, there)))):
        folder = tmp_path / str(number)
        folder.mkdir()
        warn_of_order(survey_of_files(folder, position_m, np.arange(24)))


@pytest.mark.slow
def test_mosaics_of_folders_warn_of_their_order_only_under_a_beam(tmp_path):
    survey_of_files(tmp_path, along_x(48, 0.05), np.random.default_rng(2).permutation(24))
    grid = Grid.plane((-0.1, 0.1, 5), (20.05, 20.1, 5))
    mosaic(tmp_path, grid)
    mosaic(tmp_path, grid, beam=BeamWindow(20.0, along=[1, 0, 0]))
    with pytest.warns(ClsasWarning, match="do not follow the track"):
        mosaic(tmp_path, grid, beam=BeamWindow(20.0))
