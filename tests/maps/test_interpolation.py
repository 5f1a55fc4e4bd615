"""Complex pixels on the axes of a map, against images that are formed there."""

from dataclasses import replace

import numpy as np
import pytest
from placed import UTM_NORTH, local
from tiers import also, few

import clsas
from clsas.engine.data.image_error import relative_error_db
from clsas.maps.agreement import agreement
from clsas.maps.carrier import Carrier
from clsas.maps.collection import Collection
from clsas.maps.interpolation import MOST_ERROR_DB, margin_of

rasterio = pytest.importorskip("rasterio")

CARRIER_HZ, BAND_HZ = 100e3, 30e3
MIDDLE_M = np.array([0.0, 35.0, 0.0])
BEAM = clsas.BeamWindow(20.0, "hann")
SIDE_M = 3.0


def shift_m(place):
    return np.array([500_000.0, 6_700_000.0, 0.0]) if place.is_projected else np.zeros(3)


def track_m(place):
    x = np.arange(-9, 9, 0.02)
    return np.stack([x, 0.02 * np.sin(x), 8 + 0.01 * np.cos(2 * x)], axis=1) + shift_m(place)


def lines_of(place, kind, **given):
    """Range lines of speckle, or of points on it that are 40 dB stronger."""
    random = np.random.default_rng(7)
    count = 6000 if kind == "speckle" else 15
    reach_m = [7, 7, 0] if kind == "speckle" else [2, 2, 0]
    points_m = MIDDLE_M + shift_m(place) + random.uniform(-1, 1, (count, 3)) * reach_m
    amplitudes = random.normal(size=(count, 2)) @ [1, 1j]
    lines = clsas.simulate_lines(
        track_m(place), track_m(place), clsas.PointTargets(points_m, amplitudes),
        carrier_hz=CARRIER_HZ, bandwidth_hz=BAND_HZ, window="hann", first_range_m=25.0, length=1700,
    )  # fmt: skip
    return replace(lines, georeference=place, **given)


def grid_of(place, step_m, turn=None):
    """Grid about the middle of the scene, in any order of its pixels."""
    steps_m = np.array([[0, step_m, 0], [step_m, 0, 0]])
    if turn == "oblique":
        steps_m = steps_m @ [[0.8, 0.6, 0], [-0.6, 0.8, 0], [0, 0, 1]]
    elif turn == "transposed":
        steps_m = steps_m[::-1] * [[-1], [1]]
    count = round(SIDE_M / step_m)
    first_m = MIDDLE_M + shift_m(place) - (count // 2) * steps_m.sum(axis=0)
    return clsas.Grid.oriented(first_m, *steps_m, (count, count + 7), georeference=place)


def resampled(source, path, **options):
    """Return pixels of a north-up file, from south to north, and the error that it states."""
    clsas.export(source, path, kind="complex", north_up=True, **options)
    with rasterio.open(path) as file:
        assert file.transform.b == file.transform.d == 0
        return file.read(1)[::-1], float(file.tags()["INTERPOLATION_ERROR_DB"])


def error_db(found, expected):
    """Error where the file has pixels, which a rotated image of a wide margin has in few places."""
    inside = found != 0
    assert inside.mean() > 0.1
    return relative_error_db(found[inside], expected[inside])


CASES = {
    # place, kind, distance of the pixels and of the new ones (m), order of pixels
    "fine speckle": (local(217.0), "speckle", 0.008, None, None),
    "speckle": (local(217.0), "speckle", 0.0125, 0.0134, None),
    "coarse speckle": (local(217.0), "speckle", 0.016, 0.011, "transposed"),
    "points": (local(217.0), "points", 0.0125, None, "oblique"),
    "coarse points": (local(300.0), "points", 0.016, None, None),
    "large pixels": (local(217.0), "speckle", 0.0125, 0.05, None),
    "UTM": (UTM_NORTH, "speckle", 0.0125, None, "oblique"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", few(CASES, often=["UTM"]))
def test_it_is_the_image_formed_on_the_axes_of_the_map(name, tmp_path):
    place, kind, step_m, pixel_m, turn = CASES[name]
    lines, grid = lines_of(place, kind), grid_of(place, step_m, turn)
    image = clsas.backproject(lines, grid, beam=BEAM, accuracy_db=-80)
    options = {} if pixel_m is None else {"pixel_m": pixel_m}
    found, stated_db = resampled(image, tmp_path / "a.tif", lines=lines, beam=BEAM, **options)
    expected = clsas.backproject(
        lines, place.north_up(grid, pixel_m), beam=BEAM, accuracy_db=-80
    ).pixels
    assert found.shape == expected.shape
    assert stated_db < -60
    # Both images err by up to -80 dB.
    assert error_db(found, expected) < 10 * np.log10(10 ** (stated_db / 10) + 4e-8)
    shown = np.abs(found) > 0.1 * np.abs(found).max()
    difference_rad = np.angle(found * expected.conj())[shown]
    assert np.abs(difference_rad).max() < 0.01


@pytest.mark.exhaustive
@pytest.mark.filterwarnings("ignore:the image is")  # darker than its defocused echoes
def test_the_carrier_is_that_of_moving_arrays_and_squinted_beams(tmp_path):
    place = local(217.0)
    lines, grid = lines_of(place, "points"), grid_of(place, 0.0125)
    apart_m = 0.04 * (np.arange(lines.channels) % 10)[:, None] * [1, 0, 0]
    # Samples of another geometry are as good: they defocus the image.
    lines = replace(lines, rx_m=lines.tx_m + apart_m, rx_velocity_m_s=[2.0, 0, 0])
    beam = clsas.BeamWindow(10.0, "hann", squint_deg=8.0, along=[1, 0, 0])
    image = clsas.backproject(lines, grid, beam=beam, accuracy_db=-80)
    found, stated_db = resampled(image, tmp_path / "a.tif", lines=lines, beam=beam)
    expected = clsas.backproject(lines, place.north_up(grid), beam=beam, accuracy_db=-80).pixels
    assert stated_db < -60
    assert error_db(found, expected) < 10 * np.log10(10 ** (stated_db / 10) + 4e-8)


@pytest.mark.exhaustive
def test_a_beam_that_ends_abruptly_states_its_error_or_is_refused(tmp_path):
    place = local(217.0)
    lines, grid = lines_of(place, "speckle"), grid_of(place, 0.0125)
    beam = clsas.BeamWindow(20.0)
    image = clsas.backproject(lines, grid, beam=beam, accuracy_db=-80)
    with pytest.raises(ValueError, match="its beam ends abruptly, or `lines` and `beam` are not"):
        resampled(image, tmp_path / "a.tif", lines=lines, beam=beam)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.exhaustive
def test_the_error_of_a_beam_with_kinks_is_stated(tmp_path):
    """The second derivative of these weights jumps, so that frequencies reach far."""
    place = local(217.0)
    lines, grid = lines_of(place, "speckle"), grid_of(place, 0.008)
    beam = clsas.BeamWindow(20.0, "hamming")  # ends at 0.08
    image = clsas.backproject(lines, grid, beam=beam, accuracy_db=-80)
    found, stated_db = resampled(image, tmp_path / "a.tif", lines=lines, beam=beam)
    expected = clsas.backproject(lines, place.north_up(grid), beam=beam, accuracy_db=-80).pixels
    assert stated_db - 12 < error_db(found, expected) < stated_db < MOST_ERROR_DB


@pytest.mark.exhaustive
def test_a_mosaic_is_resampled_window_by_window(tmp_path, monkeypatch):
    """Windows and patches leave no seams, and edges of what was received stay where they are."""
    place = local(217.0)
    lines, grid = lines_of(place, "speckle"), grid_of(place, 0.0125)
    image = clsas.backproject(lines, grid, beam=BEAM, accuracy_db=-80)
    whole, stated_db = resampled(image, tmp_path / "a.tif", lines=lines, beam=BEAM)
    for _ in clsas.mosaic(
        lines, grid, tmp_path / "a.zarr", patches=(3, 2), beam=BEAM, accuracy_db=-80
    ):
        pass
    monkeypatch.setattr("clsas.maps.interpolation._WINDOW", 100)
    store = clsas.Store.opened(tmp_path / "a.zarr")
    parts, of_parts_db = resampled(store, tmp_path / "b.tif", lines=lines, beam=BEAM)
    np.testing.assert_array_equal(parts == 0, whole == 0)
    assert relative_error_db(parts, whole) < -70
    assert max(stated_db, of_parts_db) < -60


@pytest.mark.exhaustive
def test_pixels_of_which_nothing_was_received_stay_0(tmp_path):
    place = local(217.0)
    lines, grid = lines_of(place, "speckle"), grid_of(place, 0.008)
    image = clsas.backproject(lines, grid, beam=BEAM, accuracy_db=-80)
    pixels = image.pixels.copy()
    pixels[:100, :110] = 0
    cut = clsas.Image(pixels, grid)
    whole, _ = resampled(image, tmp_path / "a.tif", lines=lines, beam=BEAM)
    found, stated_db = resampled(cut, tmp_path / "b.tif", lines=lines, beam=BEAM)
    assert stated_db < -60  # of blocks without an edge
    index = np.linalg.lstsq(
        np.stack(grid.vectors_m[1:]).T,
        (place.north_up(grid).positions_m() - grid.origin_m).reshape(-1, 3).T,
        rcond=None,
    )[0].reshape(2, *found.shape)
    outside = (index[0] < 99.4) & (index[1] < 109.4)
    assert not found[outside].any()
    margin = margin_of(0.2)
    away = (whole != 0) & ((index[0] > 100 + margin) | (index[1] > 110 + margin))
    assert away.any()
    assert relative_error_db(found[away], whole[away]) < -55


@pytest.mark.exhaustive
def test_the_carrier_follows_the_middle_of_the_band():
    """Its slope at a pixel is the mean of the frequencies there, far and near."""
    place = local(0.0)
    x = np.arange(-30, 30, 0.05)
    track = np.stack([x, np.zeros_like(x), np.full_like(x, 10.0)], axis=1)
    lines = clsas.simulate_lines(
        track, track, clsas.PointTargets([[0, 30, 0]]), carrier_hz=CARRIER_HZ,
        bandwidth_hz=BAND_HZ, window="hann", first_range_m=10.0, length=8000,
    )  # fmt: skip
    grid = clsas.Grid.plane((-10, 10, 201), (5, 90, 851), georeference=place)
    collection = Collection.of(lines, BEAM)
    first_m, *steps_m = grid.vectors_m
    carrier = Carrier.of(collection, (851, 201), first_m, np.stack(steps_m))
    band = collection.cycles_per_m[[0, -1]]
    for row, column in ((0, 100), (40, 3), (400, 50), (850, 200)):
        y = 5 + 0.1 * row
        cosine = y / np.hypot(y, 10)  # between range and ground range, seen abreast
        turns = carrier.turns(1e-3 * np.eye(2), np.array([row, column]), (2, 2))
        down, along = np.angle(turns[1:, 0] / turns[0, 0]), np.angle(turns[0, 1:] / turns[0, 0])
        # The beam sees up to 10 degrees forward and aft, where the range changes less.
        highest, lowest = band[1] * cosine, band[0] * cosine * np.cos(np.radians(10))
        expected = 0.1 * (highest + lowest) / 2
        assert down[0] / 2 / np.pi / 1e-3 == pytest.approx(expected, abs=0.03)
        assert along[0] / 2 / np.pi / 1e-3 == pytest.approx(0, abs=0.03)
    assert carrier.half_band[0] == pytest.approx(0.1 * (highest - lowest) / 2, abs=0.04)
    assert carrier.half_band[1] == pytest.approx(
        0.1 * band[1] * np.sin(np.radians(10)), rel=0.03, abs=0.03
    )


@pytest.mark.slow
def test_the_command_takes_lines_and_the_beam_of_a_scene(tmp_path, monkeypatch):
    testing = pytest.importorskip("click.testing")
    from clsas.cli import main

    monkeypatch.chdir(tmp_path)
    place = local(217.0)
    lines, grid = lines_of(place, "points"), grid_of(place, 0.0125)
    image = clsas.backproject(lines, grid, beam=BEAM, accuracy_db=-80)
    clsas.save("image.h5", image)
    clsas.save("lines.h5", lines)
    (tmp_path / "scene.toml").write_text('[image.beam]\nwidth_deg = 20\nshape = "hann"\n')

    def run(*arguments):
        given = ["export", "image.h5", "a.tif", "--as", "complex", "--north-up", *arguments]
        done = testing.CliRunner().invoke(main, given)
        return done.exit_code, done.output

    assert run("--lines", "lines.h5", "--scene", "scene.toml")[0] == 0
    expected, _ = resampled(image, tmp_path / "b.tif", lines=lines, beam=BEAM)
    with rasterio.open("a.tif") as file:
        np.testing.assert_array_equal(file.read(1)[::-1], expected)
    code, output = run()
    assert (code, "--lines must be given for complex pixels" in output) == (1, True)


def noise(grid, seed=5):
    random = np.random.default_rng(seed)
    return clsas.Image(random.normal(size=(*grid.shape, 2)) @ [1, 1j], grid)


@pytest.mark.slow
@pytest.mark.parametrize("carrier_hz", [180e3, *also(140e3, 300e3)])
@pytest.mark.parametrize(
    ("kind", "step_m"), few([("speckle", 0.0125), ("points", 0.016)], often=[("speckle", 0.0125)])
)
def test_lines_of_another_recording_are_recognized(kind, step_m, carrier_hz, tmp_path):
    place = local(217.0)
    lines, grid = lines_of(place, kind), grid_of(place, step_m, "oblique")
    image = clsas.backproject(lines, grid, beam=BEAM, accuracy_db=-60)
    other = replace(lines, carrier_hz=carrier_hz)
    with pytest.raises(
        ValueError, match="must be those that formed the image, with the same `beam`"
    ):
        resampled(image, tmp_path / "a.tif", lines=other, beam=BEAM)


@pytest.mark.exhaustive
@pytest.mark.parametrize("kind", ["speckle", *also("points")])
@pytest.mark.parametrize("step_m", [0.0125, *also(0.008, 0.016, 0.03)])
def test_lines_agree_with_their_image(kind, step_m):
    place = local(217.0)
    lines, grid = lines_of(place, kind), grid_of(place, step_m, "oblique")
    for beam in (BEAM, clsas.BeamWindow(20.0), clsas.BeamWindow(10.0, "hann", squint_deg=8.0)):
        image = clsas.backproject(lines, grid, beam=beam, accuracy_db=-60)
        found = agreement(
            Collection.of(lines, beam), grid.shape, grid.origin_m,
            np.stack([grid.row_step_m, grid.column_step_m]),
            lambda rows, columns, pixels=image.pixels: pixels[rows, columns],
        )  # fmt: skip
        assert 0.97 < found <= 1


@pytest.mark.slow
def test_what_cannot_be_resampled_is_refused(tmp_path):
    place = local(217.0)
    lines, grid = lines_of(place, "points"), grid_of(place, 0.05)
    image = noise(grid)
    raised = clsas.Image(image.pixels, grid.with_height(np.zeros(grid.shape)))
    tiny = noise(grid.window(slice(0, 20), slice(0, 40)))
    far = replace(lines, first_range_m=900.0)
    for source, how, message in (
        (image, {}, "lines must be given for complex pixels with `north_up`"),
        (raised, {"lines": lines}, "north_up must be off for complex pixels of a height map"),
        (image, {"lines": replace(lines, georeference=local(1.0))}, "lines must have the georef"),
        (image, {"lines": lines.without_samples()}, "lines must have samples other than 0"),
        (image, {"lines": far, "beam": BEAM}, "lines must reach the image within the beam"),
        (tiny, {"lines": lines, "beam": BEAM}, "source must have at least 26 rows and columns"),
        (image, {"lines": lines, "pixel_m": 2.0}, "pixel_m must be at most 16 times"),
        (image, {"lines": lines, "pixel_m": 1e300}, "pixel_m must be at most 16 times"),
        (
            image, {"lines": lines, "beam": BEAM},
            r"north_up must cause an error of at most -40 dB in complex pixels, got up to .* dB: "
            r"form the image on the grid of `Georeference.north_up`, or with rows at most 0.01\d* "
            r"m and columns at most 0.0\d* m apart \(they are 0.05 m and 0.05 m\)",
        ),
        (
            noise(grid_of(place, 0.01)), {"lines": lines, "beam": BEAM},
            "lines must be those that formed the image, with the same `beam`: the image's spatial",
        ),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            resampled(source, tmp_path / "a.tif", **how)
    assert list(tmp_path.iterdir()) == []
