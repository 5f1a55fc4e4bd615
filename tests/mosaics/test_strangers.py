"""Stores from strangers: they cannot run code, exhaust memory or redirect writes."""

import contextlib
import json
import pickle
import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
from stores import GRID, LINES, REQUEST, change, change_metadata, files_of

import clsas
from clsas.engine.data import validate

numcodecs = pytest.importorskip("numcodecs")
zarr = pytest.importorskip("zarr")


class Payload:
    """An object that creates a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def ways_to_read(path):
    """Return all functions that read a store."""
    yield lambda: clsas.Store.opened(path).grid
    yield lambda: clsas.Store.opened(path).image()
    yield lambda: clsas.Store.opened(path).read()
    yield lambda: clsas.Store.opened(path).overview()
    yield lambda: clsas.Store.opened(path).pixels[:]
    yield lambda: clsas.Store.opened(path).damage()
    yield lambda: clsas.Store.opened(path).array_damage()
    yield lambda: clsas.Store.opened(path).records()


def read_all(path):
    for read in ways_to_read(path):
        try:
            read()
        except ValueError:
            continue


@pytest.fixture
def trusting(monkeypatch):
    """Let Zarr and numcodecs unpickle whatever they read, as their older versions do."""
    monkeypatch.setattr(numcodecs.pickles, "ALLOW_UNSAFE_PICKLE_DECODE", True, raising=False)
    with zarr.config.set({"array.allow_unsafe_pickle_decode": True}):
        yield


@pytest.mark.slow
@pytest.mark.parametrize("name", ["height", "pixels", "x"])
@pytest.mark.usefixtures("trusting")
def test_pickles_of_zarr_format_2_do_not_run(path, tmp_path, name):
    mark = tmp_path / "ran"
    shape = [40] if name == "x" else [30, 40]
    metadata = {
        "zarr_format": 2, "shape": shape, "chunks": shape, "dtype": "|O", "order": "C",
        "filters": [{"id": "vlen-utf8"}, {"id": "pickle", "protocol": 5}], "compressor": None,
        "fill_value": "",
    }  # fmt: skip
    shutil.rmtree(path / name)
    (path / name).mkdir()
    (path / name / ".zarray").write_text(json.dumps(metadata))
    (path / name / ".".join("0" for _ in shape)).write_bytes(pickle.dumps(Payload(mark)))
    # What the store does to a program that reads it with the defaults of Zarr:
    with contextlib.suppress(Exception):
        _ = zarr.open_array(path / name, mode="r")[...]
    assert mark.exists()
    mark.unlink()
    read_all(path)
    assert not mark.exists()
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        list(clsas.mosaic(LINES, GRID, path, **REQUEST))
    assert f"has been repaired: {name}: its metadata are missing" in str(found[0].message)
    assert not mark.exists()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["height", "pixels"])
@pytest.mark.parametrize(
    "entries",
    [
        {"codecs": [{"name": "vlen-utf8"}]},
        {"codecs": [{"name": "bytes", "configuration": {"endian": "big"}}, {"name": "crc32c"}]},
        {"codecs": [{"name": "no_such_module.Codec"}]},
        {"codecs": "bytes"},
        {"data_type": "string"},
        {"fill_value": 1.0},
        {"zarr_format": 2},
        {"node_type": "group"},
        {"chunk_key_encoding": {"name": "../../elsewhere"}},
        {"shape": [30, 41]},
        {"anything": {"must_understand": False}},
    ],
    ids=lambda entries: str(entries)[:40],
)
def test_zarr_never_reads_metadata_of_a_store(path, name, entries):
    image = clsas.Store.opened(path).image()
    change_metadata(path, name, **entries)
    store = clsas.Store.opened(path)
    assert list(store.array_damage()) == [name]
    np.testing.assert_array_equal(store.image().pixels, image.pixels)
    np.testing.assert_array_equal(store.grid.height_m, image.grid.height_m)


@pytest.mark.slow
def test_a_store_that_claims_more_than_memory_is_refused(path, monkeypatch):
    """A few bytes can claim 50 000 x 50 000 heights of zero."""
    side = 50_000
    monkeypatch.setattr("clsas.mosaics.levels.COARSEST_SIDE", side)
    document = json.loads((path / "zarr.json").read_text())["attributes"]
    inputs = document["inputs"] | {"pixels": [side, side]}
    change(path, inputs=inputs, patch_shape=[50, 50])
    shutil.rmtree(path / "height" / "c")
    monkeypatch.setattr(validate, "_memory_bytes", lambda: 2**30)
    store = clsas.Store.opened(path)
    for read in (lambda: store.grid, store.image, store.read):
        with pytest.raises(
            ValueError, match="must ask for at most 1 GiB, what is left of this machine's memory"
        ):
            read()


def test_a_chunk_larger_than_it_can_be_is_not_read(path, monkeypatch):
    """A sparse file takes no space on the disk."""
    with (path / "pixels" / "c" / "0" / "0").open("r+b") as file:
        file.truncate(1 << 40)
    store = clsas.Store.opened(path)
    assert list(store.damage()) == [(0, 0)]
    with pytest.raises(ValueError, match="patch 0,0"):
        store.read()


@pytest.mark.parametrize("name", ["pixels/c/1", "pixels", "patches/1.2", "patches"])
def test_a_run_writes_nowhere_else(path, tmp_path, name):
    """If a symbolic link leads a folder of the store to another place."""
    elsewhere = tmp_path / "elsewhere"
    (path / name).rename(elsewhere)
    for each in elsewhere.rglob("1.2/zarr.json" if name == "patches" else "zarr.json"):
        if name.startswith("patches"):
            each.unlink()  # to be formed again
    if name.startswith("pixels"):
        (path / "patches" / "1.2" / "zarr.json").unlink()
    (path / name).symlink_to(elsewhere)
    before = files_of(elsewhere)
    with pytest.raises(ValueError, match="must be a real folder of the store"):
        list(clsas.mosaic(LINES, GRID, path, **REQUEST))
    assert files_of(elsewhere) == before
