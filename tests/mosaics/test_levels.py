"""Levels of mosaics: right, crash-safe, found by other programs, and read by overviews."""

import functools
import shutil
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import stores
from click.testing import CliRunner
from stores import files_of, killed_at, written

import clsas
from clsas.cli import main
from clsas.engine.data.digests import grid_digest
from clsas.engine.data.grid import Grid
from clsas.mosaics import pyramid
from clsas.mosaics.document import Record, read_attributes
from clsas.mosaics.levels import Levels, aligned_side, chunk_side, levels_of
from clsas.mosaics.patches import Layout
from clsas.mosaics.store_files import StoreFiles

GRID = Grid.plane((-4, 4.3, 84), (30, 36.9, 70))
RECORD = Record(channels=1, survey_channels=1, has_pixels=True)
OF_PATCHES, MIXED, ODD = (24, 32), (20, 28), (15, 21)


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Let the small stores of these tests have chunks and levels like large ones."""
    monkeypatch.setattr("clsas.mosaics.levels.CHUNK_SIDE", 16)
    monkeypatch.setattr("clsas.mosaics.levels.COARSEST_SIDE", 16)
    monkeypatch.setattr("clsas.mosaics.levels._SMALLEST_CHUNK", 2)


def pixels_of(seed=0):
    random = np.random.default_rng(seed)
    pixels = random.normal(size=(*GRID.shape, 2)).astype(np.float32).view(np.complex64)[..., 0]
    pixels[20:40, 28:56] = 0
    return pixels


PIXELS = pixels_of()


def begun(path, patch_shape):
    store = clsas.Store.at(path)
    inputs = {"parts": [], "pixels": list(GRID.shape), "grid": grid_digest(GRID)}
    store.begin(inputs, GRID, patch_shape)
    return store


def patches_of(patch_shape):
    layout = Layout(GRID, patch_shape)
    return [layout.window(index) for index in np.ndindex(layout.shape)]


def write(store, window, pixels=PIXELS):
    store.write(
        window.row, window.column, window.rows, window.columns,
        pixels[window.rows, window.columns], RECORD,
    )  # fmt: skip


def formed(path, patch_shape, pixels=PIXELS):
    """Return a store after writing all patches and levels."""
    store = begun(path, patch_shape)
    for window in patches_of(patch_shape):
        write(store, window, pixels)
    store.complete_levels()
    return store


def finished(path, patch_shape):
    """Return a copy of a store that contains all patches and levels."""
    return clsas.Store.opened(written(path, files_of_finished(patch_shape)))


@functools.cache
def files_of_finished(patch_shape):
    with tempfile.TemporaryDirectory() as folder:
        return files_of(formed(Path(folder) / "a.zarr", patch_shape).path)


def expected(factor, pixels=PIXELS):
    """Return amplitude and mean of blocks, one by one, of the pixels that received something."""
    shape = [-(-count // factor) for count in pixels.shape]
    amplitude, mean = np.zeros(shape), np.zeros(shape, complex)
    for i, j in np.ndindex(*shape):
        block = pixels[i * factor : (i + 1) * factor, j * factor : (j + 1) * factor].astype(complex)
        if block.any():
            amplitude[i, j] = np.sqrt(np.mean(np.abs(block[block != 0]) ** 2))
            mean[i, j] = block[block != 0].mean()
    return amplitude, mean


@pytest.mark.slow
@pytest.mark.parametrize(
    ("patch_shape", "levels"),
    [
        (OF_PATCHES, Levels((2, 4, 8))),
        (MIXED, Levels((2, 4), (8,))),
        (ODD, Levels((), (2, 4, 8))),
        ((70, 84), Levels((2, 4, 8))),
    ],
)
def test_levels_are_means_of_power_and_of_pixels(tmp_path, patch_shape, levels):
    store = finished(tmp_path / "a.zarr", patch_shape)
    assert levels_of(GRID.shape, patch_shape) == levels
    assert store.levels == (2, 4, 8)
    assert max(store.pixels.chunks) <= 16
    np.testing.assert_array_equal(store.read(), PIXELS)
    for factor in store.levels:
        amplitude, mean = expected(factor)
        np.testing.assert_allclose(store.read_level(factor), amplitude, rtol=1e-6, atol=1e-12)
        coherent = store.read_level(factor, coherent=True)
        np.testing.assert_allclose(coherent, mean, rtol=1e-5, atol=1e-7)
    part = slice(3, 8), slice(1, 9)
    np.testing.assert_array_equal(store.read_level(4, *part), store.read_level(4)[part])
    assert not store.damage()
    assert not store.array_damage()


@pytest.mark.parametrize("patch_shape", [OF_PATCHES, ODD])
def test_pixels_that_nothing_reached_leave_seams_as_bright_as_the_rest(tmp_path, patch_shape):
    """A seam within blocks, and an edge of whole blocks of level 2; the rest has the power 1."""
    pixels = np.exp(1j * np.random.default_rng(1).uniform(0, 9, GRID.shape)).astype(np.complex64)
    pixels[:, 29] = pixels[:2] = 0
    store = formed(tmp_path / "a.zarr", patch_shape, pixels)
    for factor in store.levels:
        level = store.read_level(factor)
        np.testing.assert_allclose(level[1 if factor == 2 else 0 :], 1.0, rtol=1e-6)
    assert not store.read_level(2)[0].any()
    for most in (30, 28):
        shown = np.abs(store.overview(most).pixels)
        np.testing.assert_allclose(shown, 1.0, rtol=1e-6)


@pytest.mark.parametrize("scale", [1e-30, 1e30])
def test_powers_beyond_single_precision_are_kept(scale):
    pixels = (scale * PIXELS).astype(np.complex64)
    found = pyramid.pyramid({"pixels": pixels, "amplitude": np.abs(pixels)}, (2, 4), None)
    np.testing.assert_allclose(found[4]["amplitude"], scale * expected(4)[0], rtol=1e-6)
    np.testing.assert_allclose(found[4]["pixels"], scale * expected(4)[1], rtol=1e-4)


@pytest.mark.exhaustive
@pytest.mark.parametrize("patch_shape", [MIXED, ODD])
def test_a_store_killed_at_any_step_ends_bit_identical(tmp_path, monkeypatch, patch_shape):
    """While a patch is written anew with other pixels, or while levels are computed."""
    whole = files_of(finished(tmp_path / "whole.zarr", patch_shape).path)
    start, path = tmp_path / "start.zarr", tmp_path / "a.zarr"
    store = formed(start, patch_shape, pixels_of(1))
    first, *others = patches_of(patch_shape)
    for window in others:
        write(store, window)
    step, kills, is_killed = 0, 0, True
    while is_killed:
        shutil.rmtree(path, ignore_errors=True)
        shutil.copytree(start, path)
        store = clsas.Store.opened(path)

        def work(store=store):
            write(store, first)
            store.complete_levels()

        is_killed = killed_at(monkeypatch, step, work)
        kills += is_killed
        step += 1 if step < 8 else 4
        again = begun(path, patch_shape)
        assert not again.damage()
        assert not again.array_damage()
        if (0, 0) not in again.records():
            write(again, first)
        again.complete_levels()
        assert files_of(path) == whole
    assert kills > 8


@pytest.mark.slow
def test_patches_can_be_written_side_by_side(tmp_path):
    one = finished(tmp_path / "one.zarr", MIXED)
    store = begun(tmp_path / "many.zarr", MIXED)
    with ThreadPoolExecutor(8) as threads:
        list(
            threads.map(
                lambda window: write(clsas.Store.opened(store.path), window),
                reversed(patches_of(MIXED)),
            )
        )
    store.complete_levels()
    assert files_of(store.path) == files_of(one.path)


def test_levels_that_mix_patches_follow_the_patches(tmp_path):
    store = finished(tmp_path / "a.zarr", MIXED)
    assert not store.complete_levels()  # there already
    other = pixels_of(1)
    for window in patches_of(MIXED):
        write(store, window, other)
    assert store.levels == (2, 4)  # the others are not those of the patches
    np.testing.assert_allclose(
        np.abs(store.overview(11).pixels), expected(8, other)[0][:8, :10], rtol=1e-6
    )
    assert store.complete_levels()
    assert store.levels == (2, 4, 8)
    np.testing.assert_allclose(store.read_level(8), expected(8, other)[0], rtol=1e-6)


def test_records_are_read_again_only_if_they_have_changed(tmp_path, monkeypatch):
    finished(tmp_path / "a.zarr", MIXED)
    store, read, count = clsas.Store.opened(tmp_path / "a.zarr"), Record.read, []

    def counted(folder):
        count.append(folder.name)
        return read(folder)

    monkeypatch.setattr(Record, "read", counted)
    assert store.levels == (2, 4, 8)
    patches = len(patches_of(MIXED))
    assert len(count) == patches
    for _ in range(3):
        store.read_level(8)
    assert len(count) == patches
    # Another process forms a patch again.
    other, changed = clsas.Store.opened(tmp_path / "a.zarr"), patches_of(MIXED)[5]
    write(other, changed, 2 * PIXELS)
    count.clear()
    assert store.levels == (2, 4)
    assert count == [f"{changed.row}.{changed.column}"]
    other.complete_levels()
    assert store.levels == (2, 4, 8)
    shutil.rmtree(tmp_path / "a.zarr" / "patches" / "1.1")
    assert store.levels == (2, 4)


@pytest.mark.slow
def test_the_overview_reads_the_level_that_makes_up_its_pixels(tmp_path, monkeypatch):
    store = finished(tmp_path / "a.zarr", OF_PATCHES)
    plain = {}
    with monkeypatch.context() as patch:
        patch.setattr(clsas.Store, "levels", ())
        for most in (42, 21, 12, 7):
            plain[most] = store.overview(most)
        windows = [slice(8, 70)], [slice(3, 70)], [slice(0, 70, 2), slice(0, 84, 3)]
        parts = [store.overview(12, *window) for window in windows]
    read = []

    def recorded(self, name, *window):
        read.append(name)
        return unrecorded(self, name, *window)

    unrecorded = StoreFiles.read
    monkeypatch.setattr(StoreFiles, "read", recorded)
    for most, image in plain.items():
        read.clear()
        ours = store.overview(most)
        assert set(read) == {{42: "2x", 21: "4x", 12: "8x", 7: "4x"}[most] + "/amplitude"}
        if most == 12:  # 8 pixels a side instead of 7
            assert ours.shape == (8, 10)
            np.testing.assert_allclose(np.abs(ours.pixels), expected(8)[0][:8, :10], rtol=1e-6)
        else:
            np.testing.assert_allclose(np.abs(ours.pixels), np.abs(image.pixels), rtol=1e-6)
            np.testing.assert_allclose(ours.grid.positions_m(), image.grid.positions_m())
    read.clear()
    assert store.overview(28).shape == (17, 21)  # 4 pixels a side instead of 3, which no level has
    assert set(read) == {"4x/amplitude"}
    read.clear()
    assert store.overview(12, *windows[0]).shape == (7, 10)
    assert set(read) == {"8x/amplitude"}
    read.clear()
    for window, image in zip(windows[1:], parts[1:], strict=True):
        np.testing.assert_allclose(store.overview(12, *window).pixels, image.pixels, rtol=1e-6)
    assert set(read) == {"pixels"}  # the part begins within a pixel of a level, or lacks pixels


@pytest.mark.slow
@pytest.mark.parametrize("name", ["2x/pixels/c/1/1", "4x/amplitude/c/1/1", "pixels/c/3/2"])
def test_damaged_chunks_of_patches_are_found(tmp_path, name):
    store = finished(tmp_path / "a.zarr", OF_PATCHES)
    chunk = store.path / name
    content = bytearray(chunk.read_bytes())
    content[5] ^= 1
    chunk.write_bytes(content)
    assert list(store.damage()) == [(1, 1)]
    kind = "pixels" if name.startswith("pixels") else f"values of {name.split('/c/')[0]}"
    assert store.damage()[1, 1] == f"its {kind} do not match their checksum"
    factor = 1 if kind == "pixels" else int(name[0])
    with pytest.raises(ValueError, match=r"a\.zarr is damaged: patch 1,1: its .* their checksum"):
        store.read() if factor == 1 else store.read_level(factor, coherent="pixels" in name)
    chunk.unlink()
    assert store.damage()[1, 1] == f"its {kind} are gone"
    assert (1, 1) not in store.records()


def test_damaged_levels_that_mix_patches_are_computed_again(tmp_path):
    store = finished(tmp_path / "a.zarr", MIXED)
    whole = files_of(store.path)
    chunk = store.path / "8x/amplitude/c/0/0"
    chunk.write_bytes(b"\1" + chunk.read_bytes()[1:])
    assert not store.damage()
    assert store.array_damage() == {"8x/amplitude": "its values do not match their checksum"}
    with pytest.raises(ValueError, match=r"8x/amplitude: .*; run `clsas\.mosaic`"):
        store.overview(11)
    with pytest.warns(clsas.ClsasWarning, match="these levels are computed again: 8x/amplitude"):
        store = begun(store.path, MIXED)
    assert store.complete_levels()
    assert files_of(store.path) == whole
    chunk.unlink()
    assert store.levels == (2, 4)
    assert list(store.array_damage()) == ["8x/amplitude"]
    assert store.complete_levels()
    assert files_of(store.path) == whole


@pytest.mark.parametrize("kind", ["a bit", "a digit", "cut", "empty", "another record"])
@pytest.mark.parametrize("patch_shape", [MIXED, ODD], ids=["some levels", "all levels"])
def test_a_damaged_record_of_levels_is_reported(tmp_path, patch_shape, kind):
    store = finished(tmp_path / "a.zarr", patch_shape)
    whole, record = files_of(store.path), store.path / "levels/zarr.json"
    content = bytearray(record.read_bytes())
    at = content.index(b"8x/amplitude") + 18
    match kind:
        case "a bit":
            content[at] ^= 2
        case "a digit":
            content[at] = ord("0") if content[at] != ord("0") else ord("1")
        case "cut":
            del content[-9:]
        case "empty":
            content.clear()
        case "another record":
            content[:] = whole[Path("patches/0.0/zarr.json")]
    record.write_bytes(content)
    assert list(store.array_damage()) == ["levels"]
    verified = CliRunner().invoke(main, ["mosaic", "--verify", "-o", str(store.path)])
    assert verified.exit_code == 1
    assert "levels: its record" in verified.output
    with pytest.raises(ValueError, match=r"damaged: levels: its record .*; run `clsas\.mosaic`"):
        store.read_level(8)
    with pytest.warns(clsas.ClsasWarning, match="these levels are computed again: levels: its"):
        store = begun(store.path, patch_shape)
    assert store.complete_levels()
    assert files_of(store.path) == whole


def test_levels_of_other_patches_are_not_damaged(tmp_path):
    store = finished(tmp_path / "a.zarr", MIXED)
    write(store, patches_of(MIXED)[0], pixels_of(1))
    assert not store.array_damage()
    assert store.complete_levels()


def test_numbers_of_other_programs_that_are_not_finite_are_refused(tmp_path, monkeypatch):
    """Zarr gives them checksums as good as any."""
    store = finished(tmp_path / "a.zarr", OF_PATCHES)
    pixels = PIXELS.copy()
    pixels[3, 5] = np.nan
    checked = clsas.engine.data.validate.array
    with monkeypatch.context() as patch:
        patch.setattr(
            "clsas.engine.data.validate.array",
            lambda name, value, *rest, **options: (
                value if name == "pixels" else checked(name, value, *rest, **options)
            ),
        )
        write(store, patches_of(OF_PATCHES)[0], pixels)
    assert not store.damage()
    with pytest.raises(ValueError, match=r"a\.zarr must have finite numbers, .* pixels"):
        store.read(slice(0, 8))
    with pytest.raises(ValueError, match=r"a\.zarr must have finite numbers, .* 2x/amplitude"):
        store.read_level(2)
    np.testing.assert_array_equal(store.read(slice(40, 70)), PIXELS[40:])


@pytest.mark.parametrize("name", ["4x", "8x/amplitude", "8x/x", "overview_y", "amplitude_db"])
def test_metadata_of_levels_are_repaired(tmp_path, name):
    store = finished(tmp_path / "a.zarr", MIXED)
    whole = files_of(store.path)
    (store.path / name / "zarr.json").write_text("{}")
    assert list(store.array_damage()) == [name]
    with pytest.warns(clsas.ClsasWarning, match=f"has been repaired: {name}: its metadata"):
        begun(store.path, MIXED)
    assert files_of(store.path) == whole


@pytest.mark.slow
def test_a_mosaic_forms_levels(tmp_path):
    new = clsas.mosaic(stores.LINES, stores.GRID, tmp_path / "new.zarr", **stores.REQUEST)
    assert new.patch_shape == (16, 16)
    image = new.image()
    store = clsas.Store.opened(tmp_path / "new.zarr")
    assert store.levels == (2, 4)
    for factor in store.levels:
        amplitude = expected(factor, image.pixels)[0]
        np.testing.assert_allclose(store.read_level(factor), amplitude, rtol=1e-6)


class TestOtherPrograms:
    def test_xarray_plots_amplitudes_in_db_at_once(self, tmp_path):
        xarray = pytest.importorskip("xarray")
        store = finished(tmp_path / "a.zarr", MIXED)
        data = xarray.open_zarr(store.path, consolidated=False)
        assert data.amplitude_db.dims == ("overview_y", "overview_x")
        assert data.amplitude_db.attrs["units"] == "dB"
        amplitude = np.where(expected(8)[0] > 0, expected(8)[0], np.nan)
        np.testing.assert_allclose(data.amplitude_db, 20 * np.log10(amplitude), atol=1e-4)
        pyplot = pytest.importorskip("matplotlib.pyplot")
        assert data.amplitude_db.plot() is not None
        pyplot.close()
        level = xarray.open_zarr(store.path, group="4x", consolidated=False)
        np.testing.assert_allclose(level.amplitude, expected(4)[0], rtol=1e-6)
        middles = [np.mean(GRID.axes_m[0][i : i + 4]) for i in range(0, 84, 4)]
        np.testing.assert_allclose(level.x, middles)
        np.testing.assert_allclose(level.pixels.isel(x=2), expected(4)[1][:, 2], rtol=1e-5)

    def test_what_was_not_received_is_nan(self, tmp_path):
        xarray = pytest.importorskip("xarray")
        store = begun(tmp_path / "a.zarr", OF_PATCHES)
        write(store, patches_of(OF_PATCHES)[0], np.where(np.arange(84) < 16, PIXELS, 0))
        level = xarray.open_zarr(store.path, consolidated=False).amplitude_db.values
        assert np.isfinite(level[:3, :2]).all()
        assert np.isnan(level[:3, 2:]).all()
        assert np.isnan(level[3:]).all()

    def test_the_layout_is_that_of_the_convention(self, tmp_path):
        """As GDAL writes it: the mosaic's array, then a group for each level."""
        store = finished(tmp_path / "a.zarr", MIXED)
        attributes = read_attributes(store.path)
        assert attributes["zarr_conventions"][0]["name"] == "multiscales"
        layout = attributes["multiscales"]["layout"]
        assert [each["asset"] for each in layout] == ["pixels", "2x", "4x", "8x"]
        assert [each.get("derived_from") for each in layout] == [None, "pixels", "2x", "4x"]
        for each in layout[1:]:
            assert each["transform"]["scale"] == [2.0, 2.0]
            assert (store.path / each["asset"] / "pixels" / "zarr.json").exists()


def test_patches_and_chunks_of_large_mosaics(monkeypatch):
    monkeypatch.undo()
    for pixels, count, side, chunk in [
        (20_000, 5, 4000, 1000),
        (20_001, 5, 4032, 1008),
        (20_000, 8, 2528, 632),
        (20_000, 64, 316, 316),  # multiples of 8 would be 63 patches
        (20_011, 1, 20_032, 1001),
        (900, 7, 129, 129),
    ]:
        found = aligned_side(-(-pixels // count), count, pixels, 32 if pixels > 900 else 1)
        assert (found, -(-pixels // found)) == (side, count)
        assert chunk_side(found, pixels) == chunk


def test_a_factor_without_a_level_is_refused(tmp_path):
    store = finished(tmp_path / "a.zarr", MIXED)
    with pytest.raises(
        ValueError, match=r"factor must be that of a level of .* \(2, 4, 8\), got 3"
    ):
        store.read_level(3)
