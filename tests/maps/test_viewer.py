"""The viewer's folder: tiles, frames, and what is refused. test_viewer_page.py opens it."""

import base64
import json
import os
import re
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from stores import GRID, LINES, REQUEST

import clsas
from clsas.cli import main
from clsas.engine.data import atomic
from clsas.engine.data.image import Formed
from clsas.maps import viewer
from clsas.maps.viewer import Tiles, factors_of_scales, fitted_degrees, frame_of, shape_of
from clsas.mosaics.pyramid import BRIGHTEST, NOTHING, eight_bits, pyramid

SHAPE = (700, 1300)
PLANE = clsas.Grid.plane((-13, 12.98, 1300), (40, 53.98, 700))


def speckle(shape, seed=0):
    rng = np.random.default_rng(seed)
    pixels = rng.normal(size=shape) + 1j * rng.normal(size=shape)
    pixels[: shape[0] // 4, : shape[1] // 4] = 0  # where nothing was received
    return pixels.astype(np.complex64)


@pytest.fixture(scope="module")
def image():
    return clsas.Image(speckle(SHAPE), PLANE)


@pytest.fixture(scope="module")
def written(image, tmp_path_factory):
    folder = tmp_path_factory.mktemp("viewer") / "web"
    viewer.write(image, folder)
    return folder


def scene_of(folder):
    text = (folder / "scene.js").read_text()
    return json.loads(re.fullmatch(r"window\.clsasScene = (.*);\n", text)[1])


def levels_at(folder, shape, scale, image=0, steps_m=(1.0, 1.0)):
    """All levels at one scale of a pyramid, assembled from its tiles."""
    rows, columns = shape_of(shape, factors_of_scales(shape, steps_m)[scale])
    found = np.zeros((rows, columns), np.uint8)
    names = {path.name for path in (folder / str(image) / str(scale)).iterdir()}
    for row in range(0, rows, viewer.SIDE):
        for column in range(0, columns, viewer.SIDE):
            name = f"{column // viewer.SIDE}_{row // viewer.SIDE}"
            part = found[row : row + viewer.SIDE, column : column + viewer.SIDE]
            text = (folder / str(image) / str(scale) / f"{name}.js").read_text()
            packed = re.fullmatch(rf'clsasTile\("{image}/{scale}/{name}","(.*)"\);\n', text)[1]
            values = np.frombuffer(zlib.decompress(base64.b64decode(packed)), np.uint8)
            part[:] = values.reshape(part.shape)
            names.remove(f"{name}.js")
    assert not names
    return found


def test_the_page_says_how_an_image_was_formed(image, tmp_path):
    formed = Formed("exact", -40, "4 taps", -41.2, None, (), "GPU", "1", "a")
    viewer.write(replace(image, formed=formed), tmp_path / "web", against=image)
    assert scene_of(tmp_path / "web")["formed"] == [formed.describe(), ""]


def test_tiles_have_every_pixel_to_half_a_step(image, written):
    scene = scene_of(written)
    assert scene["scales"] == [9, 11]  # 2048 is the first power of two that is not below 1300
    found = levels_at(written / "tiles", SHAPE, 11)
    nothing = image.pixels == 0
    assert np.array_equal(found == NOTHING, nothing)
    level_db = (found[~nothing].astype(float) - BRIGHTEST) * scene["step_db"]
    assert np.abs(level_db - image.db()[~nothing]).max() <= scene["step_db"] / 2 + 1e-4
    assert found.max() == BRIGHTEST


def test_coarse_tiles_are_means_of_power(image, written):
    found = levels_at(written / "tiles", SHAPE, 9)
    mean = np.abs(image.pixels[:, : 4 * 325].astype(complex)) ** 2
    largest = mean.max()
    for _ in range(2):  # means of the pixels of the level before that received something
        blocks = mean.reshape(len(mean) // 2, 2, -1, 2)
        mean = blocks.sum(axis=(1, 3)) / np.maximum((blocks > 0).sum(axis=(1, 3)), 1)
    mean /= largest
    some = mean > 0
    expected = BRIGHTEST + 10 * np.log10(mean[some]) / scene_of(written)["step_db"]
    assert found.shape == mean.shape
    assert np.array_equal(found == NOTHING, ~some)
    assert np.abs(found[some] - expected).max() <= 0.51


def test_coarse_tiles_are_the_levels_of_a_mosaic(tmp_path, monkeypatch):
    """Also where the last pixels of a scale cover fewer pixels of the image than others."""
    monkeypatch.setattr(viewer, "SIDE", 16)
    pixels, shape = speckle((39, 45)), (39, 45)
    largest = float(np.abs(pixels).max())
    tiles = Tiles(tmp_path, "0", shape, factors_of_scales(shape, (1.0, 1.0)), largest, 0.4)
    tiles.add(slice(0, 39), slice(0, 45), pixels)
    levels = pyramid({"amplitude": np.abs(pixels)}, (2, 4), None)
    for scale, factor in ((6, 1), (5, 2), (4, 4)):
        expected = eight_bits(levels[factor]["amplitude"], largest, 0.4)
        np.testing.assert_array_equal(levels_at(tmp_path, shape, scale), expected)


@pytest.mark.parametrize("steps_m", [(1.0, 1.0), (1.0, 0.2)])
@pytest.mark.parametrize("shape", [(1, 1), (1, 1500), (513, 511), (1025, 530)])
def test_tiles_do_not_depend_on_windows(tmp_path, shape, steps_m):
    pixels = speckle(shape)
    rng = np.random.default_rng(1)
    for name, height, width in (("whole", *shape), ("windows", 401, 300)):
        largest = float(np.abs(pixels).max()) or 1.0
        tiles = Tiles(tmp_path / name, "0", shape, factors_of_scales(shape, steps_m), largest, 0.4)
        windows = [
            (slice(top, min(top + height, shape[0])), slice(left, min(left + width, shape[1])))
            for top in range(0, shape[0], height)
            for left in range(0, shape[1], width)
        ]
        for index in rng.permutation(len(windows)):
            tiles.add(*windows[index], pixels[windows[index]])
    whole, parts = (
        {path.relative_to(tmp_path / name): path.read_bytes() for path in files}
        for name in ("whole", "windows")
        for files in [list((tmp_path / name).rglob("*.js"))]
    )
    assert whole == parts
    assert whole


@pytest.mark.parametrize(
    ("shape", "steps_m", "expected"),
    [
        ((300, 200), (1.0, 1e-3), {9: (1, 1)}),
        ((2000, 700), (0.1, 0.1), {9: (4, 4), 10: (2, 2), 11: (1, 1)}),
        ((2000, 700), (0.12, 0.1), {9: (4, 4), 10: (2, 2), 11: (1, 1)}),
        # Rows of 1 m stay apart until columns of 1 mm fit into a tile.
        ((100, 4000), (1.0, 1e-3), {9: (1, 8), 10: (1, 4), 11: (1, 2), 12: (1, 1)}),
        ((4000, 100), (1e-3, 1.0), {9: (8, 1), 10: (4, 1), 11: (2, 1), 12: (1, 1)}),
        ((600, 4000), (1.0, 0.3), {9: (2, 8), 10: (1, 4), 11: (1, 2), 12: (1, 1)}),
    ],
)
def test_the_longer_side_of_pixels_is_reduced_last(shape, steps_m, expected):
    assert factors_of_scales(shape, steps_m) == expected


@pytest.mark.parametrize("scale", [1e-30, 1.0, 3e38 + 3e38j])
def test_levels_of_any_scale(tmp_path, scale):
    pixels = (np.array([[1, 0.1, 1e-9, 0]]) * scale).astype(np.complex64)
    tiles = Tiles(tmp_path, "0", (1, 4), {2: (1, 1)}, abs(complex(pixels[0, 0])), 0.4)
    tiles.add(slice(0, 1), slice(0, 4), pixels)
    assert levels_at(tmp_path, (1, 4), 2).tolist() == [[255, 205, 1, 0]]


X, Y, Z = np.eye(3)


@pytest.mark.parametrize(
    ("row_step", "column_step", "right", "up"),
    [
        (Y, X, X, Y),
        (-Y, X, X, Y),
        (Y, -X, X, Y),
        (X, Y, X, Y),  # transposed, which would be mirrored if rows simply pointed up
        (X, -Y, X, Y),
        (Z, X, X, Z),
        (-Z, -X, X, Z),
        (X, -Z, X, Z),
        (Z, Y, Y, Z),
        (3 * Y + X, 2 * X, X, Y),  # not perpendicular
        (Y - X, X + Y, (X + Y) / np.sqrt(2), (Y - X) / np.sqrt(2)),
        (Y + 0.1 * Z, X, X, (Y + 0.1 * Z) / np.hypot(1, 0.1)),
    ],
)
def test_a_plane_is_seen_from_above_and_never_mirrored(row_step, column_step, right, up):
    grid = clsas.Grid.oriented((1, 2, 3), row_step, column_step, (4, 5))
    frame = frame_of(grid)
    np.testing.assert_allclose(frame["axes"], [right, up], atol=1e-12)
    for axis, along in enumerate(np.array(frame["axes"])):
        assert frame["screen_row_step"][axis] == pytest.approx(row_step @ along)
        assert frame["screen_column_step"][axis] == pytest.approx(column_step @ along)


@pytest.mark.parametrize(
    ("row_step", "column_step", "shape", "right", "up"),
    [
        (0 * X, 2 * X, (1, 5), X, Y),
        (2 * X, 2 * X, (1, 5), X, Y),  # a row step along the row
        (2 * Y, 0 * X, (5, 1), X, Y),
        (2 * (Y - X), 0 * X, (5, 1), (X + Y) / np.sqrt(2), (Y - X) / np.sqrt(2)),
        (0 * X, 2 * Z, (1, 5), Y, Z),
        (0 * X, 2 * Z + 1e-15 * Y, (1, 5), X, Z),
        (2 * Z, 0 * X, (5, 1), X, Z),
        (0 * X, 0 * X, (1, 1), X, Y),
        (2 * X, 2 * X, (1, 1), X, Y),
    ],
)
def test_a_single_row_or_column_is_as_wide_as_its_pixels(
    tmp_path, row_step, column_step, shape, right, up
):
    grid = clsas.Grid.oriented((1, 2, 3), row_step, column_step, shape)
    np.testing.assert_allclose(frame_of(grid)["axes"], [right, up], atol=1e-12)
    viewer.write(clsas.Image(speckle(shape), grid), tmp_path / "web")
    described = scene_of(tmp_path / "web")["frame"]
    steps = [described["row_step"], described["column_step"]]
    assert np.ptp(np.linalg.norm(steps, axis=1)) < 1e-12
    assert np.dot(*steps) == pytest.approx(0, abs=1e-12)
    for found, step, n in zip(steps, (row_step, column_step), shape, strict=True):
        assert n == 1 or found == pytest.approx(step)


def test_degrees_beside_a_single_row_show_the_north():
    """The page turns its arrow by the slopes along rows and columns."""
    grid = clsas.Grid.plane((0, 100, 51), (20, 20, 1))
    found = fitted_degrees(grid, lambda at: 60 + at[..., [1, 0]] * 1e-5)
    edges = np.polynomial.chebyshev.chebval2d([-1, 1], [0, 0], found["latitude"])
    assert np.diff(edges) == pytest.approx(2e-5)  # 2 m


@pytest.mark.parametrize("longitude_deg", [5.3, 179.99])
def test_degrees_are_right_to_a_centimetre(longitude_deg):
    """On a sphere, at a latitude of 75 degrees, in a scene of 20 km."""

    def to_geographic(positions_m):
        x, y = positions_m[..., 0] / 6371e3, positions_m[..., 1] / 6371e3
        distance = np.hypot(x, y) + 1e-300
        start = np.radians(75)
        sine = np.cos(distance) * np.sin(start) + y * np.sinc(distance / np.pi) * np.cos(start)
        longitude = longitude_deg + np.degrees(
            np.arctan2(
                x * np.sinc(distance / np.pi),
                np.cos(start) * np.cos(distance) - y * np.sin(start) * np.sinc(distance / np.pi),
            )
        )
        return np.stack([np.degrees(np.arcsin(sine)), (longitude + 180) % 360 - 180], axis=-1)

    grid = clsas.Grid.plane((-1e4, 1e4, 301), (-1e4, 1e4, 201))
    found = fitted_degrees(grid, to_geographic)
    expected = to_geographic(grid.positions_m())
    row, column = np.meshgrid(np.linspace(-1, 1, 201), np.linspace(-1, 1, 301), indexing="ij")
    for index, name in enumerate(("latitude", "longitude")):
        values = np.polynomial.chebyshev.chebval2d(row, column, found[name])
        error = (values - expected[..., index] + 180) % 360 - 180
        assert np.abs(error).max() < 1e-7


class TestFolder:
    def test_has_nothing_but_the_page(self, written):
        scripts = {"geometry.js", "view.js", "tiles.js", "marks.js", "controls.js", "events.js"}
        others = {"index.html", "viewer.css", "scene.js", "tiles"}
        assert {path.name for path in written.iterdir()} == scripts | others
        assert not list(written.parent.glob(".clsas-*"))
        page = (written / "index.html").read_text()
        assert set(re.findall(r'src="(\w+\.js)"', page)) == scripts | {"scene.js"}
        assert not any("http" in (written / name).read_text() for name in (*scripts, "index.html"))

    def test_replaces_only_an_earlier_viewer(self, image, tmp_path):
        small = clsas.Image(image.pixels[:20, :30], image.grid.window(slice(20), slice(30)))
        (tmp_path / "web").mkdir()
        viewer.write(small, tmp_path / "web")
        viewer.write(small, tmp_path / "web", names=["again"])
        assert scene_of(tmp_path / "web")["names"] == ["again"]
        (tmp_path / "web" / "notes.txt").write_text("mine")
        with pytest.raises(FileExistsError, match="it contains files, and is no viewer of clsas"):
            viewer.write(small, tmp_path / "web")
        with pytest.raises(FileExistsError, match="it is a file or a link"):
            viewer.write(small, tmp_path / "web" / "notes.txt")
        with pytest.raises(FileNotFoundError, match="there is no folder"):
            viewer.write(small, tmp_path / "new" / "web")

    def test_that_cannot_be_renamed_is_refused_before_pixels_are_read(
        self, image, tmp_path, monkeypatch
    ):
        monkeypatch.setattr(viewer, "largest_amplitude", None)
        (tmp_path / "here" / "below").mkdir(parents=True)
        monkeypatch.chdir(tmp_path / "here")
        for folder in (".", tmp_path / "here", "below/..", "/proc"):
            with pytest.raises(OSError, match=r"cannot write the folder .* be renamed; choose"):
                viewer.check_folder(Path(folder))
        for folder in ("/proc/web", "n" * 300):
            with pytest.raises(OSError, match=f"{folder} cannot be written: "):
                viewer.write(image, folder)

    @pytest.mark.parametrize("name", [".DS_Store", "Thumbs.db", "desktop.ini"])
    def test_may_contain_what_file_browsers_add(self, image, tmp_path, name):
        small = clsas.Image(image.pixels[:20, :30], image.grid.window(slice(20), slice(30)))
        folder = tmp_path / "web"
        folder.mkdir()
        for _ in range(2):
            (folder / name).touch()
            viewer.write(small, folder)
            assert not (folder / name).exists()

    @pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
    def test_of_an_interrupted_export_is_the_one_before(self, image, tmp_path, monkeypatch, error):
        small = clsas.Image(image.pixels[:20, :30], image.grid.window(slice(20), slice(30)))
        viewer.write(small, tmp_path / "web")

        def fail(*_):
            raise error

        monkeypatch.setattr(Tiles, "add", fail)
        for name in ("web", "new"):
            with pytest.raises(type(error)):
                viewer.write(small, tmp_path / name)
        assert [path.name for path in tmp_path.iterdir()] == ["web"]
        assert scene_of(tmp_path / "web")["names"] == ["image"]

    def test_comes_back_if_the_new_one_cannot_take_its_place(self, image, tmp_path, monkeypatch):
        small = clsas.Image(image.pixels[:20, :30], image.grid.window(slice(20), slice(30)))
        viewer.write(small, tmp_path / "web")
        monkeypatch.setattr(atomic, "_exchanged", lambda *_: False)
        rename, renamed = os.rename, []

        def fail_once(one, other):
            renamed.append(one)
            if len(renamed) == 2:
                raise PermissionError(1, "Operation not permitted", str(other))
            rename(one, other)

        monkeypatch.setattr(os, "rename", fail_once)
        with pytest.raises(PermissionError):
            viewer.write(small, tmp_path / "web", names=["again"])
        assert [path.name for path in tmp_path.iterdir()] == ["web"]
        assert scene_of(tmp_path / "web")["names"] == ["image"]


def test_what_the_viewer_cannot_show_is_refused(image, tmp_path):
    points = clsas.Image(image.pixels[:5, :5], clsas.Grid.points(np.ones((5, 5, 3))))
    with pytest.raises(ValueError, match="source must be on a plane or height map for the viewer"):
        viewer.write(points, tmp_path / "web")
    moved = clsas.Image(image.pixels, clsas.Grid.plane((-13, 12.98, 1300), (40, 54, 700)))
    with pytest.raises(ValueError, match="source and against must lie on one grid, got pixel"):
        viewer.write(image, tmp_path / "web", against=moved)
    with pytest.raises(ValueError, match="names must have 2 entries, got 1"):
        viewer.write(image, tmp_path / "web", against=image, names=["one"])
    assert not list(tmp_path.iterdir())


class TestGeoreferences:
    """Of two images."""

    @pytest.fixture
    def images(self, image):
        places = [None, *(clsas.Georeference.local(60, 5, heading_deg=h) for h in (0, 90))]
        grid = image.grid.window(slice(5), slice(5))
        grids = [replace(grid, georeference=place) for place in places]
        return [clsas.Image(image.pixels[:5, :5], each) for each in grids]

    def test_that_differ_are_refused(self, images, tmp_path):
        _, one, other = images
        with pytest.raises(ValueError, match="source and against must lie on one grid, got geor"):
            viewer.write(one, tmp_path / "web", against=other)
        assert not list(tmp_path.iterdir())

    def test_of_one_image_counts_for_both(self, images, tmp_path):
        for index, pair in enumerate((images[:2], images[1::-1], images[1:2] * 2)):
            viewer.write(pair[0], tmp_path / str(index), against=pair[1])
        known = [scene_of(tmp_path / str(index))["geographic"] for index in range(3)]
        assert known[0] == known[1] == known[2]
        assert known[0] is not None


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    path = tmp_path_factory.mktemp("store") / "a.zarr"
    list(clsas.mosaic(LINES, GRID, path, **REQUEST))
    return path


class TestStore:
    def test_is_read_patch_by_patch_with_the_records_of_patches(self, store, tmp_path, monkeypatch):
        opened, sizes, seen = clsas.Store.opened(store), [], []
        read = clsas.Store.read

        def counted(self, *window):
            pixels = read(self, *window)
            sizes.append(pixels.shape)
            return pixels

        monkeypatch.setattr(clsas.Store, "read", counted)
        viewer.write(opened, tmp_path / "web", progress=lambda *now: seen.append(now))
        assert set(sizes) <= {(15, 14), (15, 12)}
        assert seen == [(done, 12) for done in range(1, 13)]
        monkeypatch.undo()
        pixels = opened.read()
        found = levels_at(
            tmp_path / "web" / "tiles", GRID.shape, max(factors_of_scales(GRID.shape, (1.0, 1.0)))
        )
        expected = BRIGHTEST + clsas.Image(pixels, GRID).db() / 0.4
        assert np.abs(found - np.maximum(expected, 1)).max() <= 0.51
        patches = scene_of(tmp_path / "web")["patches"]
        assert [patch[:4] for patch in patches[:3]] == [
            [0, 0, 15, 14], [0, 14, 15, 14], [0, 28, 15, 12],
        ]  # fmt: skip
        errors = [record.predicted_error_db for record in opened.records().values()]
        assert [patch[4] for patch in patches] == pytest.approx(errors, abs=0.05)
        assert {patch[5] for patch in patches} == {None}

    def test_shows_measured_errors_beside_predicted_ones(self, tmp_path):
        path = tmp_path / "a.zarr"
        list(clsas.mosaic(LINES, GRID, path, **REQUEST, certificate=True))
        opened = clsas.Store.opened(path)
        viewer.write(opened, tmp_path / "web")
        scene, measured = scene_of(tmp_path / "web"), opened.certificate()
        errors = [measured.patches[index].error_db for index in sorted(measured.patches)]
        assert [patch[5] for patch in scene["patches"]] == pytest.approx(errors, abs=0.05)
        assert scene["formed"] == [measured.describe(REQUEST["accuracy_db"])]

    def test_that_changes_meanwhile_is_refused(self, store, tmp_path, monkeypatch):
        opened = clsas.Store.opened(store)
        records = iter([opened.records(), {}])
        monkeypatch.setattr(clsas.Store, "records", lambda _: next(records))
        with pytest.raises(ValueError, match="must not change while it is exported"):
            viewer.write(opened, tmp_path / "web")
        assert not list(tmp_path.iterdir())


class TestCommand:
    @pytest.fixture
    def opened(self, monkeypatch):
        addresses = []
        monkeypatch.setattr("webbrowser.open", lambda address: not addresses.append(address))
        return addresses

    @staticmethod
    def run(*arguments, code=0):
        result = CliRunner().invoke(main, ["view", *map(str, arguments)])
        assert result.exit_code == code, result.output
        return result.output

    def test_opens_the_page(self, store, tmp_path, opened, monkeypatch):
        monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
        printed = self.run(store)
        (page,) = tmp_path.glob("clsas-view-*/viewer/index.html")
        assert opened == [page.as_uri()]
        assert printed.startswith(f"{page}: ")

    def test_writes_a_folder_with_two_images(self, store, tmp_path, opened):
        image = clsas.Store.opened(store).image()
        clsas.save(tmp_path / "image.h5", image)
        options = ("--no-open", "--db", 40, "--colours", "gray", "--json")
        found = json.loads(
            self.run(store, tmp_path / "web", "--against", tmp_path / "image.h5", *options)
        )
        assert not opened
        files = [path for path in (tmp_path / "web").rglob("*") if path.is_file()]
        assert found["bytes"] == sum(path.stat().st_size for path in files)
        scene = scene_of(tmp_path / "web")
        assert scene["names"] == ["a.zarr", "image.h5"]
        assert scene["range_db"] == 40
        assert next(iter(scene["colours"])) == "gray"
        scale = scene["scales"][1]
        one, other = (
            levels_at(tmp_path / "web" / "tiles", image.shape, scale, index) for index in (0, 1)
        )
        assert np.array_equal(one, other)

    def test_refuses_before_any_work(self, store, tmp_path, opened):
        (tmp_path / "full").mkdir()
        (tmp_path / "full" / "a.txt").touch()
        assert "is no viewer of clsas" in self.run(store, tmp_path / "full", code=2)
        assert "the current folder" in self.run(store, ".", code=2)
        assert "cannot be written" in self.run(store, "/proc/web", code=2)
        assert "must not lie in the store" in self.run(store, store / "web", code=2)
        assert "--no-open requires FOLDER" in self.run(store, "--no-open", code=2)
        clsas.save(tmp_path / "lines.h5", LINES)
        assert "must hold an image" in self.run(tmp_path / "lines.h5", tmp_path / "web", code=1)
        assert not opened
        assert not (tmp_path / "web").exists()
