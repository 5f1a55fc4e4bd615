"""Stores on disk: damage is found, writes are durable, older versions are refused."""

import json
import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cases import along_x, lines_over
from click.testing import CliRunner
from stores import change

import clsas
from clsas.cli import main
from clsas.engine.data.georeference import Georeference
from clsas.engine.data.grid import Grid
from clsas.mosaics.document import Document, read_attributes
from clsas.mosaics.store import Store

GRID = Grid.plane((-4, 4, 40), (30, 40, 30))
LINES = lines_over(GRID, along_x(60, 0.1), carrier_hz=100e3, step_m=0.03)
REQUEST = {"accuracy_db": -50, "beam": clsas.BeamWindow(8.0, "hann"), "patches": (2, 3)}
CHUNK = Path("pixels/c/1/2")
RECORD = Path("patches/1.2/zarr.json")


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """The files of a store, by path in it."""
    path = tmp_path_factory.mktemp("kept") / "a.zarr"
    list(clsas.mosaic(LINES, GRID, path, **REQUEST))
    return {each.relative_to(path): each.read_bytes() for each in path.rglob("*") if each.is_file()}


@pytest.fixture
def path(kept, tmp_path):
    """A copy of the store that a test may damage."""
    for name, content in kept.items():
        (tmp_path / "a.zarr" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "a.zarr" / name).write_bytes(content)
    return tmp_path / "a.zarr"


def flip(path, bit):
    content = bytearray(path.read_bytes())
    content[bit // 8] ^= 1 << bit % 8
    path.write_bytes(content)


def zero(path):
    path.write_bytes(bytes(path.stat().st_size))


def check_repaired(path, kept):
    """A run warns, forms the one damaged patch and ends with the same pixels."""
    with pytest.warns(clsas.ClsasWarning, match=r"a\.zarr is damaged; .* again: patch 1,2: its"):
        mosaic = clsas.mosaic(LINES, GRID, path, **REQUEST)
    assert [(patch.row, patch.column) for patch in mosaic] == [(1, 2)]
    assert not Store.opened(path).damage()
    for name, content in kept.items():
        if name.parts[:2] == ("pixels", "c"):
            assert (path / name).read_bytes() == content


def test_all_is_well_of_a_whole_store(path, kept):
    assert not Store.opened(path).damage()
    assert len(clsas.mosaic(LINES, GRID, path, **REQUEST).finished) == 6


@pytest.mark.parametrize(
    "damage",
    [
        lambda path: flip(path, 0),
        lambda path: flip(path, 8 * path.stat().st_size - 40),  # in the last pixel
        lambda path: flip(path, 8 * path.stat().st_size - 1),  # in the checksum
        zero,
        lambda path: path.write_bytes((path.parent / "1").read_bytes()),  # of another patch
        lambda path: path.unlink(),
    ],
    ids=["first bit", "last bit", "checksum", "zeroed", "exchanged", "gone"],
)
def test_damaged_pixels_are_found_and_formed_again(path, kept, damage):
    damage(path / CHUNK)
    store = Store.opened(path)
    assert list(store.damage()) == [(1, 2)]
    for read in (store.image, store.read, store.overview, lambda: store.image(slice(20, None))):
        with pytest.raises(ValueError, match="patch 1,2: its pixels"):
            read()
    assert store.image(slice(0, 15)).pixels.any()  # the other patches can be read
    check_repaired(path, kept)


def test_a_finished_mosaic_does_not_hand_out_damage(path):
    """Even if the damage occurred after the store was verified."""
    mosaic = clsas.mosaic(LINES, GRID, path, **REQUEST)
    flip(path / CHUNK, 1000)
    with pytest.raises(ValueError, match="patch 1,2: its pixels do not match their checksum"):
        mosaic.image()


@pytest.mark.exhaustive
def test_any_bit_of_a_record_is_found_or_plays_no_part(path, kept):
    chance = np.random.default_rng(1)
    expected = read_attributes((path / RECORD).parent)
    found = 0
    for bit in chance.integers(0, 8 * len(kept[RECORD]), 300):
        (path / RECORD).write_bytes(kept[RECORD])
        flip(path / RECORD, int(bit))
        store = Store.opened(path)
        if store.damage():
            found += 1
            assert (1, 2) not in store.records()
        else:  # white space, or the part of the document that belongs to Zarr
            assert read_attributes((path / RECORD).parent) == expected
    assert found > 200
    (path / RECORD).write_bytes(kept[RECORD].replace(b'"channels": ', b'"channels": 1'))
    check_repaired(path, kept)


@pytest.mark.slow
def test_any_bit_of_the_document_is_found_or_plays_no_part(path, kept):
    name, chance = "zarr.json", np.random.default_rng(2)
    whole = Store.opened(path).image()
    found = 0
    for bit in chance.integers(0, 8 * len(kept[Path(name)]), 200):
        (path / name).write_bytes(kept[Path(name)])
        flip(path / name, int(bit))
        try:
            image = Store.opened(path).image()
        except ValueError:
            found += 1
            continue
        np.testing.assert_array_equal(image.pixels, whole.pixels)
        np.testing.assert_array_equal(image.grid.positions_m(), whole.grid.positions_m())
    assert found > 20


def test_a_damaged_height_map_is_found(tmp_path):
    grid = GRID.with_height(np.linspace(0, 1, GRID.size).reshape(GRID.shape))
    list(clsas.mosaic(LINES, grid, tmp_path / "a.zarr", **REQUEST))
    store = Store.opened(tmp_path / "a.zarr")
    np.testing.assert_array_equal(store.image().grid.height_m, grid.height_m)
    (chunk,) = [each for each in (tmp_path / "a.zarr/height/c").rglob("*") if each.is_file()]
    flip(chunk, 500)
    with pytest.raises(
        ValueError, match=r"a\.zarr is damaged: height: its values do not match their checksum"
    ):
        _ = store.grid


def test_a_store_without_checksums_is_refused_by_its_version(path):
    document = json.loads((path / "zarr.json").read_text())
    document["attributes"]["version"] = 1
    (path / "zarr.json").write_text(json.dumps(document))
    for work in (Store.opened, lambda path: clsas.mosaic(LINES, GRID, path, **REQUEST)):
        with pytest.raises(ValueError, match="version 1, but this clsas works with version 8"):
            work(path)


def test_pixels_reach_the_disk_before_the_record_has_its_name(tmp_path, monkeypatch):
    list(clsas.mosaic(LINES, GRID, tmp_path / "a.zarr", **REQUEST))
    events = []
    sync, rename = os.fsync, os.replace

    def synced(descriptor):
        events.append(("sync", os.readlink(f"/proc/self/fd/{descriptor}")))
        sync(descriptor)

    def renamed(source, target):
        events.append(("name", str(source), str(target)))
        rename(source, target)

    store = Store.opened(tmp_path / "a.zarr")
    pixels, record = store.read(slice(15, 30), slice(28, 42)), store.records()[1, 2]
    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(os, "replace", renamed)
    store.write(1, 2, slice(15, 30), slice(28, 42), pixels, record)
    files = [str(store.path / name) for name in (CHUNK, "amplitude_db/c/1/2", RECORD)]
    names = [event for event in events if event[0] == "name"]
    assert [target for _, _, target in names] == files
    order = [("sync", os.path.dirname(files[-1]))]  # the former record is removed
    for event, file in zip(names, files, strict=True):
        order += [("sync", event[1]), event, ("sync", os.path.dirname(file))]
    assert events == order


def test_a_patch_that_is_written_anew_has_no_record_meanwhile(path, monkeypatch):
    """A run that is killed in between must not leave the old record with new pixels."""
    store = Store.opened(path)
    record = store.records()[1, 2]

    def killed(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("clsas.mosaics.store_files.StoreFiles._write_chunks", killed)
    with pytest.raises(KeyboardInterrupt):
        store.write(1, 2, slice(15, 30), slice(28, 42), np.ones((15, 12), np.complex64), record)
    assert (1, 2) not in store.records()
    assert not store.damage()


def test_a_refused_write_leaves_the_patch(path, kept):
    store = Store.opened(path)
    rows, columns = (slice(0, n) for n in store.pixels.chunks)
    pixels, record = store.read(rows, columns), store.records()[0, 0]
    with pytest.raises(ValueError, match="columns must be a slice with a step from 1"):
        store.write(0, 0, rows, slice(None, None, -1), pixels, record)
    test_all_is_well_of_a_whole_store(path, kept)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"parts": None}, "inputs must have a list 'parts', got None"),
        ({"parts": "abc"}, "inputs must have a list 'parts', got 'abc'"),
        (
            {"pixels": None},
            r"inputs must have 'pixels' \[30, 40\], the shape of the grid, got None",
        ),
        ({"pixels": [40, 30]}, r"inputs must have 'pixels' \[30, 40\], .* got \[40, 30\]"),
        ({"pixels": [30.0, 40]}, r"inputs must have 'pixels' \[30, 40\], .* got \[30.0, 40\]"),
    ],
)
def test_inputs_that_are_not_those_of_a_mosaic_are_refused(path, kept, tmp_path, changed, message):
    store = Store.opened(path)
    inputs = Document.read(path).inputs | changed
    given = {name: value for name, value in inputs.items() if value is not None}
    new = Store.at(tmp_path / "new.zarr")
    for accept in (lambda: new.begin(given, GRID, (15, 14)), lambda: store.grow(given)):
        with pytest.raises(ValueError, match=message):
            accept()
    assert not new.path.exists()
    test_all_is_well_of_a_whole_store(path, kept)


@pytest.mark.parametrize("folder", ["pixels/c/1", "patches/1.2", "."])
def test_leftovers_of_killed_runs_are_removed(path, folder):
    (path / RECORD).unlink()
    left = path.parent if folder == "." else path / folder
    (left / ".clsas-0.part").write_text("half")
    (path.parent / ".clsas-1.part").mkdir()
    if folder == ".":
        clsas.save(path.parent / "lines.h5", LINES)
        assert not list(path.parent.glob(".clsas-*"))
    else:
        list(clsas.mosaic(LINES, GRID, path, **REQUEST))
        assert not list(path.rglob(".clsas-*"))


def test_other_software_verifies_pixels_too(path):
    zarr = pytest.importorskip("zarr")
    flip(path / CHUNK, 77)
    with pytest.raises(ValueError, match="checksum"):
        _ = zarr.open_array(path / "pixels", mode="r")[:]


def test_the_digest_is_as_described(path):
    """In the way that docs/mosaic.md describes for other software."""
    import hashlib

    attributes = json.loads((path / RECORD).read_text())["attributes"]
    expected = attributes.pop("digest")
    text = json.dumps(attributes, sort_keys=True)
    assert expected == hashlib.sha256(text.encode()).hexdigest()[:16]
    assert attributes["pixels_crc32c"] == (path / CHUNK).read_bytes()[-4:].hex()


class TestCommand:
    @staticmethod
    def run(*arguments, code):
        result = CliRunner().invoke(main, ["mosaic", *map(str, arguments)])
        assert result.exit_code == code, result.output
        return result.stdout

    def test_verify(self, path):
        scene = path.with_suffix(".toml")  # the store beside it is the default
        scene.write_text("")
        assert "6 patches match their checksums, none damaged" in self.run(
            scene, "--verify", code=0
        )
        zero(path / CHUNK)
        (path / "patches/0.0/zarr.json").write_text("{")
        before = {each: each.stat().st_mtime_ns for each in path.rglob("*")}
        said = self.run(scene, "--verify", "-o", path, code=1)
        assert "4 patches match their checksums, 2 damaged" in said
        assert "  patch 0,0: its record cannot be read" in said
        assert "  patch 1,2: its pixels" in said
        found = json.loads(self.run(scene, "--verify", "--json", code=1))
        assert list(found["damaged"]) == ["0,0", "1,2"]
        assert {each: each.stat().st_mtime_ns for each in path.rglob("*")} == before

    def test_verify_without_a_store(self, tmp_path):
        (tmp_path / "a.toml").write_text("")
        result = CliRunner().invoke(main, ["mosaic", str(tmp_path / "a.toml"), "--verify"])
        assert result.exit_code == 1
        assert result.stderr == f"Error: there is no mosaic: {tmp_path / 'a.zarr'}\n"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:no pixel of the grid")
def test_the_snippets_of_the_documentation_run_where_patches_are_unseen(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    clsas.save("lines.h5", LINES)
    text = (Path(__file__).parents[2] / "docs" / "mosaic.md").read_text()
    found = re.findall(r"```python\n(.*?)```", text, re.S)
    # Others need a cluster, or lines of two banks (tests/mosaics/test_height_mosaic.py).
    snippets = [s for s in found if "Client" not in s and "mosaic_heights" not in s]
    assert len(snippets) == 6
    pytest.importorskip("xarray")
    # Few pixels, most of them beyond the track and the recorded ranges.
    small = snippets[0].replace("(0, 500, 10001)", "(0, 500, 56)")
    small = small.replace("(30, 130, 2001)", "(30, 130, 48)").replace(
        "tol", "certificate=True, patches=(2, 5), tol"
    )
    names = {"lines": LINES}
    part = snippets[5].replace("slice(2000, 3000)", "slice(20, 30)")
    for snippet in (small, *snippets[1:5], part):
        exec(snippet, names)
    pytest.importorskip("matplotlib.pyplot").close()  # of what xarray plotted
    records = Store.opened("image.zarr").records().values()
    assert {record.has_pixels for record in records} == {True, False}
    assert names["worst"] <= -40


@pytest.mark.parametrize("make", [os.mkfifo, lambda chunk: chunk.symlink_to("/dev/zero")])
def test_a_pipe_or_device_in_place_of_a_chunk_is_refused(path, make):
    """Reading a pipe would never end."""
    chunk = next(each for each in sorted((path / "pixels" / "c").rglob("*")) if each.is_file())
    chunk.unlink()
    make(chunk)
    with pytest.raises(ValueError, match="must be an ordinary file, got a"):
        _ = clsas.Store.opened(path).pixels[:]
    damaged = clsas.Store.opened(path).damage()
    assert len(damaged) == 1
    assert "must be an ordinary file" in next(iter(damaged.values()))


def test_patches_that_do_not_fit_in_memory_leave_no_store(path, tmp_path):
    grid = Grid.plane((-1, 1, 2_000_000), (9, 11, 2_000_000))
    inputs = Document.read(path).inputs | {"pixels": list(grid.shape)}
    new = Store.at(tmp_path / "new.zarr")
    with pytest.raises(ValueError, match="a patch of pixels must ask for at most"):
        new.begin(inputs, grid, grid.shape)
    assert not new.path.exists()


def test_a_store_keeps_the_place_and_refuses_another(tmp_path):
    utm = Georeference(crs="EPSG:32632")
    path, places = tmp_path / "placed.zarr", {"utm": utm, "none": None}
    grids = {name: replace(GRID, georeference=place) for name, place in places.items()}
    clsas.mosaic(replace(LINES, georeference=utm), grids["none"], path, **REQUEST)
    store = Store.opened(path)
    assert store.grid.georeference == utm
    assert store.overview(8).georeference == utm
    url = "http://www.opengis.net/def/crs/EPSG/0/32632"
    assert store.pixels.attrs["_CRS"] == {"url": url}
    assert clsas.mosaic(LINES, grids["utm"], path, **REQUEST).grid.georeference == utm
    with pytest.raises(ValueError, match=r"`georeference` is set in the store, not set here"):
        clsas.mosaic(LINES, grids["none"], path, **REQUEST)


def test_a_store_of_an_early_version_has_no_place(path):
    inputs = Document.read(path).inputs
    change(path, inputs={name: inputs[name] for name in inputs if name != "georeference"})
    assert Store.opened(path).grid.georeference is None
    assert len(clsas.mosaic(LINES, GRID, path, **REQUEST).finished) == 6
