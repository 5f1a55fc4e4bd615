"""Mosaics say how wrong they are, and their worst patches are formed again if the whole misses."""

import json
import shutil

import numpy as np
import pytest
from judging import SLOW

import clsas
from clsas.engine import promise
from clsas.engine.data.certificate import of_parts
from clsas.engine.data.digests import with_digest
from clsas.engine.data.validate import ArgumentError
from clsas.engine.factorized import measured_costs
from clsas.engine.factorized.costs import KnownCosts
from clsas.mosaics import mosaic as mosaics
from clsas.selftest import extremes

pytest.importorskip("zarr")

REQUEST = {"tolerance_db": -40, "patches": (2, 2), "certificate": True, "memory_bytes": 64 << 20}
"""Memory for one patch at a time."""
BRIGHTEST, BRIGHT = (0, 1), (1, 0)  # patches of the scene


@pytest.fixture(scope="module")
def known():
    return extremes.ultrasonic(64, targets=20)


@pytest.fixture(autouse=True)
def every_patch_is_factorized(monkeypatch):
    monkeypatch.setattr(measured_costs, "load", lambda device: KnownCosts(SLOW, "given"))


@pytest.fixture
def lie(known, monkeypatch):
    """Plan patches to other tolerances than -40 dB, dB; return the patches planned, in order."""
    honest, planned = mosaics.planned, []

    def begin(wrong_db, *, always=False):
        def plan(request, device, **options):
            middle_m = np.mean(request.grid.bounds_m, axis=0)
            column, row = (middle_m > np.mean(known.grid.bounds_m, axis=0))[:2].astype(int)
            planned.append((int(row), int(column)))
            if planned[-1] in wrong_db and (always or request.tolerance_db == -40):
                request = mosaics.Request(
                    request.lines, request.grid, tolerance_db=wrong_db[planned[-1]]
                )
            return honest(request, device, **options)

        monkeypatch.setattr(mosaics, "planned", plan)
        return planned

    return begin


def test_the_whole_pools_its_patches(known, tmp_path):
    mosaic = clsas.mosaic(known.lines, known.grid, tmp_path / "a.zarr", **REQUEST)
    patches = {}
    image = mosaic.image(lambda patch: patches.update({(patch.row, patch.column): patch.record}))
    found = clsas.Store.opened(tmp_path / "a.zarr").certificate()
    assert found.of_patches == len(found.patches) == 4
    pooled = of_parts([record.certificate for record in patches.values()])
    whole = image.formed.certificate
    for each in (found.whole, whole):
        assert each.error == pytest.approx(pooled.error)
        assert each.error_variance == pytest.approx(pooled.error_variance)
    assert whole.error_db == pytest.approx(known.error_db(image.pixels), abs=1.5)
    assert found.worst == max(patches, key=lambda index: patches[index].certificate.error)
    row, column = found.worst
    assert f"dB in the block of patch {row},{column}" in repr(mosaic)
    for index, record in clsas.Store.opened(tmp_path / "a.zarr").records().items():
        assert record == patches[index]
        before, after = patches[index].certificate, record.certificate
        np.testing.assert_array_equal(after.worst, before.worst)
        np.testing.assert_array_equal(after.worst_db, before.worst_db)
        for name in ("pixels", "of_pixels", "seconds", "power", "error", "error_variance"):
            assert getattr(after, name) == getattr(before, name)


def test_only_the_worst_patch_is_formed_again_if_that_suffices(known, lie, tmp_path):
    """The other wrong one errs by more than the tolerance, but the whole does not."""
    planned = lie({BRIGHTEST: -15, BRIGHT: -33})
    mosaic = clsas.mosaic(known.lines, known.grid, tmp_path / "a.zarr", **REQUEST)
    with pytest.warns(clsas.ClsasWarning, match=r"missed its tolerance .*\(1 of 4 patches\), and"):
        image = mosaic.image()
    assert planned[4:] == [BRIGHTEST]
    assert known.error_db(image.pixels) < -40
    records = clsas.Store.opened(tmp_path / "a.zarr").records()
    (miss,) = records[BRIGHTEST].misses
    assert miss.startswith("predicted error -")
    assert image.formed.misses == (f"patch 0,1: {miss}",)
    assert not records[BRIGHT].misses
    assert records[BRIGHT].certificate.verdict(-40) == "missed"


def test_patches_of_a_block_stay_in_place_when_it_is_formed_again(known, lie, tmp_path):
    """Also those that an earlier run left in the store, which is resumed here."""
    path, wish = tmp_path / "a.zarr", {key: REQUEST[key] for key in ("tolerance_db", "patches")}
    lie(dict.fromkeys([(0, 0), (0, 1), (1, 0), (1, 1)], -15))
    wish |= {"certificate": True}
    with pytest.warns(clsas.ClsasWarning, match="misses its tolerance"):
        list(clsas.mosaic(known.lines, known.grid, path, **wish, on_miss="warn"))
    shutil.rmtree(path / "patches" / "0.0")
    with pytest.warns(clsas.ClsasWarning, match="meets it"):
        image = clsas.mosaic(known.lines, known.grid, path, **wish).image()
    assert known.error_db(image.pixels) < -40


def test_a_patch_that_misses_twice_is_formed_exactly(known, lie):
    planned = lie({BRIGHTEST: -15}, always=True)
    records = []
    with pytest.warns(clsas.ClsasWarning, match="meets it"):
        image = clsas.mosaic(known.lines, known.grid, **REQUEST).image(
            lambda patch: records.append(patch.record)
        )
    assert planned[4:] == [BRIGHTEST]
    assert len(records) == 6  # four, one by a tighter plan, and one exactly
    assert len(records[-1].misses) == 2
    assert records[-1].plan is None
    assert known.error_db(image.pixels) < -40


def test_a_miss_is_reported_at_the_end_and_leaves_a_valid_store(known, lie, tmp_path):
    """The run that continues may treat it in another way: requests are no inputs of the store."""
    planned = lie({BRIGHTEST: -15})
    wish = REQUEST | {"on_miss": "raise"}
    with pytest.raises(clsas.ToleranceError, match="misses its tolerance"):
        clsas.mosaic(known.lines, known.grid, tmp_path / "a.zarr", **wish).image()
    store = clsas.Store.opened(tmp_path / "a.zarr")
    assert len(store.records()) == 4
    assert not store.damage()
    wish = REQUEST | {"on_miss": "warn", "certificate": None}
    with pytest.warns(clsas.ClsasWarning, match="misses its tolerance: .*-40 dB requested; at"):
        assert not list(clsas.mosaic(known.lines, known.grid, tmp_path / "a.zarr", **wish))
    assert len(planned) == 4
    with pytest.warns(clsas.ClsasWarning, match="and meets it"):
        (again,) = clsas.mosaic(known.lines, known.grid, tmp_path / "a.zarr", **REQUEST)
    assert (again.row, again.column) == BRIGHTEST
    assert store.certificate().whole.verdict(-40) == "met"


def test_patches_without_a_certificate_are_counted(known, tmp_path):
    path = tmp_path / "a.zarr"
    wish = REQUEST | {"certificate": False}
    for _ in clsas.mosaic(known.lines, known.grid, path, **wish):
        break
    assert clsas.Store.opened(path).certificate() is None
    list(clsas.mosaic(known.lines, known.grid, path, **REQUEST))
    text = clsas.Store.opened(path).certificate().describe()
    assert text.endswith("of 4 patches measured")


def test_stages_are_certified_only_on_request(known, monkeypatch):
    monkeypatch.setattr("clsas.engine.promise.LEAST_SECONDS", 0.0)
    for certificate, asked in ((None, False), (True, True)):
        for patch in clsas.mosaic(
            known.lines, known.grid, stages=[(2, 2)], patches=(1, 2), certificate=certificate
        ):
            assert (patch.record.certificate is not None) == asked
    (patch,) = clsas.mosaic(known.lines, known.grid, tolerance_db=-40, patches=(1, 1))
    assert patch.record.certificate is not None


def test_a_normalised_patch_counts_as_much_as_its_pixels(known):
    """Its certificate is that of pixels that all channels of the survey scale."""
    beam = clsas.BeamWindow(8.0, "hann", normalise=True)
    for patch in clsas.mosaic(known.lines, known.grid, **REQUEST, beam=beam):
        power = float(np.mean(np.abs(patch.image.pixels) ** 2))
        assert patch.record.certificate.power == pytest.approx(power, rel=1e-2)


def test_errors_that_cannot_be_measured_are_reported(known, monkeypatch):
    def refuse(*_):
        raise ArgumentError("lines", "leave a part of the sampled band empty")

    monkeypatch.setattr(promise, "measured", refuse)
    with pytest.warns(clsas.ClsasWarning, match="error of 4 of 4 patches is not known: lines must"):
        patches = list(clsas.mosaic(known.lines, known.grid, **REQUEST))
    for patch in patches:
        assert patch.record.certificate is None
        assert "the error is not known: lines must" in patch.record.flags[0]


@pytest.mark.parametrize("wrong", [{"power": -1.0}, {"error": "small"}, {"colour": 1}])
def test_a_wrong_certificate_is_damage(known, tmp_path, wrong):
    path = tmp_path / "a.zarr"
    list(clsas.mosaic(known.lines, known.grid, path, **REQUEST | {"patches": (1, 2)}))
    file = path / "patches" / "0.1" / "zarr.json"
    document = json.loads(file.read_text())
    document["attributes"]["certificate"] |= wrong
    document["attributes"] = with_digest(document["attributes"])
    file.write_text(json.dumps(document))
    assert list(clsas.Store.opened(path).damage()) == [(0, 1)]
