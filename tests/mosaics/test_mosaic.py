"""Mosaics: as exact as asked for, seamless, resumable, distributed, growing."""

import dataclasses
import errno
import json
import os
import pickle
import re
import shutil
import signal
import subprocess
import sys
import textwrap
import threading
import time
from concurrent.futures import wait
from types import MappingProxyType, SimpleNamespace
from unittest import mock

import h5py
import numpy as np
import pytest
from cases import along_x, lines_over
from tiers import also, few

import clsas
from clsas.engine.data import validate
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.grid import Grid
from clsas.engine.data.image_error import relative_error_db
from clsas.engine.data.validate import ClsasWarning
from clsas.engine.device.device import list_devices
from clsas.engine.factorized import measured_costs, planner
from clsas.engine.factorized.costs import Costs, KnownCosts
from clsas.mosaics import mosaic as mosaics
from clsas.mosaics.devices import claim_device
from clsas.mosaics.document import Document, Record
from clsas.mosaics.patches import Layout
from clsas.mosaics.store import Store
from clsas.mosaics.survey import (
    END,
    SurveyVisibility,
    open_survey,
    opened_visibility,
    stamped_files,
)

GRID = Grid.plane((-4, 4, 80), (30, 40, 60))
LINES = lines_over(GRID, along_x(160, 0.05), carrier_hz=100e3, step_m=0.03)
BEAM = BeamWindow(8.0, "hann")
REQUEST = {"accuracy_db": -70, "beam": BEAM, "patches": (2, 4)}
ALONE = {"memory_bytes": 64 << 20}  # too little for more than one patch at a time


@pytest.fixture(scope="module")
def exact():
    return clsas.backproject(LINES, GRID, beam=BEAM, accuracy_db=-80)


@pytest.fixture
def file(tmp_path):
    clsas.save(tmp_path / "lines.h5", LINES)
    return tmp_path / "lines.h5"


def test_work_grows_as_the_number_of_patches(monkeypatch):
    count = mock.Mock(side_effect=Layout.window)
    monkeypatch.setattr(Layout, "window", lambda *arguments: count(*arguments))
    monkeypatch.setattr(
        "clsas.mosaics.mosaic.form_block",
        lambda *arguments: [(Record(1, LINES.channels), None)] * len(arguments[4].wanted),
    )
    formed = clsas.mosaic(LINES, GRID, accuracy_db=-40, patches=(20, 20), **ALONE)
    before = count.call_count
    assert len(list(formed)) == 400
    # When a patch is submitted, and when it is handed out
    assert count.call_count - before == 2 * 400


@pytest.mark.slow
def test_patches_make_the_image(platform, exact):
    image = clsas.mosaic(LINES, GRID, **REQUEST, device=platform).image()
    assert image.grid is GRID
    assert relative_error_db(image, exact) < -65


def test_every_patch_has_its_own_pixels(exact):
    seen = []
    for patch in clsas.mosaic(LINES, GRID, **REQUEST):
        seen.append((patch.row, patch.column))
        expected = GRID.positions_m(patch.rows, patch.columns)
        np.testing.assert_allclose(patch.grid.positions_m(), expected, atol=1e-9)
        assert 0 < patch.record.channels < 160  # those within the beam
        assert not patch.record.flags
    assert sorted(seen) == list(np.ndindex(2, 4))


@pytest.mark.exhaustive
def test_patches_of_one_device_come_in_order(monkeypatch):
    """Even if several are finished before the caller takes the first."""
    monkeypatch.setattr(
        "clsas.mosaics.mosaic.wait", lambda futures, timeout: set(wait(futures).done)
    )
    wish = REQUEST | {"patches": (6, 8)} | ALONE
    patches = [(patch.row, patch.column) for patch in clsas.mosaic(LINES, GRID, **wish)]
    assert patches == list(np.ndindex(6, 8))


@pytest.mark.slow
def test_a_store_holds_pixels_and_records(file, tmp_path, exact):
    mosaic = clsas.mosaic(file, GRID, tmp_path / "image.zarr", **REQUEST)
    assert len(mosaic) == 8
    assert not mosaic.finished
    for patch in mosaic:
        assert Store.opened(tmp_path / "image.zarr").records()[patch.row, patch.column] == (
            patch.record
        )
    store = Store.opened(tmp_path / "image.zarr")
    assert relative_error_db(store.image(), exact) < -65
    np.testing.assert_allclose(store.grid.positions_m(), GRID.positions_m(), atol=1e-12)
    for record in store.records().values():
        assert record.predicted_error_db == -70
        assert record.seconds > 0


@pytest.mark.slow
def test_a_store_opens_in_xarray(file, tmp_path, exact):
    xarray = pytest.importorskip("xarray")
    for _ in clsas.mosaic(file, GRID, tmp_path / "image.zarr", **REQUEST):
        pass
    data = xarray.open_zarr(tmp_path / "image.zarr", consolidated=False)
    assert data.pixels.dims == ("y", "x")
    np.testing.assert_allclose(data.x, GRID.axes_m[0])
    assert np.abs(data.pixels.values).max() == pytest.approx(np.abs(exact.pixels).max(), rel=1e-3)


@pytest.mark.slow
def test_the_overview_keeps_power_and_place(file, tmp_path, exact):
    for _ in clsas.mosaic(file, GRID, tmp_path / "image.zarr", **REQUEST):
        pass
    overview = Store.opened(tmp_path / "image.zarr").overview(20)
    assert overview.grid.shape == (15, 20)
    blocks = np.abs(exact.pixels).reshape(15, 4, 20, 4) ** 2
    np.testing.assert_allclose(np.abs(overview.pixels) ** 2, blocks.mean(axis=(1, 3)), rtol=1e-2)
    expected = GRID.positions_m().reshape(15, 4, 20, 4, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(overview.grid.positions_m(), expected, atol=1e-9)
    part = Store.opened(tmp_path / "image.zarr").overview(10, slice(20, 44), slice(8, 48))
    np.testing.assert_allclose(np.abs(part.pixels), np.abs(overview.pixels[5:11, 2:12]), rtol=1e-6)
    np.testing.assert_allclose(
        part.grid.positions_m(), overview.grid.positions_m()[5:11, 2:12], atol=1e-9
    )


def test_the_directions_are_those_of_the_whole_track():
    """The visible channels of a patch alone would give a swaying track other directions."""
    track = LINES.tx_m.copy()
    track[:, 1] += 0.2 * np.sin(track[:, 0])
    lines = lines_over(GRID, track, carrier_hz=100e3, step_m=0.03)
    beam = BeamWindow(8.0, "rectangular")
    reference = clsas.backproject(lines, GRID, beam=beam, accuracy_db=-80)
    image = clsas.mosaic(lines, GRID, **(REQUEST | {"beam": beam})).image()
    assert relative_error_db(image, reference) < -65


@pytest.mark.parametrize("pixel_ns", [1.0, pytest.param(1e6, marks=pytest.mark.slow)])
def test_patches_are_planned_if_the_device_takes_longer_than_a_search(pixel_ns, monkeypatch):
    costs = KnownCosts(Costs(pixel_ns=pixel_ns), "given")
    monkeypatch.setattr(measured_costs, "load", lambda device: costs)
    (patch,) = clsas.mosaic(LINES, GRID, tolerance_db=-30, beam=BEAM, patches=(1, 1))
    assert (patch.record.plan is not None) == (pixel_ns > 1)


class TestFactorized:
    """A scene so large that every patch is factorized."""

    GRID = Grid.plane((-5.1, 5.1, 512), (40, 50.2, 512))
    BEAM = BeamWindow(20.0, "hann")
    TOLERANCE_DB = -40.0

    @pytest.fixture(scope="class")
    @classmethod
    def scene(cls):
        lines = lines_over(cls.GRID, along_x(1200, 0.025), carrier_hz=120e3, step_m=0.02)
        return lines, clsas.backproject(lines, cls.GRID, beam=cls.BEAM, accuracy_db=-80)

    @pytest.fixture(scope="class")
    @classmethod
    def formed(cls, scene):
        """Return the exact image and the patches of the mosaic."""
        patches = []
        mosaic = clsas.mosaic(
            scene[0], cls.GRID, tolerance_db=cls.TOLERANCE_DB, beam=cls.BEAM, patches=(2, 2),
            **ALONE,
        )  # fmt: skip
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(planner, "SEARCH_S", 0.0)  # plan every patch, however small
            return mosaic.image(patches.append), patches

    @pytest.mark.slow
    def test_every_patch_is_as_good_as_predicted(self, scene, formed):
        for patch in formed[1]:
            assert patch.record.plan["method"]["sides"]  # it was factorized
            exact = clsas.Image(scene[1].pixels[patch.rows, patch.columns], patch.grid)
            measured = relative_error_db(patch.image, exact)
            assert measured <= patch.record.predicted_error_db <= self.TOLERANCE_DB

    @pytest.mark.slow
    def test_there_are_no_seams(self, scene, formed):
        """Along borders the error is as elsewhere, and neighbours agree."""
        image, exact = formed[0].pixels, scene[1].pixels
        level = np.sqrt(np.mean(np.abs(exact) ** 2))
        error = np.abs(image - exact) / level
        for border in (error[254:258], error[:, 254:258]):
            assert 20 * np.log10(np.sqrt(np.mean(border**2))) <= self.TOLERANCE_DB + 1
        # The step across the border, minus that of the exact image.
        for a, b in ((np.s_[255], np.s_[256]), (np.s_[:, 255], np.s_[:, 256])):
            step = (image[a] - image[b]) - (exact[a] - exact[b])
            step_db = 20 * np.log10(np.sqrt(np.mean(np.abs(step) ** 2)) / level)
            assert step_db <= self.TOLERANCE_DB + 4

    def test_a_record_holds_its_plan(self, formed):
        record = formed[1][0].record
        plan = clsas.Plan.from_json(json.dumps(record.plan))
        assert plan.tolerance_db == self.TOLERANCE_DB
        assert plan.predicted_error_db == record.predicted_error_db


def test_a_normalising_beam(tmp_path):
    """The scale is that of all channels, not of those from which a patch receives."""
    beam = BeamWindow(8.0, "hann", normalise=True)
    exact = clsas.backproject(LINES, GRID, beam=beam, accuracy_db=-80)
    image = clsas.mosaic(LINES, GRID, **(REQUEST | {"beam": beam})).image()
    assert relative_error_db(image, exact) < -65
    request = REQUEST | {"beam": beam}
    (tmp_path / "lines").mkdir()
    clsas.save(tmp_path / "lines" / "a.h5", LINES)
    with pytest.raises(ValueError, match="beam must not normalise for a folder that may grow"):
        clsas.mosaic(tmp_path / "lines", GRID, tmp_path / "a.zarr", **request)
    (tmp_path / "lines" / END).touch()
    clsas.mosaic(tmp_path / "lines", GRID, tmp_path / "a.zarr", **request)


class TestTheWindowOfTheTracksDirection:
    """Sways of a few pings, which the directions follow in one file but not in a growing folder."""

    TRACK = along_x(60, 0.1) + np.outer(0.02 * np.sin(np.arange(60)), [0, 1, 0])
    LINES = lines_over(GRID, TRACK, carrier_hz=100e3, step_m=0.03)
    BEAM = BeamWindow(8.0, "hann")
    REQUEST = MappingProxyType({"accuracy_db": -60, "patches": (1, 2), "beam": BEAM})

    @pytest.fixture
    def folder(self, tmp_path):
        (tmp_path / "lines").mkdir()
        for part in range(3):
            path = tmp_path / "lines" / f"{part}.h5"
            clsas.save(path, self.LINES.select(slice(20 * part, 20 * part + 20)))
        return tmp_path / "lines"

    @pytest.fixture
    def image(self):
        return clsas.backproject(self.LINES, GRID, beam=self.BEAM, accuracy_db=-80)

    def test_a_finished_folder_is_like_one_file(self, folder, image, tmp_path):
        assert relative_error_db(clsas.mosaic(folder, GRID, **self.REQUEST).image(), image) < -60
        (folder / END).touch()
        found = clsas.mosaic(folder, GRID, tmp_path / "a.zarr", **self.REQUEST).image()
        assert relative_error_db(found, image) < -60

    def test_a_folder_that_may_grow_says_how_far_it_is_from_one_file(self, folder, image, tmp_path):
        with pytest.warns(ClsasWarning, match="may differ by") as caught:
            growing = clsas.mosaic(folder, GRID, tmp_path / "a.zarr", **self.REQUEST).image()
        (stated,) = re.findall(r"by (-\d+) dB", str(caught[0].message))
        assert relative_error_db(growing, image) == pytest.approx(float(stated), abs=4)
        # Once complete, it continues as it began.
        (folder / END).touch()
        with pytest.warns(ClsasWarning, match="may differ by"):
            again = clsas.mosaic(folder, GRID, tmp_path / "a.zarr", **self.REQUEST)
        assert len(again.finished) == 2

    def test_so_does_one_that_is_followed(self, folder, tmp_path):
        (folder / END).touch()
        with pytest.warns(ClsasWarning, match="of the 60 pings"):
            list(clsas.mosaic(folder, GRID, tmp_path / "a.zarr", **self.REQUEST, follow_s=5))

    @pytest.mark.parametrize(
        "beam", [BeamWindow(8.0, "hann", along=[1, 0, 0]), BeamWindow(8.0, "hann", track_pings=9)]
    )
    def test_given_directions_are_the_same(self, folder, tmp_path, beam):
        request = dict(self.REQUEST) | {"beam": beam}
        image = clsas.backproject(self.LINES, GRID, beam=beam, accuracy_db=-80)
        found = clsas.mosaic(folder, GRID, tmp_path / "a.zarr", **request).image()
        assert relative_error_db(found, image) < -60

    def test_directions_that_later_pings_change(self, folder, tmp_path):
        """The second file turns away: it adds no echoes, but turns the beam of the last pings."""
        x_m, y_m = np.minimum(np.arange(60), 39), np.maximum(np.arange(60) - 39, 0)
        track_m = 0.1 * np.stack([x_m - 20, -y_m, 0 * x_m], axis=1)
        lines = lines_over(GRID, track_m, carrier_hz=100e3, step_m=0.03)
        request = dict(self.REQUEST) | {"beam": BeamWindow(8.0, "hann", track_pings=21)}
        for part in range(3):
            (folder / f"{part}.h5").unlink()
        clsas.save(folder / "0.h5", lines.select(slice(0, 40)))
        clsas.mosaic(folder, GRID, tmp_path / "grown.zarr", **request).image()
        clsas.save(folder / "1.h5", lines.select(slice(40, 60)))
        grown = clsas.mosaic(folder, GRID, tmp_path / "grown.zarr", **request).image()
        at_once = clsas.mosaic(folder, GRID, tmp_path / "at_once.zarr", **request).image()
        assert relative_error_db(grown, at_once) < -60

    def test_long_or_straight_tracks_are_the_same(self, folder, tmp_path):
        lines = dataclasses.replace(self.LINES, tx_m=along_x(60, 0.1), rx_m=along_x(60, 0.1))
        clsas.save(folder / "0.h5", lines.select(slice(0, 20)))
        for part in (1, 2):
            (folder / f"{part}.h5").unlink()
        clsas.mosaic(folder, GRID, tmp_path / "a.zarr", **self.REQUEST)  # without a warning


@pytest.mark.slow
def test_height_maps_and_points():
    x, y = GRID.axes_m
    hill = 0.3 * np.exp(-(np.add.outer((y - 35) ** 2, x**2)))
    for grid in (GRID.with_height(hill), Grid.points(GRID.with_height(hill).positions_m())):
        exact = clsas.backproject(LINES, grid, beam=BEAM, accuracy_db=-80)
        image = clsas.mosaic(LINES, grid, **REQUEST).image()
        assert relative_error_db(image, exact) < -65


def test_an_image_larger_than_memory_is_refused():
    """Before any patch is formed."""
    grid = Grid.plane((-4, 4, 10**7), (30, 40, 10**7))
    with pytest.raises(ValueError, match=r"the mosaic must ask for at most .* GiB"):
        clsas.mosaic(LINES, grid, beam=BEAM).image()


def test_pings_that_do_not_fit_into_memory_are_refused(tmp_path, monkeypatch):
    """Even if none of their samples is read."""
    pings = 100_000
    at_m = np.zeros((pings, 3))
    at_m[:, 0] = np.linspace(-4, 4, pings)
    lines = clsas.RangeLines(
        np.ones((pings, 1), np.complex64), 30.0, 0.03, at_m, at_m, 100e3, 1500.0
    )
    clsas.save(tmp_path / "1.h5", lines)
    clsas.save(tmp_path / "2.h5", lines)
    for most_mib, source in ((30, lines), (12, tmp_path)):
        monkeypatch.setattr(validate, "_memory_bytes", lambda most=most_mib << 20: most)
        with pytest.raises(ValueError, match=r"the [12]00000 channels of source must ask for"):
            clsas.mosaic(source, GRID, beam=clsas.BeamWindow(8.0), accuracy_db=-40)


@pytest.mark.slow
def test_the_thesis_stages_work_in_patches():
    patches = list(clsas.mosaic(LINES, GRID, stages=[(2, 2), (2, 2)], beam=BEAM, patches=(2, 2)))
    assert [len(patch.record.plan["method"]["aperture"]["factors"]) for patch in patches] == [2] * 4


@pytest.mark.slow
def test_patches_that_do_not_divide_the_grid(exact):
    patches = []
    image = clsas.mosaic(LINES, GRID, **(REQUEST | {"patches": (7, 3)})).image(patches.append)
    assert {patch.image.grid.shape for patch in patches} == {(9, 27), (9, 26), (6, 27), (6, 26)}
    assert relative_error_db(image, exact) < -65


def test_a_patch_that_no_channel_sees_is_empty_and_flagged(tmp_path):
    """Half of the scene lies behind the beams, and a part beyond the end of the lines."""
    grid = Grid.plane((-4, 120, 64), (30, 40, 20))
    mosaic = clsas.mosaic(LINES, grid, tmp_path / "a.zarr", **(REQUEST | {"patches": (1, 4)}))
    patches = []
    image = mosaic.image(patches.append)
    assert image.pixels[:, :16].any()
    assert not image.pixels[:, 16:].any()
    received = [patch.record.channels - patch.record.missing_channels for patch in patches]
    assert [count > 0 for count in received] == [True, False, False, False]
    for patch in patches[1:]:
        assert not patch.image.pixels.any()
        assert patch.record.flags == (
            "empty: outside the beam or recorded ranges of every channel",
        )
        assert patch.record.predicted_error_db is None


@pytest.mark.slow
def test_missing_samples_are_flagged(file, tmp_path):
    with h5py.File(file, "r+") as lines:
        lines["samples"][20:24] = np.nan
    kept = np.delete(np.arange(160), slice(20, 24))
    along = BEAM.directions(LINES)
    reference = clsas.backproject(
        LINES.select(kept), GRID, beam=dataclasses.replace(BEAM, along=along[kept])
    )
    patches = []
    image = clsas.mosaic(file, GRID, tmp_path / "a.zarr", **REQUEST).image(patches.append)
    assert relative_error_db(image, reference) < -58
    flagged = [patch for patch in patches if patch.record.flags]
    assert 0 < len(flagged) < len(patches)
    assert flagged[0].record.missing_channels == 4
    assert flagged[0].record.gap_m == pytest.approx(0.25)
    assert "4 of" in flagged[0].record.flags[0]
    assert "a gap of 0.25 m" in flagged[0].record.flags[1]


@pytest.mark.slow
@pytest.mark.parametrize("wish", [{}, {"accuracy_db": None, "tolerance_db": -65}])
def test_missing_channels_weigh_nothing(file, wish, monkeypatch):
    """Neither in a beam that divides by the sum of weights, nor in a plan."""
    monkeypatch.setattr(planner, "SEARCH_S", 0.0)
    beam = BeamWindow(8.0, "hann", normalise=True)
    kept = np.random.default_rng(1).random(160) > 0.2
    with h5py.File(file, "r+") as lines:
        for channel in np.flatnonzero(~kept):
            lines["samples"][channel] = np.nan
    along = beam.directions(LINES)[kept]
    reference = clsas.backproject(
        LINES.select(kept), GRID, beam=dataclasses.replace(beam, along=along), accuracy_db=-80
    )
    image = clsas.mosaic(file, GRID, **(REQUEST | {"beam": beam} | wish)).image()
    # A normalised image is the weighted mean times the number of all channels.
    of_all = 160 / np.count_nonzero(kept)
    assert relative_error_db(image.pixels, of_all * reference.pixels) < -65


@pytest.mark.parametrize(
    ("samples", "says"),
    [
        (np.ones((160, 9), np.float32), r"samples as complex numbers.* got float32"),
        (np.ones((160, 9), np.int16), "got int16"),
        (np.complex64(1), r"got complex64 of shape \(\)"),
        ("group", "lacks samples"),
        (None, "lacks samples"),
    ],
)
def test_lines_without_complex_samples_are_refused(file, samples, says):
    with h5py.File(file, "r+") as lines:
        del lines["samples"]
        if isinstance(samples, str):
            lines.create_group("samples")
        elif samples is not None:
            lines["samples"] = samples
    with pytest.raises(clsas.FileFormatError, match=says):
        clsas.mosaic(file, GRID, **REQUEST)


def test_lost_pings_are_flagged():
    lines = LINES.select(np.delete(np.arange(160), slice(70, 80)))
    flags = {patch.record.flags for patch in clsas.mosaic(lines, GRID, **REQUEST)}
    assert ("a gap of 0.55 m along the track",) in flags


class TestBlocks:
    """Neighbouring patches are planned, formed and certified together."""

    @pytest.fixture
    def formed(self, monkeypatch):
        """Return the shapes of the images that are formed."""
        form, shapes = mosaics.SceneImager.form, []

        def watched(imager, lines):
            shapes.append(imager.scene.grid.shape)
            return form(imager, lines)

        monkeypatch.setattr(mosaics.SceneImager, "form", watched)
        return shapes

    def test_neighbours_are_one_image(self, formed, exact, tmp_path):
        path, patches = tmp_path / "a.zarr", []
        mosaic = clsas.mosaic(LINES, GRID, path, **REQUEST, certificate=True)
        image = mosaic.image(patches.append)
        assert formed == [GRID.shape]
        assert relative_error_db(image, exact) < -65
        records = [patch.record for patch in patches]
        assert sum(record.share for record in records) == pytest.approx(1)
        (drawn,) = {record.certificate.pixels for record in records}
        for whole in (image.formed.certificate, Store.opened(path).certificate().whole):
            assert (whole.pixels, whole.of_pixels) == (drawn, GRID.size)
            for name in ("error", "error_variance", "error_third", "power", "seconds"):
                expected = getattr(records[0].certificate, name)
                assert getattr(whole, name) == pytest.approx(expected), name

    def test_only_missing_patches_are_written(self, formed, tmp_path):
        """They are formed with their neighbours, so that they are what they were."""
        path = tmp_path / "a.zarr"
        before = clsas.mosaic(LINES, GRID, path, **REQUEST).image()
        kept = path / "patches" / "1.1" / "zarr.json"
        written = kept.stat().st_mtime_ns
        (path / "patches" / "1.2" / "zarr.json").unlink()
        again = list(clsas.mosaic(LINES, GRID, path, **REQUEST))
        assert [(patch.row, patch.column) for patch in again] == [(1, 2)]
        assert formed == [GRID.shape] * 2
        assert kept.stat().st_mtime_ns == written
        np.testing.assert_array_equal(Store.opened(path).image().pixels, before.pixels)

    def test_a_block_fits_into_memory(self, formed):
        most = 28 * LINES.samples.size + 16 * GRID.size
        wish = REQUEST | {"beam": BeamWindow(2.0), "memory_bytes": (64 << 20) + 3 * most // 4}
        list(clsas.mosaic(LINES, GRID, **wish))
        assert 1 < len(formed) < 8
        assert sum(np.prod(formed, axis=1)) == GRID.size

    def test_every_worker_has_some_blocks(self, file, tmp_path):
        wish = REQUEST | {"patches": (6, 8)}
        for threads, least, most in ((1, 4, 8), (3, 12, 24), (20, 48, 48), (0, 4, 8)):
            client = SimpleNamespace(get_executor=None, nthreads=lambda n=threads: {"a": n})
            path = tmp_path / f"{threads}.zarr"
            mosaic = clsas.mosaic(file, GRID, path, client=client, **wish)
            count = len(mosaic._in_blocks(np.ndindex(6, 8)))
            assert least <= count <= most

    def test_a_patch_of_zeros_has_no_share(self):
        grid = Grid.plane((-4, 120, 64), (30, 40, 20))
        wish = REQUEST | {"patches": (1, 4)}
        first, *others = clsas.mosaic(LINES, grid, **wish, certificate=True)
        assert first.record.share == 1
        assert first.record.certificate.of_pixels == grid.size
        for patch in others:
            assert (patch.record.share, patch.record.certificate) == (0, None)


class TestOnceMore:
    @pytest.mark.slow
    def test_what_the_store_has_is_not_formed_again(self, file, tmp_path, exact):
        mosaic = clsas.mosaic(file, GRID, tmp_path / "a.zarr", **REQUEST, **ALONE)
        running = iter(mosaic)
        first = next(running)
        running.close()
        assert (first.row, first.column) in mosaic.finished
        # Including the patches that were begun when the loop was left.
        assert mosaic.finished == Store.opened(tmp_path / "a.zarr").records()
        left = 8 - len(mosaic.finished)
        assert len(list(mosaic)) == left
        assert len(mosaic.finished) == 8
        assert not list(mosaic)
        assert relative_error_db(mosaic.image(), exact) < -65

    @pytest.mark.slow
    def test_without_a_store_everything_is(self):
        mosaic = clsas.mosaic(LINES, GRID, **REQUEST)
        assert len(list(mosaic)) == len(list(mosaic)) == 8


class TestResuming:
    @pytest.mark.slow
    def test_what_is_finished_is_kept(self, file, tmp_path, exact):
        path = tmp_path / "image.zarr"
        running = iter(clsas.mosaic(file, GRID, path, **REQUEST, **ALONE))
        for _ in range(3):
            next(running)
        running.close()
        kept = {place: (path / "patches" / "{}.{}".format(*place)) for place in np.ndindex(2, 4)}
        times = {p: f.stat().st_mtime_ns for p, f in kept.items() if f.exists()}
        assert 3 <= len(times) < 8
        mosaic = clsas.mosaic(file, GRID, path, **REQUEST)
        assert set(mosaic.finished) == set(times)
        assert {(patch.row, patch.column) for patch in mosaic} == set(kept) - set(times)
        assert all(kept[place].stat().st_mtime_ns == then for place, then in times.items())
        assert relative_error_db(Store.opened(path).image(), exact) < -65
        assert not list(clsas.mosaic(file, GRID, path, **REQUEST))

    @pytest.mark.slow
    def test_the_image_has_what_was_there_and_what_was_not(self, tmp_path):
        path = tmp_path / "a.zarr"
        before = clsas.mosaic(LINES, GRID, path, **REQUEST).image()
        chunk = path / "pixels" / "c" / "1" / "2"
        chunk.write_bytes(chunk.read_bytes()[:100])
        patches = []
        with pytest.warns(ClsasWarning, match="patch 1,2: its pixels are not those"):
            mosaic = clsas.mosaic(LINES, GRID, path, **REQUEST)
        again = mosaic.image(patches.append)
        np.testing.assert_array_equal(again.pixels, before.pixels)
        told = [(patch.row, patch.column) for patch in patches]
        assert told[-1] == (1, 2)  # after the stored patches
        assert sorted(told) == list(np.ndindex(2, 4))
        there = clsas.mosaic(LINES, GRID, path, **REQUEST)
        assert len(there.finished) == 8
        np.testing.assert_array_equal(there.image().pixels, before.pixels)

    @pytest.mark.slow
    @pytest.mark.parametrize("kills", [1, *also(3)])
    def test_after_kill(self, file, tmp_path, exact, kills):
        """Runs that are killed with SIGKILL at random moments."""
        program = f"""
            import clsas, pickle, sys
            grid, wish = pickle.load(open({str(tmp_path / "wish")!r}, "rb"))
            for patch in clsas.mosaic({str(file)!r}, grid, {str(tmp_path / "a.zarr")!r}, **wish):
                print(patch.row, patch.column, flush=True)
        """
        import pickle

        wish = REQUEST | {"patches": (6, 8)} | ALONE
        (tmp_path / "wish").write_bytes(pickle.dumps((GRID, wish)))
        formed = []
        for left in reversed(range(kills + 1)):
            process = subprocess.Popen(
                [sys.executable, "-c", textwrap.dedent(program)], stdout=subprocess.PIPE, text=True
            )
            for line in process.stdout:
                formed.append(line)
                if left and len(formed) % 9 == 8:
                    process.send_signal(signal.SIGKILL)
                    break
            formed += process.stdout.readlines()
            assert process.wait() == (-signal.SIGKILL if left else 0)
        assert len(set(formed)) == len(formed)  # none twice
        # When the process died, one patch may have been finished but not yet printed.
        assert 48 - kills <= len(formed) <= 48
        assert relative_error_db(Store.opened(tmp_path / "a.zarr").image(), exact) < -65

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"accuracy_db": -60}, "`accuracy_db` is -70 in the store, -60 here"),
            (
                {"accuracy_db": None, "tolerance_db": -40},
                "`tolerance_db` is not set in the store, -40 here",
            ),
            ({"beam": None}, "`beam` is set in the store, not set here"),
            ({"patches": (2, 2)}, "patches have 30 x 20 pixels in the store, 30 x 40 here"),
            ({"grid": Grid.plane((-4, 4, 80), (30, 41, 60))}, "the grid has another position"),
            (
                {"grid": Grid.plane((-4, 4, 40), (30, 40, 60))},
                "the grid has 60 x 80 pixels in the store, 60 x 40 here",
            ),
            ({"lines": LINES.select(slice(1, None))}, "the range lines differ"),
        ],
    )
    def test_other_inputs_are_refused(self, tmp_path, change, message):
        next(iter(clsas.mosaic(LINES, GRID, tmp_path / "a.zarr", **REQUEST)))
        before = len(Store.opened(tmp_path / "a.zarr").records())
        change = {"lines": LINES, "grid": GRID} | REQUEST | change
        with pytest.raises(ValueError, match=f"made with other inputs: .*{message}"):
            clsas.mosaic(change.pop("lines"), change.pop("grid"), tmp_path / "a.zarr", **change)
        assert len(Store.opened(tmp_path / "a.zarr").records()) == before

    def test_a_folder_that_has_lost_a_file_is_refused(self, tmp_path):
        """Its patches contain echoes of channels that are gone."""
        folder = tmp_path / "survey"
        folder.mkdir()
        for number, channels in enumerate(np.array_split(np.arange(LINES.channels), 3)):
            clsas.save(folder / f"{number}.h5", LINES.select(channels))
        next(iter(clsas.mosaic(folder, GRID, tmp_path / "a.zarr", **REQUEST)))
        (folder / "2.h5").unlink()
        with pytest.raises(ValueError, match="the range lines differ"):
            clsas.mosaic(folder, GRID, tmp_path / "a.zarr", **REQUEST)

    @pytest.mark.slow
    def test_a_store_without_a_finished_patch_may_be_deleted(self, tmp_path):
        """Only the user may delete it: another process may be about to write to it."""
        path = tmp_path / "a.zarr"
        wrong = clsas.mosaic(LINES, GRID, path, stages=[(64, 64)], patches=(2, 4))
        with pytest.raises(ValueError, match=r"^stages must leave a line and a pixel") as caught:
            list(wrong)
        sent = pickle.loads(pickle.dumps(caught.value))  # as worker processes do
        assert caught.value.__notes__ == sent.__notes__ == ["patch 0,0"]
        other = REQUEST | {"patches": (3, 4)}
        with pytest.raises(ValueError, match="or delete the store: it has no finished patch"):
            clsas.mosaic(LINES, GRID, path, **other)
        assert path.exists()
        shutil.rmtree(path)
        assert len(list(clsas.mosaic(LINES, GRID, path, **other))) == 12

    @pytest.mark.slow
    @pytest.mark.parametrize(
        ("name", "value"),
        [
            ("predicted_error_db", float("nan")),
            *few(
                [
                    ("predicted_error_db", "x"),
                    ("seconds", None),
                    ("channels", "9"),
                    ("survey_channels", 5.0),
                ],
                often=(),
            ),
        ],
    )
    def test_a_patch_with_a_damaged_record_is_formed_again(self, tmp_path, name, value):
        path = tmp_path / "a.zarr"
        assert len(list(clsas.mosaic(LINES, GRID, path, **REQUEST))) == 8
        record = path / "patches" / "1.2" / "zarr.json"
        stored = json.loads(record.read_text())
        stored["attributes"][name] = value
        record.write_text(json.dumps(stored))
        with pytest.warns(ClsasWarning, match="patch 1,2: its record does not match its digest"):
            again = list(clsas.mosaic(LINES, GRID, path, **REQUEST))
        assert [(patch.row, patch.column) for patch in again] == [(1, 2)]

    def test_a_store_of_an_older_schema_is_refused(self, tmp_path):
        next(iter(clsas.mosaic(LINES, GRID, tmp_path / "a.zarr", **REQUEST)))
        header = tmp_path / "a.zarr" / "zarr.json"
        text = json.loads(header.read_text())
        text["attributes"]["version"] = 0
        header.write_text(json.dumps(text))
        with pytest.raises(ValueError, match="is a mosaic of version 0, but this clsas works with"):
            clsas.mosaic(LINES, GRID, tmp_path / "a.zarr", **REQUEST)

    def test_lines_with_other_samples_are_refused(self, tmp_path):
        next(iter(clsas.mosaic(LINES, GRID, tmp_path / "a.zarr", **REQUEST)))
        samples = LINES.samples.copy()
        samples[77] *= 5
        changed = dataclasses.replace(LINES, samples=samples)
        with pytest.raises(ValueError, match="the range lines differ"):
            clsas.mosaic(changed, GRID, tmp_path / "a.zarr", **REQUEST)

    @pytest.mark.slow
    @pytest.mark.parametrize("damage", ["removed", "cut"])
    def test_pixels_that_are_not_there_are_formed_again(self, tmp_path, damage):
        list(clsas.mosaic(LINES, GRID, tmp_path / "a.zarr", **REQUEST))
        before = Store.opened(tmp_path / "a.zarr").image().pixels
        chunk = tmp_path / "a.zarr" / "pixels" / "c" / "1" / "2"
        if damage == "cut":
            chunk.write_bytes(chunk.read_bytes()[:100])
        else:
            chunk.unlink()
        with pytest.warns(ClsasWarning, match="patch 1,2: its pixels are"):
            again = list(clsas.mosaic(LINES, GRID, tmp_path / "a.zarr", **REQUEST))
        assert [(patch.row, patch.column) for patch in again] == [(1, 2)]
        np.testing.assert_array_equal(Store.opened(tmp_path / "a.zarr").image().pixels, before)

    @pytest.mark.parametrize("text", ["", "{}", '{"attributes": {"format": "clsas mosaic"}}'])
    def test_a_damaged_document_is_told(self, tmp_path, text):
        """Only this document contains the inputs of the store, so nothing can restore it."""
        next(iter(clsas.mosaic(LINES, GRID, tmp_path / "a.zarr", **REQUEST)))
        (tmp_path / "a.zarr" / "zarr.json").write_text(text)
        with pytest.raises(ValueError, match=r"a.zarr (is damaged|exists and is not|is a mosaic)"):
            clsas.mosaic(LINES, GRID, tmp_path / "a.zarr", **REQUEST)

    @pytest.mark.slow
    def test_a_file_written_anew_is_read_anew(self, file, tmp_path):
        clsas.mosaic(file, GRID, **REQUEST).image()
        moved = dataclasses.replace(LINES, tx_m=LINES.tx_m + 0.3, rx_m=LINES.rx_m + 0.3)
        clsas.save(file, moved)
        image = clsas.mosaic(file, GRID, **REQUEST).image()
        exact = clsas.backproject(moved, GRID, beam=BEAM, accuracy_db=-80)
        assert relative_error_db(image, exact) < -65

    def test_a_folder_of_something_else_is_left_alone(self, tmp_path):
        (tmp_path / "letter.txt").write_text("dear")
        with pytest.raises(ValueError, match="exists and is not a mosaic of clsas"):
            clsas.mosaic(LINES, GRID, tmp_path, **REQUEST)
        assert [path.name for path in tmp_path.iterdir()] == ["letter.txt"]

    @pytest.mark.slow
    def test_a_record_cut_off_is_formed_again(self, tmp_path):
        list(clsas.mosaic(LINES, GRID, tmp_path / "a.zarr", **REQUEST))
        record = tmp_path / "a.zarr" / "patches" / "1.2" / "zarr.json"
        record.write_text(record.read_text()[:50])
        with pytest.warns(ClsasWarning, match="patch 1,2: its record cannot be read"):
            again = list(clsas.mosaic(LINES, GRID, tmp_path / "a.zarr", **REQUEST))
        assert [(patch.row, patch.column) for patch in again] == [(1, 2)]


@pytest.mark.slow
def test_a_full_disk_keeps_what_is_finished(file, tmp_path):
    program = """
        import clsas, pickle, resource, signal, sys
        from clsas.mosaics.store import Store
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        grid, wish = pickle.load(open("wish", "rb"))
        mosaic = clsas.mosaic("lines.h5", grid, "a.zarr", **wish)
        formed = 0
        try:
            for patch in mosaic:
                formed += 1
                if formed == 3:
                    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))
        except OSError as error:
            print(formed, type(error).__name__, error)
    """
    import pickle

    (tmp_path / "wish").write_bytes(pickle.dumps((GRID, REQUEST | ALONE)))
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(program)], cwd=tmp_path, text=True,
        capture_output=True, check=True,
    )  # fmt: skip
    assert "too large" in done.stdout
    assert re.search(r"a\.zarr/pixels/c/\d/\d'$", done.stdout.strip())  # not a temporary file
    kept = Store.opened(tmp_path / "a.zarr").records()
    assert 3 <= len(kept) < 8
    assert len(list(clsas.mosaic(file, GRID, tmp_path / "a.zarr", **REQUEST))) == 8 - len(kept)


def test_a_store_that_cannot_be_made(tmp_path):
    with pytest.raises(OSError, match="no such folder"):
        clsas.mosaic(LINES, GRID, tmp_path / "none" / "a.zarr", **REQUEST)
    (tmp_path / "file").write_text("")
    with pytest.raises((OSError, ValueError), match="file"):
        clsas.mosaic(LINES, GRID, tmp_path / "file", **REQUEST)


@pytest.mark.parametrize("number", [errno.EACCES, errno.EROFS, errno.ENOSPC])
def test_an_error_names_the_store_that_cannot_be_written(tmp_path, monkeypatch, number):
    def refused(dir):
        raise OSError(number, os.strerror(number), str(dir / "tmp3yx_0ld"))

    monkeypatch.setattr("tempfile.TemporaryFile", refused)
    with pytest.raises(OSError, match=os.strerror(number)) as caught:
        clsas.mosaic(LINES, GRID, tmp_path / "a.zarr", **REQUEST)
    assert caught.value.filename == str(tmp_path / "a.zarr")


@pytest.mark.skipif(not os.geteuid(), reason="nothing is read-only to root")
def test_a_store_that_is_read_only(tmp_path):
    list(clsas.mosaic(LINES, GRID, tmp_path / "a.zarr", **REQUEST))
    (tmp_path / "a.zarr").chmod(0o500)
    with pytest.raises(PermissionError):
        clsas.mosaic(LINES, GRID, tmp_path / "a.zarr", **REQUEST)


@pytest.mark.exhaustive
@pytest.mark.skipif(len(list_devices()) < 2, reason="one OpenCL device only")
def test_devices_side_by_side(exact):
    infos = list_devices()[:2]
    mosaic = clsas.mosaic(
        LINES,
        GRID,
        **(REQUEST | {"patches": (6, 8)}),
        device=[info.index for info in infos],
        **ALONE,
    )
    patches = []
    assert relative_error_db(mosaic.image(patches.append), exact) < -65
    assert {patch.record.device for patch in patches} == {info.label for info in infos}


class TestDistributed:
    @pytest.mark.slow
    def test_a_worker_that_dies_is_made_up_for(self, file, tmp_path):
        distributed = pytest.importorskip("distributed")
        for _ in clsas.mosaic(file, GRID, tmp_path / "local.zarr", **REQUEST, **ALONE):
            pass
        with (
            mock.patch.dict(os.environ),  # Dask changes it while it starts a worker again
            distributed.LocalCluster(
                n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
            ) as cluster,
            distributed.Client(cluster) as client,
        ):
            first = next(iter(client.run(os.getpid).values()))
            places = []
            path = tmp_path / "distributed.zarr"
            for patch in clsas.mosaic(file, GRID, path, client=client, **REQUEST, **ALONE):
                places.append((patch.row, patch.column))
                if len(places) == 2:
                    os.kill(first, signal.SIGKILL)
        assert sorted(places) == sorted(np.ndindex(2, 4))
        local, other = (
            Store.opened(tmp_path / f"{n}.zarr").image().pixels for n in ("local", "distributed")
        )
        np.testing.assert_array_equal(local, other)

    def test_only_workers_need_a_device(self, file, tmp_path, monkeypatch):
        monkeypatch.setattr("clsas.engine.device.device._raw_devices", list)
        client = SimpleNamespace(get_executor=None, nthreads=dict)
        mosaic = clsas.mosaic(file, GRID, tmp_path / "a.zarr", client=client, **REQUEST)
        assert len(mosaic) == 8

    @pytest.mark.parametrize(
        ("wrong", "message"),
        [
            ({"store": None}, "store must be given with a client"),
            ({"source": LINES}, "source must be a path with a client"),
            ({"device": 0}, "device must be left out with a client"),
        ],
    )
    def test_bad_arguments(self, file, tmp_path, wrong, message):
        arguments = {"source": file, "store": tmp_path / "a.zarr"} | wrong
        with pytest.raises(ValueError, match=message):
            clsas.mosaic(grid=GRID, client=SimpleNamespace(get_executor=None), **arguments)


class TestFollowing:
    GRID = Grid.plane((-30, 10, 200), (30, 33, 12))
    TRACK = along_x(1200, 0.05)
    REQUEST = MappingProxyType({"accuracy_db": -70, "beam": BEAM, "patches": (1, 10)})

    @pytest.fixture(scope="class")
    @classmethod
    def lines(cls):
        return lines_over(cls.GRID, cls.TRACK, carrier_hz=100e3, step_m=0.03, own_start=True)

    @pytest.fixture
    def record(self, lines, tmp_path):
        """Return a function that adds files of 200 channels each to a folder."""
        folder = tmp_path / "survey"
        folder.mkdir()

        def add(parts):
            for part in parts:
                clsas.save(folder / f"{part}.h5", lines.select(slice(200 * part, 200 * part + 200)))

        return folder, add

    @pytest.mark.slow
    def test_patches_are_formed_while_files_arrive(self, lines, record, tmp_path):
        folder, add = record
        beam = dataclasses.replace(BEAM, track_pings=101)
        reference = clsas.backproject(lines, self.GRID, beam=beam, accuracy_db=-80)
        add([0, 1])
        formed, late = [], threading.Event()

        def more():
            for part in (2, 3, 4, 5):
                time.sleep(0.3)
                add([part])
                if part == 3:
                    late.wait(60)  # add the other files once a patch is finished
            (folder / END).touch()

        recorder = threading.Thread(target=more)
        recorder.start()
        path = tmp_path / "a.zarr"
        for patch in clsas.mosaic(folder, self.GRID, path, **self.REQUEST, follow_s=60):
            formed.append((patch.column, patch.record.survey_channels))
            late.set()
        recorder.join()
        assert sorted(column for column, _ in formed) == list(range(10))  # none twice
        assert formed[0][1] <= 800  # of 1200
        assert relative_error_db(Store.opened(path).image(), reference) < -65

    @pytest.mark.slow
    def test_it_ends_when_nothing_comes(self, record, tmp_path):
        folder, add = record
        add(range(3))
        patches = list(
            clsas.mosaic(folder, self.GRID, tmp_path / "a.zarr", **self.REQUEST, follow_s=1)
        )
        assert len(patches) == 10
        assert not (folder / END).exists()

    @pytest.mark.parametrize(("squint_deg", "column"), [(0.0, 160), (40.0, 160), (-40.0, 0)])
    def test_no_patch_is_formed_too_early(self, lines, squint_deg, column):
        """Also for a beam that is squinted forward or backward."""
        beam = BeamWindow(8.0, "hann", squint_deg=squint_deg, along=(1.0, 0.0, 0.0))
        patch = self.GRID.window(slice(0, 12), slice(column, column + 10))
        counts = np.arange(20, 1201, 20)
        known = [SurveyVisibility.of(open_survey(lines.select(slice(0, n))), beam) for n in counts]
        last = np.flatnonzero(known[-1].channels(patch))[-1]
        passed = [each.has_passed(patch, each.settled) for each in known]
        assert not any(passed[: np.searchsorted(counts, last + 1)])
        assert last < 1000
        assert passed[np.searchsorted(counts, last + 200)]  # soon afterwards

    @pytest.mark.slow
    def test_a_survey_is_followed_once_more(self, record, tmp_path):
        """Every file is in the store's inputs once, whichever part of the run noticed it first."""
        folder, add = record
        add(range(2))
        mosaic = clsas.mosaic(folder, self.GRID, tmp_path / "a.zarr", **self.REQUEST, follow_s=1)
        add(range(2, 4))
        (folder / END).touch()
        formed = list(mosaic)
        assert len(formed) == 10
        assert not list(mosaic)
        again = clsas.mosaic(folder, self.GRID, tmp_path / "a.zarr", **self.REQUEST, follow_s=1)
        assert len(again.finished) == 10

    @pytest.mark.slow
    def test_a_survey_that_grew_twice_goes_on(self, record, tmp_path):
        """The store's inputs contain every file, in order."""
        folder, add = record
        add(range(2))
        path = tmp_path / "a.zarr"
        mosaic = clsas.mosaic(folder, self.GRID, path, **self.REQUEST, follow_s=3)
        add([2])
        later = threading.Timer(1.5, add, ([3],))
        later.start()
        list(mosaic)
        later.join()
        assert len(Document.read(path).inputs["parts"]) == 4
        assert len(clsas.mosaic(folder, self.GRID, path, **self.REQUEST).finished) == 10

    @pytest.mark.slow
    def test_later_channels_make_a_patch_anew(self, lines, record, tmp_path):
        folder, add = record
        add(range(4))
        path = tmp_path / "a.zarr"
        assert len(list(clsas.mosaic(folder, self.GRID, path, **self.REQUEST))) == 10
        add(range(4, 6))
        again = {patch.column for patch in clsas.mosaic(folder, self.GRID, path, **self.REQUEST)}
        assert 9 in again
        assert 0 not in again
        beam = dataclasses.replace(BEAM, track_pings=101)
        reference = clsas.backproject(lines, self.GRID, beam=beam, accuracy_db=-80)
        assert relative_error_db(Store.opened(path).image(), reference) < -65

    @pytest.mark.slow
    def test_a_second_leg_while_following_again(self, lines, record, tmp_path):
        """Including patches of an earlier run, and patches begun when the last file was added."""
        folder, add = record
        add(range(6))
        path = tmp_path / "a.zarr"
        running = iter(clsas.mosaic(folder, self.GRID, path, **self.REQUEST, follow_s=5))
        for _ in range(5):
            next(running)
        running.close()
        mosaic = clsas.mosaic(folder, self.GRID, path, **self.REQUEST, follow_s=5)
        assert len(mosaic.finished) >= 5
        # The way back, parallel to the first leg.
        back = lines.select(np.arange(1199, -1, -1))
        aside_m = np.array([0.0, 2.0, 0.0])
        back = dataclasses.replace(back, tx_m=back.tx_m + aside_m, rx_m=back.rx_m + aside_m)
        clsas.save(folder / "7.h5", back)
        (folder / END).touch()
        image = mosaic.image()
        store = Store.opened(path)
        assert {record.survey_channels for record in store.records().values()} == {2400}
        np.testing.assert_array_equal(image.pixels, store.image().pixels)
        assert not list(clsas.mosaic(folder, self.GRID, path, **self.REQUEST))

    def test_a_worker_opens_every_file_once(self, lines, record, monkeypatch):
        """But open it again if it has changed meanwhile."""
        survey = sys.modules["clsas.mosaics.survey"]
        read, opened = survey.read_geometry, []
        monkeypatch.setattr(
            survey, "read_geometry", lambda path: opened.append(path.name) or read(path)
        )
        folder, add = record

        def seen():
            """Return the number of channels that a worker knows, and the files that it opened."""
            files = stamped_files(survey.open_survey(folder))
            opened.clear()
            return opened_visibility(files, None).survey.channels, list(opened)

        add(range(2))
        assert seen() == (400, ["0.h5", "1.h5"])
        add(range(2, 4))
        assert seen() == (800, ["2.h5", "3.h5"])
        clsas.save(folder / "0.h5", lines.select(slice(0, 100)))
        add([4])
        assert seen() == (900, [f"{n}.h5" for n in range(5)])

    @pytest.mark.slow
    def test_a_folder_that_stays_empty(self, tmp_path):
        (tmp_path / "none").mkdir()
        with pytest.raises(ValueError, match="has no file"):
            clsas.mosaic(tmp_path / "none", self.GRID, **self.REQUEST, follow_s=0.1)


@pytest.mark.slow
@pytest.mark.skipif(not os.path.exists("/proc/self/status"), reason="Linux tells the most memory")
def test_lines_larger_than_memory_are_read_in_parts(tmp_path):
    """200 km of track and 30 GB of samples in a sparse file, which takes little of the disk."""
    pings, length = 640_000, 6000
    small = LINES
    track = along_x(pings, 0.05)
    first = pings // 2 - 80
    assert np.allclose(track[first : first + 160], small.tx_m, atol=1e-6)
    clsas.save(tmp_path / "lines.h5", small)
    with h5py.File(tmp_path / "lines.h5", "r+") as file:
        for name, values in (
            ("tx_m", track),
            ("rx_m", track),
            ("first_range_m", np.full(pings, small.first_range_m[0])),
        ):
            attributes = dict(file[name].attrs)
            del file[name]
            file.create_dataset(name, data=values).attrs.update(attributes)
        attributes = dict(file["samples"].attrs)
        del file["samples"]
        samples = file.create_dataset("samples", (pings, length), np.complex64, chunks=(64, 1000))
        samples.attrs.update(attributes)
        samples[first : first + 160, : small.length] = small.samples
        assert samples.id.get_storage_size() < 4e6 < 1e-3 * samples.nbytes
    script = textwrap.dedent(
        """
        import pathlib, sys
        sys.path.append("..")
        import numpy as np, clsas
        from test_mosaic import BEAM, GRID, LINES

        def most_kib():  # of this process alone, without the one that forked it
            lines = pathlib.Path("/proc/self/status").read_text().splitlines()
            return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))

        clsas.backproject(LINES, GRID, beam=BEAM, accuracy_db=-70)  # the memory of the driver
        before = most_kib()
        image = clsas.mosaic(sys.argv[1], GRID, accuracy_db=-70, beam=BEAM, patches=(2, 4)).image()
        print(most_kib() - before)
        np.save(sys.argv[2], image.pixels)
        """
    )
    done = subprocess.run(
        [sys.executable, "-c", script, tmp_path / "lines.h5", tmp_path / "image.npy"],
        check=True,
        capture_output=True,
        text=True,
        cwd=os.path.dirname(__file__),
    )
    assert int(done.stdout) / 1024 < 500  # MiB, of 30 GB
    exact = clsas.backproject(LINES, GRID, beam=BEAM, accuracy_db=-80)
    assert relative_error_db(np.load(tmp_path / "image.npy"), exact.pixels) < -65


def test_workers_of_a_machine_take_a_device_each(tmp_path, monkeypatch):
    """Further workers share them, and a new worker takes the place of one that ended."""
    monkeypatch.setattr("clsas.mosaics.devices.default_devices", lambda: ("first", "second"))
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path))
    claim = claim_device.__wrapped__  # without the cache, as if every call were another process
    workers = [claim() for _ in range(5)]
    assert [device for device, _ in workers] == ["first", "second", "first", "second", "first"]
    os.close(workers[1][1])
    assert claim()[0] == "second"


def test_a_mosaic_says_how_its_patches_were_formed(tmp_path):
    request = REQUEST | {"beam": clsas.BeamWindow(40, "hann")}
    patches = []
    formed = clsas.mosaic(LINES, GRID, tmp_path / "a.zarr", **request).image(patches.append).formed
    assert len(patches) > 1
    assert (formed.method, formed.tolerance_db) == ("mosaic", patches[0].image.formed.tolerance_db)
    assert formed.beam == request["beam"]
    assert formed.predicted_error_db == max(p.image.formed.predicted_error_db for p in patches)
    assert formed.device == patches[0].record.device
    assert "patches of" in formed.plan
    # Patches in a store may have been formed by another version.
    assert clsas.mosaic(LINES, GRID, tmp_path / "a.zarr", **request).image().formed is None
