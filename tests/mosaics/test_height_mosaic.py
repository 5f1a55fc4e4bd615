"""Mosaics of heights against single measurements, after kills, with damage, and at fewer pixels."""

import pickle
import shutil
import signal
import subprocess
import sys
import textwrap
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from reliefs import banks, flat_banks, truth
from scipy.ndimage import uniform_filter
from stores import files_of, killed_at
from tiers import also

import clsas
from clsas.engine.data.digests import grid_digest
from clsas.engine.data.validate import ClsasWarning
from clsas.mosaics import pyramid
from clsas.mosaics.document import Document, Record
from clsas.mosaics.levels import LAYERS, SHADOWED
from clsas.mosaics.patches import Layout

GRID = clsas.Grid.plane((-0.6, 0.6, 61), (31.2, 32.8, 81))
REQUEST = {"search_m": (-0.5, 0.5), "window_m": 0.22, "patch_m": 0.7}
SMALL = clsas.Grid.plane((-4, 4.3, 84), (30, 36.9, 70))
OF_PATCHES, MIXED = (24, 32), (20, 28)
WINDOW = 5, 7


@pytest.fixture
def small(monkeypatch):
    """Let small stores have chunks and levels like large ones."""
    monkeypatch.setattr("clsas.mosaics.levels.CHUNK_SIDE", 16)
    monkeypatch.setattr("clsas.mosaics.levels.COARSEST_SIDE", 16)
    monkeypatch.setattr("clsas.mosaics.levels._SMALLEST_CHUNK", 2)


def apart(one, other):
    """Difference of heights in standard deviations, where both are valid."""
    both = one.mask & other.mask
    return np.where(both, (one.height_m - other.height_m) / other.sd_m, np.nan)


def borders(shape, patch_shape, width):
    """The pixels within `width` of a border between patches."""
    found = np.zeros(shape, bool)
    for axis, side in enumerate(patch_shape):
        for place in range(side, shape[axis], side):
            index = [slice(None), slice(None)]
            index[axis] = slice(place - width, place + width)
            found[tuple(index)] = True
    return found


@pytest.mark.exhaustive
def test_patches_make_the_heights_of_a_single_measurement(tmp_path):
    def dunes(x, y):
        return 0.15 * np.sin(2 * np.pi * (y - 32) / 3) + 0.05 * x

    grid = clsas.Grid.plane((-1.2, 1.2, 121), (30.4, 33.2, 141))
    lines = banks(dunes, snr_db=15, extent_m=((-1.9, 1.9), (29, 35)), pings=240)
    request = {"search_m": (-1.0, 1.0), "window_m": 0.22}
    store = clsas.mosaic_heights(*lines, grid, tmp_path / "a.zarr", **request, patch_m=0.95)
    assert len(store.records()) == 9
    found, whole = store.heights(), clsas.heights(*lines, grid, **request)
    assert np.mean(found.mask != whole.mask) < 0.04
    difference = apart(found, whole)
    border = borders(grid.shape, store.patch_shape, 3)
    for some in (border, ~border):
        assert np.sqrt(np.nanmean(difference[some] ** 2)) < 0.3
        ratio = (found.sd_m / whole.sd_m)[some & found.mask & whole.mask]
        assert np.median(ratio) == pytest.approx(1, abs=0.05)
    # Neighbours across a border differ no more than elsewhere.
    for axis, side in enumerate(store.patch_shape):
        steps = np.abs(np.diff(found.height_m, axis=axis) / np.delete(found.sd_m, -1, axis=axis))
        at = np.arange(side, grid.shape[axis], side) - 1
        assert np.nanmean(np.take(steps, at, axis=axis)) < 1.5 * np.nanmean(steps)
    error_m = (found.height_m - truth(dunes, grid))[found.mask]
    rms_m, predicted_m = (np.sqrt(np.mean(e**2)) for e in (error_m, found.sd_m[found.mask]))
    assert rms_m < 1.3 * predicted_m


@pytest.mark.slow
def test_a_store_has_what_heights_have(tmp_path):
    place = clsas.Georeference.local(60.39, 5.32, heading_deg=90)
    first, second = (replace(lines, georeference=place) for lines in flat_banks())
    calls = []
    store = clsas.mosaic_heights(
        first, second, GRID, tmp_path / "a.zarr", **REQUEST,
        progress=lambda *done: calls.append(done),
    )  # fmt: skip
    assert calls == [(done, 6) for done in range(7)]
    assert store.layers == (*LAYERS, *SHADOWED)
    assert store.patch_shape == (27, 31)
    found, whole = store.heights(), clsas.heights(first, second, GRID, **{
        name: REQUEST[name] for name in ("search_m", "window_m")
    })  # fmt: skip
    assert found.georeference == place
    assert found.window_m == 0.22
    assert found.mask.mean() > 0.95
    assert np.nanmax(np.abs(apart(found, whole))) < 0.5
    for name in ("coherence", "looks", "m_per_rad"):
        ratio = (getattr(found, name) / getattr(whole, name))[found.mask & whole.mask]
        assert np.median(ratio) == pytest.approx(1, abs=0.05)
    part = store.heights(slice(10, 60), slice(3, 40))
    assert np.array_equal(part.height_m, found.height_m[10:60, 3:40], equal_nan=True)
    # The image lies on the relief, whose heights are those of the seabed where it is known.
    relief_m = part.image.grid.height_m
    assert np.array_equal(relief_m[part.mask], part.height_m[part.mask])
    assert np.array_equal(store.image(slice(10, 60), slice(3, 40)).pixels, part.image.pixels)
    record = store.records()[0, 0]
    assert record.heights["valid"] == pytest.approx(found.mask[:27, :31].mean())
    assert record.heights["ambiguity_m"] == pytest.approx(2.06, rel=0.05)
    assert not record.flags


def halves_of(first, second):
    """Lines of both banks, pings after each other, in two halves."""
    both = replace(
        first,
        samples=np.concatenate([first.samples, second.samples]),
        bank_numbers=np.repeat([0, 1], first.channels),
        **{
            name: np.concatenate([getattr(first, name), getattr(second, name)])
            for name in ("first_range_m", "tx_m", "rx_m")
        },
    )
    order = np.arange(2 * first.channels).reshape(2, -1).T.reshape(-1)
    return [both.select(some) for some in np.split(order, 2)]


@pytest.mark.exhaustive
def test_files_and_folders_are_read_in_slices(tmp_path):
    first, second = flat_banks()
    (tmp_path / "both").mkdir()
    for name, half in zip("ab", halves_of(first, second), strict=True):
        clsas.save(tmp_path / "both" / f"{name}.h5", half)
    for name, lines in (("first", first), ("second", second)):
        clsas.save(tmp_path / f"{name}.h5", lines)
    stores = [
        clsas.mosaic_heights(*lines, GRID, tmp_path / f"{number}.zarr", **REQUEST)
        for number, lines in enumerate(
            [
                (first, second),
                (tmp_path / "first.h5", tmp_path / "second.h5"),
                (tmp_path / "both", None),
            ]
        )
    ]
    expected = stores[0].heights()
    for store in stores[1:]:
        found = store.heights()
        assert np.array_equal(found.height_m, expected.height_m, equal_nan=True)
        assert np.array_equal(found.image.pixels, expected.image.pixels)


@pytest.mark.slow
def test_patches_are_measured_again_if_files_were_added(tmp_path):
    early, late = halves_of(*flat_banks())
    (tmp_path / "lines").mkdir()
    clsas.save(tmp_path / "lines" / "a.h5", early)
    request = REQUEST | {"patch_m": 5.0}
    store = clsas.mosaic_heights(tmp_path / "lines", None, GRID, tmp_path / "a.zarr", **request)
    before = store.records()
    clsas.save(tmp_path / "lines" / "b.h5", late)
    clsas.mosaic_heights(tmp_path / "lines", None, GRID, store.path, **request)
    after = store.records()
    assert before.keys() == after.keys() == {(0, 0)}
    for index in before:
        assert after[index].survey_channels == 2 * before[index].survey_channels
        assert after[index].channels > 1.5 * before[index].channels
    files = files_of(store.path)
    clsas.mosaic_heights(tmp_path / "lines", None, GRID, store.path, **request)
    assert files_of(store.path) == files


@pytest.mark.exhaustive
def test_folders_of_both_banks_may_grow(tmp_path):
    names = "first", "second"
    halves = halves_of(*flat_banks())
    for name in names:
        (tmp_path / name).mkdir()

    def add(number, some=names):
        for name in some:
            bank = replace(halves[number].bank(names.index(name)), bank_numbers=None)
            clsas.save(tmp_path / name / f"{number}.h5", bank)

    def measure(path):
        request = REQUEST | {"patch_m": 5.0}
        folders = (tmp_path / name for name in names)
        return clsas.mosaic_heights(*folders, GRID, tmp_path / path, **request)

    add(0)
    early = measure("a.zarr").records()[0, 0]
    add(1, ["first"])
    with pytest.raises(ValueError, match="a and b must contain the same pings"):
        measure("a.zarr")
    add(1, ["second"])
    store = measure("a.zarr")
    assert store.records()[0, 0].survey_channels == 2 * early.survey_channels
    found, expected = store.heights(), measure("b.zarr").heights()
    assert np.array_equal(found.height_m, expected.height_m, equal_nan=True)
    (tmp_path / "second" / "0.h5").unlink()
    (tmp_path / "first" / "0.h5").unlink()
    with pytest.raises(ValueError, match="the range lines differ"):
        measure("a.zarr")


@pytest.mark.exhaustive
def test_beams_of_folders_do_not_change_as_they_grow(tmp_path):
    (tmp_path / "lines").mkdir()
    clsas.save(tmp_path / "lines" / "a.h5", halves_of(*flat_banks())[0])
    beam = clsas.BeamWindow(20.0, "hann")
    store = clsas.mosaic_heights(
        tmp_path / "lines", None, GRID, tmp_path / "a.zarr", **REQUEST | {"patch_m": 5.0}, beam=beam
    )
    assert Document.read(store.path).inputs["beam"]["track_pings"] == 101
    with pytest.raises(ValueError, match="beam must not normalise for a folder that"):
        clsas.mosaic_heights(
            tmp_path / "lines", None, GRID, tmp_path / "b.zarr", **REQUEST,
            beam=replace(beam, normalise=True),
        )  # fmt: skip


@pytest.mark.exhaustive
def test_one_warning_names_all_patches_that_miss_the_seabed(tmp_path):
    request = REQUEST | {"search_m": (0.8, 2.0)}

    def measure():
        with pytest.warns(ClsasWarning) as caught:
            clsas.mosaic_heights(*flat_banks(), GRID, tmp_path / "a.zarr", **request)
        (text,) = (str(each.message) for each in caught)
        return text

    text = measure()
    assert text.startswith(
        "`search_m` may not contain the seabed: of 6 patches, the banks agree best at its lower "
        "end in 6 (0,0; 0,1; 1,0; 1,1; ...), where most of the seabed seems to lie below it. "
        "Heights may be wrong by multiples of the height of ambiguity, 1."
    )
    assert text.endswith(" m: search farther below")
    assert measure() == text  # of patches that were measured before


@pytest.mark.exhaustive
def test_the_search_may_start_from_a_relief(tmp_path):
    low = clsas.Grid.plane((-0.6, 0.6, 61), (31.2, 32.8, 81), z=-0.4)
    start = low.with_height(0.4 + np.linspace(-0.05, 0.05, 81)[:, None] + np.zeros(61))
    store = clsas.mosaic_heights(
        *flat_banks(), start, tmp_path / "a.zarr", **REQUEST | {"search_m": (-0.2, 0.2)}
    )
    found = store.heights()
    assert found.mask.mean() > 0.95
    error = (found.height_m - 0.4)[found.mask] / found.sd_m[found.mask]
    assert np.sqrt(np.mean(error**2)) < 1.3
    assert store.grid.height_m is not None


@pytest.mark.exhaustive
def test_the_default_window_is_kept(tmp_path):
    request = {name: REQUEST[name] for name in ("search_m", "patch_m")}
    store = clsas.mosaic_heights(*flat_banks(), GRID, tmp_path / "a.zarr", **request)
    before = files_of(store.path)
    looks = np.median([record.heights["looks"] for record in store.records().values()])
    assert 30 < looks < 70
    again = clsas.mosaic_heights(*flat_banks(), GRID, tmp_path / "a.zarr", **request)
    assert files_of(again.path) == before
    with pytest.raises(ValueError, match=r"`window_m` is 0.* in the store, 0\.2 here"):
        clsas.mosaic_heights(*flat_banks(), GRID, store.path, **request, window_m=0.2)


@pytest.mark.exhaustive
def test_a_given_window_is_not_decided_on_again(tmp_path, monkeypatch):
    """Another device, or more lines, may lead to another margin."""
    store = clsas.mosaic_heights(*flat_banks(), GRID, tmp_path / "a.zarr", **REQUEST)
    before = files_of(store.path)
    monkeypatch.setattr("clsas.mosaics.height_mosaic._MARGIN_WINDOWS", 3.0)
    clsas.mosaic_heights(*flat_banks(), GRID, store.path, **REQUEST)
    assert files_of(store.path) == before


@pytest.mark.exhaustive
def test_a_killed_run_continues_bit_for_bit(tmp_path):
    """Runs that are killed with SIGKILL after some patches."""
    program = f"""
        import clsas, pickle
        first, second, grid, request = pickle.load(open({str(tmp_path / "wish")!r}, "rb"))
        clsas.mosaic_heights(
            first, second, grid, {str(tmp_path / "a.zarr")!r}, **request,
            progress=lambda *done: print(*done, flush=True),
        )
    """
    wish = (*flat_banks(), GRID, REQUEST | {"patch_m": 0.4})
    (tmp_path / "wish").write_bytes(pickle.dumps(wish))
    finished = []
    for kills in range(3):
        process = subprocess.Popen(
            [sys.executable, "-c", textwrap.dedent(program)], stdout=subprocess.PIPE, text=True
        )
        begun = None
        for line in process.stdout:
            done, total = map(int, line.split())
            begun = done if begun is None else begun
            finished.append(done)
            if kills < 2 and done - begun == 4:
                process.send_signal(signal.SIGKILL)
                break
        process.stdout.read()
        assert process.wait() == (-signal.SIGKILL if kills < 2 else 0)
    assert finished[-1] == total == 20
    assert finished == sorted(finished)
    assert len(finished) <= 20 + 3  # the number finished before is reported once for every run
    store = clsas.Store.opened(tmp_path / "a.zarr")
    whole = clsas.mosaic_heights(*wish[:3], tmp_path / "whole.zarr", **wish[3])
    for name in (*LAYERS, *SHADOWED, "amplitude_db", "pixels"):
        one, other = (files_of(each.path / name) for each in (store, whole))
        assert one == other
        assert len(one) > 1 or name in SHADOWED  # chunks without shadow do not exist
    assert not store.damage()
    assert not store.array_damage()


@pytest.mark.exhaustive
def test_damaged_layers_are_found_and_measured_again(tmp_path):
    store = clsas.mosaic_heights(*flat_banks(), GRID, tmp_path / "a.zarr", **REQUEST)
    before = store.heights().height_m
    chunk = next(path for path in (store.path / "height_m" / "c").rglob("*") if path.is_file())
    content = bytearray(chunk.read_bytes())
    content[100] ^= 1
    chunk.write_bytes(content)
    assert "do not match their checksum" in str(clsas.Store.opened(store.path).damage())
    with pytest.raises(ValueError, match="values of height_m do not match their checksum"):
        clsas.Store.opened(store.path).heights()
    with pytest.warns(ClsasWarning, match="these patches are formed again"):
        again = clsas.mosaic_heights(*flat_banks(), GRID, tmp_path / "a.zarr", **REQUEST)
    assert np.array_equal(again.heights().height_m, before, equal_nan=True)


@pytest.mark.exhaustive
def test_patches_without_heights_say_why(tmp_path):
    lines = [each.tapered_ends(1.0) for each in flat_banks()]
    grid = clsas.Grid.plane((-0.6, 0.6, 61), (41.2, 57.2, 801))
    with pytest.raises(ValueError, match="no channel receives from its middle"):
        clsas.mosaic_heights(*lines, grid, tmp_path / "a.zarr", **REQUEST)
    assert not (tmp_path / "a.zarr").exists()
    grid = clsas.Grid.plane((-0.6, 0.6, 61), (22.4, 41.4, 951))
    request = REQUEST | {"patch_m": 2.6}
    store = clsas.mosaic_heights(*lines, grid, tmp_path / "a.zarr", **request)
    flags = {index: record.flags for index, record in store.records().items()}
    assert "outside the beam or recorded ranges" in str(flags[0, 0])
    assert flags[3, 0] == ()
    found = store.heights()
    assert not found.mask[:100].any()
    assert found.mask[450:500].mean() > 0.9


def filled_store(path, patch_shape, seed=0):
    """A store of heights with random numbers, of which some are missing, and their layers."""
    random = np.random.default_rng(seed)
    names = (*LAYERS, *SHADOWED)
    layers = {name: random.uniform(1, 2, SMALL.shape).astype(np.float32) for name in names}
    for name in ("height_m", "sd_m"):
        layers[name][10:37, 20:50] = np.nan
    for name in SHADOWED:
        layers[name][:20] = np.nan
    layers["coherence"] -= 1
    store = clsas.Store.at(path)
    inputs = {
        "parts": [], "pixels": list(SMALL.shape), "grid": grid_digest(SMALL), "window_m": 0.5,
    }  # fmt: skip
    store.begin(inputs, SMALL, patch_shape, WINDOW)
    return store, layers


def patches_of(patch_shape):
    layout = Layout(SMALL, patch_shape)
    return [layout.window(index) for index in np.ndindex(layout.shape)]


def write_patch(store, layers, window):
    _, row, column, rows, columns = window
    pixels = (layers["looks"] * np.exp(1j * layers["m_per_rad"])).astype(np.complex64)
    record = Record(channels=1, survey_channels=1, has_pixels=True)
    store.write(
        row, column, rows, columns, pixels[rows, columns], record,
        {name: values[rows, columns] for name, values in layers.items()},
    )  # fmt: skip


@pytest.mark.exhaustive
@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("patch_shape", [MIXED, *also(OF_PATCHES)])
def test_levels_of_layers(tmp_path, patch_shape):
    store, layers = filled_store(tmp_path / "a.zarr", patch_shape)
    for window in patches_of(patch_shape):
        write_patch(store, layers, window)
    store.complete_levels()
    assert store.levels == (2, 4, 8)
    assert not store.damage()
    assert not store.array_damage()
    for name in ("height_m", "coherence"):
        assert np.array_equal(store.read_layer(name), layers[name], equal_nan=True)
        level = store.read_layer(name, factor=2)
        block = layers[name][40:42, 60:62]
        assert level[20, 30] == pytest.approx(block.mean(), rel=1e-6)
    height = store.read_layer("height_m", factor=2)
    assert np.isnan(height[6:18, 11:24]).all()
    assert height[18, 15] == pytest.approx(np.nanmean(layers["height_m"][36:38, 30:32]), rel=1e-6)
    overview = store.overview_heights(20)
    assert overview.height_m.shape == (9, 11)
    at = overview.mask
    np.testing.assert_allclose(overview.height_m[at], store.read_layer("height_m", factor=8)[at])
    np.testing.assert_allclose(np.abs(overview.image.pixels), store.read_level(8), rtol=1e-5)
    # Without levels that serve, the pixels are reduced in the same way.
    part = store.overview_heights(20, slice(1, 80), slice(0, 66))
    moved, _ = filled_store(tmp_path / "b.zarr", patch_shape)
    shifted = {name: np.roll(values, -1, axis=0) for name, values in layers.items()}
    for window in patches_of(patch_shape):
        write_patch(moved, shifted, window)
    moved.complete_levels()
    expected = moved.overview_heights(20, slice(0, 79), slice(0, 66))
    np.testing.assert_allclose(part.height_m[:-1], expected.height_m[:-1], rtol=1e-6)
    np.testing.assert_allclose(part.sd_m[:-1], expected.sd_m[:-1], rtol=1e-6)


@pytest.mark.slow
@pytest.mark.usefixtures("small")
def test_an_overview_of_a_part_contains_nothing_from_beyond_it(tmp_path):
    def overview(name, beyond_m):
        store, layers = filled_store(tmp_path / name, SMALL.shape)
        layers["height_m"][66:] += beyond_m
        (window,) = patches_of(SMALL.shape)
        write_patch(store, layers, window)
        store.complete_levels()
        return store.overview_heights(20, slice(0, 66), slice(0, 80)).height_m

    np.testing.assert_array_equal(overview("a.zarr", 0.0), overview("b.zarr", 5.0))


@pytest.mark.exhaustive
@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("amplitude", [1e-30, 1e30])
def test_overviews_have_amplitudes_of_any_size(tmp_path, amplitude):
    store, layers = filled_store(tmp_path / "a.zarr", OF_PATCHES)
    for _, row, column, rows, columns in patches_of(OF_PATCHES):
        part = {name: values[rows, columns] for name, values in layers.items()}
        pixels = np.full(part["height_m"].shape, amplitude, np.complex64)
        record = Record(channels=1, survey_channels=1, has_pixels=True)
        store.write(row, column, rows, columns, pixels, record, part)
    store.complete_levels()
    for rows in (slice(None), slice(1, 80)):
        pixels = store.overview_heights(20, rows).image.pixels
        np.testing.assert_allclose(np.abs(pixels), np.float32(amplitude), rtol=1e-6)


def test_deviations_of_levels_are_those_of_means():
    """Errors of heights are means of white noise over windows."""
    random = np.random.default_rng(3)
    window = 9, 5
    errors = uniform_filter(random.standard_normal((4096, 1024)), window, mode="wrap")
    sd = np.full(errors.shape, errors.std(), np.float32)
    finest = {"height_m": errors.astype(np.float32), "sd_m": sd, "amplitude": np.ones_like(sd)}
    levels = pyramid.pyramid(finest, (2, 4, 8, 16, 32), window)
    for factor in (2, 4, 8, 16, 32):
        level = levels[factor]
        ratio = level["height_m"].std() / np.median(level["sd_m"])
        assert ratio == pytest.approx(1, abs=0.05)
    assert levels[32]["sd_m"].max() < 0.3 * sd.max()


@pytest.mark.exhaustive
@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("patch_shape", [OF_PATCHES, MIXED])
def test_a_store_killed_at_any_step_ends_bit_identical(tmp_path, monkeypatch, patch_shape):
    store, layers = filled_store(tmp_path / "whole.zarr", patch_shape)
    first, *others = patches_of(patch_shape)
    for window in (first, *others):
        write_patch(store, layers, window)
    store.complete_levels()
    whole = files_of(store.path)

    start, path = tmp_path / "start.zarr", tmp_path / "a.zarr"
    store, old = filled_store(start, patch_shape, seed=1)
    write_patch(store, old, first)
    _, layers = filled_store(start, patch_shape)
    for window in others:
        write_patch(store, layers, window)
    store.complete_levels()
    step, kills, is_killed = 0, 0, True
    while is_killed:
        shutil.rmtree(path, ignore_errors=True)
        shutil.copytree(start, path)
        store = clsas.Store.opened(path)

        def work(store=store):
            write_patch(store, layers, first)
            store.complete_levels()

        is_killed = killed_at(monkeypatch, step, work)
        kills += is_killed
        step += 1 if step < 8 else 7
        again, _ = filled_store(path, patch_shape)
        assert not again.damage()
        assert not again.array_damage()
        if (0, 0) not in again.records():
            write_patch(again, layers, first)
        again.complete_levels()
        assert files_of(path) == whole
    assert kills > 8


@pytest.mark.exhaustive
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="Linux tells the most memory")
def test_memory_is_that_of_a_patch(tmp_path):
    """Four times as many patches take little more memory than those around one in the middle."""
    script = """
        import pathlib, sys
        sys.path += [".", ".."]
        import clsas
        from reliefs import flat_banks

        def most_mib():
            lines = pathlib.Path("/proc/self/status").read_text().splitlines()
            return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024

        search, window, half_m = (-0.5, 0.5), 0.2, 0.004

        def grid(side):
            along = -half_m * side, half_m * side, side
            return clsas.Grid.plane(along, (33 + along[0], 33 + along[1], side))

        lines = flat_banks()
        clsas.mosaic_heights(*lines, grid(300), sys.argv[1] + "/a.zarr", search_m=search,
                             window_m=window, patch_m=0.8)
        few = most_mib()
        clsas.mosaic_heights(*lines, grid(600), sys.argv[1] + "/b.zarr", search_m=search,
                             window_m=window, patch_m=0.8)
        many = most_mib()
        clsas.heights(*lines, grid(900), search_m=search, window_m=window)
        print(few, many, most_mib())
    """
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", textwrap.dedent(script), tmp_path],
        check=True, capture_output=True, text=True, cwd=Path(__file__).parent,
    )  # fmt: skip
    few, many, whole = map(float, done.stdout.split())
    assert many < few + 60
    assert whole > many + 120


class TestBadInput:
    def refused(self, tmp_path, match, *lines, grid=GRID, error=ValueError, **options):
        given = REQUEST | options
        with pytest.raises(error, match=match):
            clsas.mosaic_heights(*(lines or flat_banks()), grid, tmp_path / "a.zarr", **given)
        assert not (tmp_path / "a.zarr").exists()

    def test_lines(self, tmp_path):
        first, second = flat_banks()
        self.refused(tmp_path, r"a must have at least 2 .* got 1: give the other one", first, None)
        self.refused(tmp_path, "same `carrier_hz`", first, replace(second, carrier_hz=90e3))
        self.refused(tmp_path, "apart across the line of sight", first, first)
        both = replace(first, bank_numbers=np.arange(first.channels) % 2)
        self.refused(tmp_path, "a must have the lines of one bank", both, second)

    @pytest.mark.parametrize("name", ["a", "b"])
    def test_a_bank_without_echoes(self, tmp_path, name):
        lines = list(flat_banks())
        number = "ab".index(name)
        lines[number] = replace(lines[number], samples=np.zeros_like(lines[number].samples))
        match = f"{name} must contain echoes, got samples that are all zero"
        self.refused(tmp_path, match, *lines)
        for own, each in zip("ab", lines, strict=True):
            clsas.save(tmp_path / f"{own}.h5", each)
        self.refused(tmp_path, match, tmp_path / "a.h5", tmp_path / "b.h5")

    def test_options(self, tmp_path):
        self.refused(tmp_path, "search_m must be two ascending", search_m=(1, 0))
        self.refused(tmp_path, "patch_m must be finite and > 0", patch_m=-1)
        self.refused(tmp_path, "patch_m must be at least the side of a window", patch_m=0.05)
        self.refused(tmp_path, "window_m must be", window_m=9.0)
        self.refused(tmp_path, "tolerance_db must be", tolerance_db=3)
        self.refused(tmp_path, "least_coherence must be", least_coherence=2)
        points = clsas.Grid.points(GRID.positions_m())
        self.refused(tmp_path, "grid must be a plane or height map", grid=points)

    @pytest.mark.exhaustive
    def test_other_inputs(self, tmp_path):
        path = tmp_path / "a.zarr"
        clsas.mosaic_heights(*flat_banks(), GRID, path, **REQUEST)
        with pytest.raises(ValueError, match=r"`least_coherence` is 0\.5 in the store, 0\.6"):
            clsas.mosaic_heights(*flat_banks(), GRID, path, **REQUEST, least_coherence=0.6)
        with pytest.raises(
            ValueError, match="other inputs: it is a mosaic of heights, not of images"
        ):
            clsas.mosaic(flat_banks()[0], GRID, path)

    @pytest.mark.slow
    def test_other_bank_numbers(self, tmp_path):
        first, second = flat_banks()
        names = "samples", "tx_m", "rx_m", "first_range_m"
        joined = {
            name: np.concatenate([getattr(first, name), getattr(second, name)]) for name in names
        }
        numbers = np.repeat([0, 1], first.channels)
        request = {"b": None, "grid": GRID, "store": tmp_path / "a.zarr", **REQUEST, "patch_m": 2.0}
        clsas.mosaic_heights(replace(first, **joined, bank_numbers=numbers), **request)
        for others in (1 - numbers, 2 * (1 - numbers)):
            with pytest.raises(ValueError, match="the range lines differ"):
                clsas.mosaic_heights(replace(first, **joined, bank_numbers=others), **request)

    def test_a_mosaic_of_images_has_no_heights(self, tmp_path):
        list(clsas.mosaic(flat_banks()[0], GRID, tmp_path / "a.zarr", tolerance_db=-30))
        store = clsas.Store.opened(tmp_path / "a.zarr")
        assert store.layers == ()
        with pytest.raises(ValueError, match="must be a mosaic of heights"):
            store.heights()
        with pytest.raises(ValueError, match=r"layer.*none: it has no heights"):
            store.read_layer("height_m")
