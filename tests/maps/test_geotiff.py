"""GeoTIFF of images and mosaics: where pixels land, what they are, what errors leave behind."""

import errno
import io
import os
import shutil
import subprocess
import sys
import warnings
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from placed import STEPS_M, UTM_NORTH, UTM_SOUTH, at, in_order, local, scene
from stores import GRID, LINES, PLANE, REQUEST
from tiers import also

import clsas
from clsas.engine.data.validate import ClsasWarning
from clsas.maps import geotiff
from clsas.mosaics import pyramid

pyproj = pytest.importorskip("pyproj")
rasterio = pytest.importorskip("rasterio")
cogeo = pytest.importorskip("rio_cogeo.cogeo")


def power(values, kind, step_db=0.0):
    """Power of pixels that were read, 0 where nothing was received."""
    if kind == "complex":
        return np.abs(values.astype(np.complex128)) ** 2
    level = values.astype(float)
    if kind == "8bit":
        level = np.where(values == 0, np.nan, (level - 255) * step_db)
    return np.nan_to_num(10 ** (level / 10))


def place_of_target(path, kind, where):
    """Distance in pixels between the target that is read and its coordinates by PROJ."""
    with rasterio.open(path) as file:
        found = power(file.read(1), kind, file.scales[0])
        to_map = pyproj.Transformer.from_crs(
            "EPSG:4326", pyproj.CRS.from_wkt(file.crs.to_wkt()), always_xy=True
        )
        column, row = at(~file.transform, *to_map.transform(*where))
        turn = file.transform
    assert turn.a * turn.e - turn.b * turn.d < 0  # not mirrored
    assert turn.e < 0
    assert turn.a > 0
    found[found < 0.01 * found.max()] = 0
    rows, columns = np.indices(found.shape) + 0.5  # of the centres of pixels
    share = found / found.sum()
    return float(np.hypot((share * rows).sum() - row, (share * columns).sum() - column))


PLACES = {
    "UTM": UTM_NORTH,
    "UTM south": UTM_SOUTH,
    "north": local(0.0),
    "east": local(90.0),
    "south-west": local(217.0),
    "west, southern": local(270.0, -33.39),
    "south-west, southern": local(217.0, -33.39),
}


@pytest.mark.parametrize("place", PLACES.values(), ids=PLACES)
def test_a_target_lies_where_proj_puts_it(place, tmp_path):
    image, where = scene(place)
    for kind, north_up in (("complex", False), ("db", False), ("8bit", True), ("db", True)):
        path = tmp_path / "a.tif"
        clsas.export(image, path, kind=kind, north_up=north_up)
        assert place_of_target(path, kind, where) < 0.1
        assert cogeo.cog_validate(path, strict=True) == (True, [], [])
        if north_up or place.is_projected or place.heading_deg % 90 == 0:
            with rasterio.open(path) as file:
                assert file.transform.b == file.transform.d == 0


@pytest.mark.parametrize("place", [UTM_NORTH, local(217.0), local(300.0)], ids=str)
def test_what_comes_back_is_what_went_in_to_one_quantum(place, tmp_path):
    image, _ = scene(place)
    reference = 2.0
    level = image.db(reference=reference)
    for kind in ("complex", "db", "8bit"):
        how = {} if kind == "complex" else {"reference": reference}
        how |= {"dynamic_range_db": 40.0, "colour_map": "sonar"} if kind == "8bit" else {}
        clsas.export(image, tmp_path / f"{kind}.tif", kind=kind, **how)
        with rasterio.open(tmp_path / f"{kind}.tif") as file:
            assert (
                file.dtypes[0] == {"complex": "complex64", "db": "float32", "8bit": "uint8"}[kind]
            )
            read = in_order(image, file.read(1), file.transform)
            if kind == "complex":
                np.testing.assert_array_equal(read, image.pixels)
            elif kind == "db":
                expected = np.where(np.isfinite(level), level, np.nan)
                np.testing.assert_allclose(read, expected, rtol=0, atol=2e-5)  # float32, -100 dB
                assert np.isnan(file.nodata)
            else:
                assert file.nodata == 0
                np.testing.assert_array_equal(read == 0, image.pixels == 0)
                shown = (file.offsets[0] + file.scales[0] * read)[read > 0]
                expected = np.clip(level[read > 0], -40, 0)
                assert np.abs(shown - expected).max() <= 0.51 * file.scales[0]
                table = file.colormap(1)
                assert table[0] == (0, 0, 0, 0)
                assert sum(table[1][:3]) < sum(table[128][:3]) < sum(table[255][:3])


@pytest.mark.slow
def test_overviews_are_means_of_power(tmp_path):
    shape = (1301, 1101)  # odd sides: two levels
    random = np.random.default_rng(4)
    pixels = random.normal(size=shape) + 1j * random.normal(size=shape)
    pixels[:400, :301] = 0
    grid = clsas.Grid.plane(
        (500_000, 500_110, 1101), (6_700_000, 6_700_130, 1301), georeference=UTM_NORTH
    )
    image = clsas.Image(pixels, grid)
    for kind in ("complex", "db"):
        clsas.export(image, tmp_path / "a.tif", kind=kind)
        assert cogeo.cog_validate(tmp_path / "a.tif", strict=True) == (True, [], [])
        with rasterio.open(tmp_path / "a.tif") as file:
            assert file.overviews(1) == [2, 4]
            expected = power(file.read(1), kind)
        for level in (0, 1):
            blocks = np.pad(expected, [(0, n % 2) for n in expected.shape])
            blocks = blocks.reshape(blocks.shape[0] // 2, 2, -1, 2)
            count = np.maximum((blocks > 0).sum(axis=(1, 3)), 1)
            expected = blocks.sum(axis=(1, 3)) / count
            with rasterio.open(tmp_path / "a.tif", overview_level=level) as file:
                np.testing.assert_allclose(power(file.read(1), kind), expected, rtol=3e-6)


def test_overviews_are_the_levels_of_a_mosaic(tmp_path, monkeypatch):
    """Also where the last pixels of a level cover fewer pixels of the image than others."""
    monkeypatch.setattr(geotiff, "_TILE", 128)
    random = np.random.default_rng(5)
    pixels = (random.normal(size=(299, 263, 2)) @ [1, 1j]).astype(np.complex64)
    pixels[100:151, :33] = 0
    height_m = random.normal(size=(299, 263)).astype(np.float32)
    grid = clsas.Grid.oriented(
        (5e5, 6.7e6, 0), (0, -1, 0), (1, 0, 0), (299, 263), georeference=UTM_NORTH
    )
    clsas.export(clsas.Image(pixels, grid.with_height(height_m)), tmp_path / "a.tif")
    finest = {"amplitude": np.abs(pixels), "height_m": height_m}
    levels = pyramid.pyramid(finest, (2, 4), None)
    for overview, factor in enumerate((2, 4)):
        with rasterio.open(tmp_path / "a.tif", overview_level=overview) as file:
            level, height = file.read()
        amplitude = np.nan_to_num(10 ** (level.astype(float) / 20))
        np.testing.assert_allclose(amplitude, levels[factor]["amplitude"], rtol=1e-6)
        np.testing.assert_allclose(height, levels[factor]["height_m"], rtol=1e-6, atol=1e-7)


def test_heights_on_the_axis_of_the_map_are_the_second_band(tmp_path):
    image, _ = scene(local(217.0))
    height_m = np.add.outer(0.05 * np.arange(140), 0.01 * np.arange(190))
    raised = clsas.Image(image.pixels, image.grid.with_height(height_m))
    for kind in ("db", "complex"):
        clsas.export(raised, tmp_path / "a.tif", kind=kind)
        with rasterio.open(tmp_path / "a.tif") as file:
            assert file.descriptions[1] == "Height (m)"
            read = in_order(image, file.read(2), file.transform)
        np.testing.assert_allclose(read.real, height_m - 12.0, rtol=1e-6)  # the origin lies at -12
    clsas.export(raised, tmp_path / "a.tif", north_up=True)
    with rasterio.open(tmp_path / "a.tif") as file:
        where = image.georeference.to_map(image.grid.positions_m()[70, 90])
        column, row = (int(n) for n in at(~file.transform, *where[:2]))
        level, read = file.read()
        assert read[row, column] == pytest.approx(height_m[70, 90] - 12.0, abs=0.05)
        outside = np.isnan(read)
    assert outside.any()
    assert np.isnan(level[outside]).all()
    with pytest.warns(ClsasWarning, match="8-bit levels leave out the heights"):
        clsas.export(raised, tmp_path / "a.tif", kind="8bit")


def test_neighbouring_north_up_maps_share_their_pixels(tmp_path):
    """Two scenes next to each other land next to each other, with mean power in larger pixels."""
    first, _ = scene(local(217.0))
    moved = clsas.Grid.oriented(
        first.grid.origin_m + [190 * STEPS_M[0], 0, 0], *first.grid.vectors_m[1:],
        first.shape, georeference=first.georeference,
    )  # fmt: skip
    second = clsas.Image(np.full(first.shape, 3 + 0j), moved)
    corners = []
    for name, image in (("a", first), ("b", second)):
        clsas.export(image, tmp_path / f"{name}.tif", north_up=True, pixel_m=0.5)
        with rasterio.open(tmp_path / f"{name}.tif") as file:
            assert (file.transform.a, file.transform.e) == (0.5, -0.5)
            corners.append((file.transform.c, file.transform.f))
            level = file.read(1)
    np.testing.assert_allclose(np.diff(corners, axis=0) % 0.5, 0, atol=1e-9)
    received = np.isfinite(level)
    np.testing.assert_allclose(level[received], 20 * np.log10(3), atol=1e-4)
    assert received.sum() * 0.25 == pytest.approx(second.grid.size * 0.05, rel=0.02)  # m2


def test_an_image_that_lies_north_up_may_have_larger_pixels(tmp_path):
    image, where = scene(UTM_NORTH)
    clsas.export(image, tmp_path / "a.tif", north_up=True, pixel_m=0.5)
    with rasterio.open(tmp_path / "a.tif") as file:
        assert (file.transform.a, file.transform.e) == (0.5, -0.5)
    assert place_of_target(tmp_path / "a.tif", "db", where) < 0.5


def test_tags_say_where_the_image_comes_from(tmp_path):
    place = clsas.Georeference.local(60.39, 5.32, heading_deg=90, vertical_datum="NN2000")
    lines, grid = replace(LINES, georeference=place), PLANE
    plan = clsas.plan(lines, grid, tolerance_db=-40)
    image = clsas.factorize(lines, grid, plan)
    clsas.export(image, tmp_path / "a.tif", plan=plan, lines=lines)
    with rasterio.open(tmp_path / "a.tif") as file:
        tags = file.tags()
    assert tags["CLSAS_VERSION"] == clsas.__version__
    assert float(tags["CARRIER_HZ"]) == LINES.carrier_hz
    assert float(tags["SOUND_SPEED_M_S"]) == LINES.sound_speed_m_s
    assert float(tags["TOLERANCE_DB"]) == -40
    assert float(tags["PREDICTED_ERROR_DB"]) == pytest.approx(plan.predicted_error_db)
    assert tags["PLAN"] == repr(plan)
    assert tags["VERTICAL_DATUM"] == "NN2000"
    assert float(tags["X_AXIS_HEADING_DEG"]) == 90


def test_tags_say_how_the_image_was_formed(tmp_path):
    beam = clsas.BeamWindow(40, "hann")
    lines = replace(LINES, georeference=local(90.0))
    image = clsas.backproject(lines, PLANE, accuracy_db=-40, beam=beam)
    clsas.export(image, tmp_path / "a.tif")
    with rasterio.open(tmp_path / "a.tif") as file:
        tags = file.tags()
    formed = image.formed
    assert tags["METHOD"] == "exact"
    assert float(tags["TOLERANCE_DB"]) == -40
    assert float(tags["PREDICTED_ERROR_DB"]) == pytest.approx(formed.predicted_error_db)
    assert not any(name.startswith("MEASURED") for name in tags)
    assert tags["PLAN"] == formed.plan
    assert tags["BEAM"] == repr(beam)
    assert tags["DEVICE"] == formed.device
    assert tags["LINES_DIGEST"] == formed.lines_digest
    assert tags["FORMED_BY"] == f"clsas {clsas.__version__}"


@pytest.mark.parametrize("kind", ["image", "mosaic"])
def test_tags_have_measured_errors(kind, tmp_path):
    lines = replace(LINES, georeference=local(90.0))
    if kind == "image":
        source = clsas.backproject(lines, PLANE, accuracy_db=-40, certificate=True)
        measured = source.formed.certificate
    else:
        list(clsas.mosaic(lines, PLANE, tmp_path / "a.zarr", certificate=True, **REQUEST))
        source = clsas.Store.opened(tmp_path / "a.zarr")
        measured = source.certificate().whole
    clsas.export(source, tmp_path / "a.tif")
    with rasterio.open(tmp_path / "a.tif") as file:
        tags = file.tags()
    assert float(tags["MEASURED_ERROR_DB"]) == pytest.approx(measured.error_db)
    assert float(tags["MEASURED_ERROR_UPPER_DB"]) == pytest.approx(measured.upper_db)
    assert int(tags["MEASURED_PIXELS"]) == measured.pixels


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """A finished store with heights, of 2 x 3 patches."""
    path = tmp_path_factory.mktemp("kept") / "a.zarr"
    grid = replace(GRID, georeference=local(217.0))
    list(clsas.mosaic(LINES, grid, path, **REQUEST))
    return path


@pytest.fixture
def store(kept, tmp_path):
    """A copy of the store that a test may change."""
    shutil.copytree(kept, tmp_path / "a.zarr")
    return clsas.Store.opened(tmp_path / "a.zarr")


def test_a_mosaic_gives_the_map_of_its_image(store, tmp_path):
    done = []
    clsas.export(store, tmp_path / "a.tif", progress=lambda *steps: done.append(steps))
    clsas.export(store.image(), tmp_path / "b.tif")
    with rasterio.open(tmp_path / "a.tif") as mine, rasterio.open(tmp_path / "b.tif") as theirs:
        np.testing.assert_array_equal(mine.read(), theirs.read())
        assert mine.transform == theirs.transform
        tags = mine.tags()
    assert tags["PATCHES"] == "6"
    assert float(tags["CARRIER_HZ"]) == LINES.carrier_hz
    assert float(tags["PREDICTED_ERROR_DB"]) == -50
    assert sorted(done) == done
    assert done[-1][0] == done[-1][1]
    rioxarray = pytest.importorskip("rioxarray")
    with rioxarray.open_rasterio(tmp_path / "a.tif") as array:
        assert array.shape == (2, 40, 30)
        assert "Transverse Mercator" in array.rio.crs.to_wkt()


def test_stores_that_are_not_whole_are_refused(store, tmp_path, monkeypatch):
    (store.path / "patches/1.2/zarr.json").rename(tmp_path / "record")
    for name in ("a.tif", "a.nc", "a.png"):
        with pytest.raises(ValueError, match="source must be finished, but 5 of the 6 patches"):
            clsas.export(store.path, tmp_path / name)
    (tmp_path / "record").rename(store.path / "patches/1.2/zarr.json")
    chunk = store.path / "pixels/c/1/2"
    content = chunk.read_bytes()
    chunk.write_bytes(bytes([content[0] ^ 1]) + content[1:])
    with pytest.raises(ValueError, match="patch 1,2: its pixels do not match their checksum"):
        clsas.export(store, tmp_path / "a.tif")
    chunk.write_bytes(content)
    records = store.records()
    changed = records | {(0, 0): replace(records[0, 0], seconds=99.0)}
    answers = iter([records, changed])
    monkeypatch.setattr(clsas.Store, "records", lambda self: next(answers))
    with pytest.raises(ValueError, match="source must not change"):
        clsas.export(store, tmp_path / "a.tif")
    assert [each.name for each in tmp_path.iterdir()] == ["a.zarr"]


def test_an_interruption_leaves_the_old_file(tmp_path):
    image, _ = scene(UTM_NORTH)
    (tmp_path / "a.tif").write_text("old")

    def interrupt(done, total):
        if done > total // 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        clsas.export(image, tmp_path / "a.tif", progress=interrupt)
    assert [each.read_text() for each in tmp_path.iterdir()] == ["old"]


@pytest.mark.parametrize("free", [10_000, 270_000])
def test_a_full_disk_leaves_nothing(tmp_path, monkeypatch, free):
    """Before any work, or once a file of the work would not fit."""
    image, _ = scene(UTM_NORTH)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=free))
    with pytest.raises(OSError, match=r"the export needs .* of free space") as caught:
        clsas.export(image, tmp_path / "a.tif")
    assert caught.value.errno == errno.ENOSPC
    assert caught.value.filename == str(tmp_path / "a.tif")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("full", [errno.ENOSPC, errno.EDQUOT, None])
@pytest.mark.parametrize("noticed", ["on a write", "by missing tiles"])
def test_a_failed_write_of_gdal_tells_a_full_disk_or_quota(tmp_path, monkeypatch, full, noticed):
    """GDAL reports neither, and leaves out tiles that it cannot write when it closes a file."""
    image, _ = scene(UTM_NORTH)

    def write(raster, *_):
        path = raster.folder / "first.tif"
        if noticed == "on a write":
            raise rasterio.errors.RasterioIOError(
                "Write failed. See previous exception for details."
            )
        profile = {"driver": "GTiff", "dtype": "uint8", "count": 1, "sparse_ok": True}
        with warnings.catch_warnings(action="ignore"):  # it has no georeference
            rasterio.open(path, "w", width=99, height=99, **profile).close()
            geotiff.check_whole(path)

    class Disk(io.BytesIO):
        """A file on a disk with 1 MiB of free space, or more."""

        def write(self, contents):
            if full and len(contents) > 1 << 20:
                raise OSError(full, os.strerror(full))

    monkeypatch.setattr(geotiff, "_read", write)
    monkeypatch.setattr("tempfile.TemporaryFile", lambda **_: Disk())
    with pytest.raises(OSError, match="" if full else "GDAL cannot write the file") as caught:
        clsas.export(image, tmp_path / "a.tif")
    assert caught.value.errno == (full or errno.EIO)
    assert caught.value.filename == str(tmp_path / "a.tif")
    assert not list(tmp_path.iterdir())


PROGRAM = """
import os, resource, signal, sys
import numpy as np
import clsas

place = clsas.Georeference.local(60.39, 5.32, heading_deg=217)
grid = clsas.Grid.plane((0, 60, 600), (0, 70, 700), georeference=place)
image = clsas.Image(np.ones(grid.shape, complex), grid)

def die(done, total):
    if done >= float(sys.argv[2]) * total:
        os.kill(os.getpid(), signal.SIGKILL)

if sys.argv[2] == "limit":
    resource.setrlimit(resource.RLIMIT_FSIZE, (2_000_000, 2_000_000))
    clsas.export(image, sys.argv[1])
else:
    clsas.export(image, sys.argv[1], progress=die)
"""


@pytest.mark.slow
def test_files_that_cannot_be_written_leave_nothing(tmp_path):
    """GDAL reports a write error in several places; some only when a file is closed."""
    command = [sys.executable, "-c", PROGRAM, tmp_path / "a.tif", "limit"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert "OSError: [Errno" in done.stderr.splitlines()[-1]
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_link_stays_and_the_file_behind_it_is_replaced(tmp_path):
    image, _ = scene(UTM_NORTH)
    (tmp_path / "link.tif").symlink_to(tmp_path / "image.tif")
    clsas.export(image, tmp_path / "link.tif")
    assert (tmp_path / "link.tif").is_symlink()
    with rasterio.open(tmp_path / "image.tif") as file:
        assert file.shape == image.pixels.shape
    assert sorted(each.name for each in tmp_path.iterdir()) == ["image.tif", "link.tif"]


@pytest.mark.parametrize("name", [b"a\xff.tif", b"\x80/image.tif", b"link.tif"])
def test_names_that_are_not_utf8_are_refused_by_name(tmp_path, name):
    """GDAL's Python packages cannot pass on bytes that UTF-8 cannot decode."""
    path = tmp_path / os.fsdecode(name)
    path.parent.mkdir(exist_ok=True)
    if path.name == "link.tif":
        path.symlink_to(tmp_path / os.fsdecode(b"\xc3x.tif"))
    before = sorted(path.parent.iterdir())
    grid = clsas.Grid.plane((0, 2, 21), (40, 41, 11), georeference=local(90.0))
    with pytest.raises(ValueError, match=r"path of a GeoTIFF must be text of Unicode .*\\udc"):
        clsas.export(clsas.Image(np.ones(grid.shape, complex), grid), path)
    assert sorted(path.parent.iterdir()) == before


@pytest.mark.parametrize("share", ["0.4", *also("0.1", "0.9")])
def test_a_killed_export_leaves_no_file_and_is_cleared_away(tmp_path, share):
    done = subprocess.run([sys.executable, "-c", PROGRAM, tmp_path / "a.tif", share])
    assert done.returncode < 0
    assert not (tmp_path / "a.tif").exists()
    image, _ = scene(UTM_NORTH)
    clsas.export(image, tmp_path / "a.tif")
    assert os.listdir(tmp_path) == ["a.tif"]


def test_images_without_a_place_on_a_map_are_refused(tmp_path):
    image, _ = scene(local(217.0))
    nowhere = clsas.Image(image.pixels, replace(image.grid, georeference=None))
    points = clsas.Image(
        image.pixels, clsas.Grid.points(image.grid.positions_m(), georeference=UTM_NORTH)
    )
    upright = clsas.Grid.oriented([0, 0, 0], [0, 0, 1], [1, 0, 0], (3, 3), georeference=UTM_NORTH)
    raised = clsas.Image(image.pixels, image.grid.with_height(np.zeros(image.shape)))
    phase = {"kind": "complex", "north_up": True}
    unknown = clsas.Georeference(crs="EPSG:99999")
    path = tmp_path / "a.tif"
    for source, how, message in (
        (nowhere, {}, "source must have a georeference .*give `georeference`"),
        (nowhere, {"georeference": unknown}, "crs must be one that PROJ knows"),
        (image, {"georeference": UTM_NORTH}, "georeference must be left out"),
        (points, {}, "source must be on a plane or height map"),
        (clsas.Image(np.ones((3, 3), complex), upright), {}, "grid must not be vertical"),
        (image, {"kind": "complex", "beam": clsas.BeamWindow(9.0)}, "beam must be left out"),
        (image, {"kind": "complex", "reference": 1.0}, "reference must be left out"),
        (image, phase, "kind must not be complex with `north_up`, .*: form the image on `geo"),
        (image, {**phase, "pixel_m": 100.0}, "pixel_m must be at most the longer side of the grid"),
        (raised, phase, "kind must not be complex .*: leave `north_up` out"),
        (image, {"colour_map": "gray"}, "colour_map must be left out, .* `kind='db'`"),
        (image, {"pixel_m": 1.0}, "pixel_m must be left out, .* without `north_up`"),
        (image, {"north_up": True, "pixel_m": 100.0}, r"pixel_m must be 0\.0125 to 3\.2 m"),
        (image, {"north_up": True, "pixel_m": 1e300}, r"pixel_m must be 0\.0125 to 3\.2 m"),
        (image, {"kind": "8bit", "colour_map": "none such"}, "colour_map must be"),
        (image, {"kind": "float"}, "kind must be"),
        (image, {"reference": 0.0}, "reference must be"),
    ):
        with pytest.raises(ValueError, match=message):
            clsas.export(source, path, **how)
    with pytest.raises(ValueError, match=r"reference must be left out, .* a folder"):
        clsas.export(image, tmp_path / "folder", reference=1.0)
    clsas.export(nowhere, path, georeference=local(217.0))  # with its place it is written
    assert os.listdir(tmp_path) == ["a.tif"]


def test_an_image_of_zeros_is_a_map_of_nothing(tmp_path):
    image, _ = scene(UTM_NORTH)
    with warnings.catch_warnings(action="error", category=RuntimeWarning):
        clsas.export(clsas.Image(0 * image.pixels, image.grid), tmp_path / "a.tif", kind="8bit")
    with rasterio.open(tmp_path / "a.tif") as file:
        assert not file.read().any()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("crs", "shift_m", "message"),
    [
        ("EPSG:32632", (0, 0), r"latitude 0\.0\d+, longitude 4\.51\d+, 16\d km outside the area"),
        ("EPSG:32632", (1_500_000, 6_700_000), r"longitude 26\.\d+, .* km outside .* 1\.01"),
        ("EPSG:3857", (590_000, 8_420_000), r"latitude 60\.\d+, .*, where .* are 2\.\d+ times"),
        ("EPSG:32632", (9e8, 0), "outside the map of EPSG:32632"),
        ("EPSG:32632", (295_000, 6_700_000), None),  # zone 32 is wider in Norway: 5.3 degrees east
        ("EPSG:2193", (1_750_000, 5_427_000), None),  # area of use near the antimeridian
    ],
)  # fmt: skip
def test_an_unlikely_place_is_a_warning(crs, shift_m, message, tmp_path):
    pytest.importorskip("matplotlib")
    image, _ = scene(local(90.0), shape=(20, 30))
    place = clsas.Georeference.projected(crs)
    origin_m = np.array([*shift_m, 0.0])
    grid = clsas.Grid.oriented(
        origin_m, [0, STEPS_M[1], 0], [STEPS_M[0], 0, 0], (20, 30), georeference=place
    )
    image = clsas.Image(image.pixels, grid)
    for name in ("a.tif", "a.nc", "a.png"):
        if message is None:
            clsas.export(image, tmp_path / name)
        else:
            with pytest.warns(ClsasWarning, match=message):
                clsas.export(image, tmp_path / name)
        assert (tmp_path / name).exists()
