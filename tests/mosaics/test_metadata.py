"""Metadata, coordinates and heights of stores: damage is found and repaired."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from stores import GRID, LINES, REQUEST, change, change_metadata, files_of
from tiers import name_of, thinned

import clsas
from clsas.cli import main

ARRAYS = "pixels", "x", "y", "height"
DOCUMENTS = [f"{name}/zarr.json" for name in (*ARRAYS, "patches")]
VALUES = ["x/c/0", "y/c/0", "height/c/0/0"]


def verified(path, code):
    result = CliRunner().invoke(main, ["mosaic", "--verify", "-o", str(path)])
    assert result.exit_code == code, result.output
    found = CliRunner().invoke(main, ["mosaic", "--verify", "--json", "-o", str(path)])
    return result.stdout, json.loads(found.stdout)


def check_repaired(path, kept, name):
    """A run warns, forms no patch again and restores what was written first."""
    with pytest.warns(
        clsas.ClsasWarning, match=rf"a\.zarr was damaged and has been repaired: {name}: its"
    ):
        mosaic = clsas.mosaic(LINES, GRID, path, **REQUEST)
    assert len(mosaic.finished) == 6
    assert list(mosaic) == []
    assert files_of(path) == kept
    assert verified(path, 0)[1]["damaged_arrays"] == {}


def test_a_whole_store_has_no_damage(path):
    assert clsas.Store.opened(path).array_damage() == {}
    said, found = verified(path, 0)
    assert said == f"{path}: 6 patches match their checksums, none damaged\n"
    assert found["damaged_arrays"] == {}


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", DOCUMENTS)
def test_any_bit_of_metadata_is_found_or_plays_no_part(path, kept, name):
    chance = np.random.default_rng(3)
    whole, found = kept[Path(name)], 0
    for bit in chance.integers(0, 8 * len(whole), 60):
        content = bytearray(whole)
        content[bit // 8] ^= 1 << bit % 8
        (path / name).write_bytes(content)
        store = clsas.Store.opened(path)
        if store.array_damage():
            assert list(store.array_damage()) == [name.split("/")[0]]
            found += 1
        else:  # white space
            assert json.loads(content) == json.loads(whole)
    assert found > 20


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", VALUES)
def test_any_bit_of_coordinates_and_heights_is_found(path, kept, name):
    chance = np.random.default_rng(4)
    for bit in chance.integers(0, 8 * len(kept[Path(name)]), 12):
        content = bytearray(kept[Path(name)])
        content[bit // 8] ^= 1 << bit % 8
        (path / name).write_bytes(content)
        store = clsas.Store.opened(path)
        assert list(store.array_damage()) == [name[: name.index("/")]]
        if name.startswith("height"):  # the axes follow from the document
            for read in (store.image, store.overview, lambda store=store: store.grid):
                with pytest.raises(ValueError, match=r"damaged.*run `clsas\.mosaic` .* repair it"):
                    read()
    assert verified(path, 1)[1]["damaged_arrays"]


def test_a_flipped_separator_is_found_and_repaired(path, kept):
    """By it, Zarr would look for chunks under other names, find none and return zeros."""
    whole = clsas.Store.opened(path).read()
    document = path / "pixels" / "zarr.json"
    text = document.read_text()
    document.write_text(text.replace('"separator": "/"', '"separator": "."'))
    assert document.read_text() != text
    np.testing.assert_array_equal(clsas.Store.opened(path).read(), whole)
    said, found = verified(path, 1)
    assert "  pixels: its metadata do not match their digest" in said
    assert found["finished"] == 6
    check_repaired(path, kept, "pixels")


def remove(path):
    shutil.rmtree(path)


def empty(path):
    for chunk in path.glob("c/**/*"):
        if chunk.is_file():
            chunk.unlink()


def replace(path):
    """Because the path leads to something that is not a folder."""
    shutil.rmtree(path)
    path.write_text("")


def zeros(path):
    """With valid checksums, from another store."""
    other = np.zeros(GRID.shape if path.name == "height" else GRID.shape[path.name == "x"])
    zarr = pytest.importorskip("zarr")
    array = zarr.open_array(path, mode="r+")
    array[...] = other + 1.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("damage", "name"), thinned([remove, empty, replace, zeros], ["x", "y", "height"]), ids=name_of
)
def test_coordinates_and_heights_are_repaired(path, kept, name, damage):
    damage(path / name)
    assert list(clsas.Store.opened(path).array_damage()) == [name]
    check_repaired(path, kept, name)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("content", "name"), thinned([None, b"", b"{}", b"[1]", b"\xff", b"{" * 100_000], DOCUMENTS)
)
def test_metadata_are_repaired(path, kept, name, content):
    (path / name).unlink()
    if content is not None:
        (path / name).write_bytes(content)
    check_repaired(path, kept, name.split("/")[0])


def test_metadata_that_were_changed_elsewhere_are_found(path, kept):
    """Although an array may have attributes."""
    change_metadata(path, "height", attributes={"units": "km"})
    assert clsas.Store.opened(path).array_damage() == {
        "height": "its metadata do not match their digest"
    }
    check_repaired(path, kept, "height")


def test_a_killed_run_leaves_a_store_that_is_repaired_by_the_next(path, kept, monkeypatch):
    """Between the removal of the damaged part and the writing of the new one."""
    from clsas.mosaics import store_files

    empty(path / "height")
    remove = shutil.rmtree

    def killed(target):
        remove(target)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(store_files.shutil, "rmtree", killed)
        with pytest.raises(KeyboardInterrupt):
            clsas.mosaic(LINES, GRID, path, **REQUEST)
    assert not (path / "height/c").exists()
    check_repaired(path, kept, "height")


class TestChunksOfNoPixels:
    def test_in_metadata(self, path, kept):
        grid = {"name": "regular", "configuration": {"chunk_shape": [0, 14]}}
        change_metadata(path, "pixels", chunk_grid=grid)
        assert clsas.Store.opened(path).image().pixels.any()
        assert verified(path, 1)[1]["damaged_arrays"].keys() == {"pixels"}
        check_repaired(path, kept, "pixels")

    @pytest.mark.parametrize("name", ["x", "height"])
    def test_in_coordinates(self, path, kept, name):
        shape = [0] if name == "x" else [30, 0]
        grid = {"name": "regular", "configuration": {"chunk_shape": shape}}
        change_metadata(path, name, chunk_grid=grid)
        assert verified(path, 1)[1]["damaged_arrays"].keys() == {name}
        check_repaired(path, kept, name)

    @pytest.mark.parametrize("shape", [[0, 14], [15, 0], [-1, 14], [15], [15.0, 14], "ab", None])
    def test_in_the_document(self, path, shape):
        change(path, patch_shape=shape)
        for work in (clsas.Store.opened, lambda path: clsas.mosaic(LINES, GRID, path, **REQUEST)):
            with pytest.raises(ValueError, match=r"a\.zarr is damaged: its attributes are not"):
                work(path)


@pytest.mark.parametrize(
    "changed",
    [
        {"grid": {"origin_m": [0, 0, 0]}},
        {"grid": {"origin_m": 1, "row_step_m": [0, 1, 0], "column_step_m": [1, 0, 0]}},
        {"grid": {"origin_m": [0, 0, "a"], "row_step_m": [0, 1, 0], "column_step_m": [1, 0, 0]}},
        {"grid": []},
        {"inputs": {"parts": []}},
        {"inputs": {"parts": [], "pixels": [0, 5]}},
        {"metadata": []},
        {"metadata": None},
    ],
)
def test_a_document_of_wrong_types_is_damage(path, changed):
    change(path, **changed)
    with pytest.raises(ValueError, match=r"a\.zarr is damaged: its attributes are not those"):
        clsas.Store.opened(path)
