"""SICD files of radar images."""

import errno
from dataclasses import replace

import numpy as np
import pytest
from placed import UTM_NORTH, local
from tiers import thinned

import clsas

pytest.importorskip("sarkit", reason="sarkit (extra radar) is not installed")

import sarkit.sicd
import sarkit.verification
import sarkit.wgs84

LIGHT_M_S = 299_792_458.0
CARRIER_HZ, BAND_HZ, STEP_M = 9.6e9, 100e6, 1.0
SHAPE, PIXEL_M = (48, 56), (1.25, 0.9)
TARGETS = {(0.0, 0.0, 0.0): 4.0, (15.0, -20.0, 0.0): 1.0, (-18.0, 10.0, 0.0): 0.5j}
MIDDLE_M = (0.0, -1.25, 0.0)  # of the grid: the scene centre point
PLACES = [UTM_NORTH, local(0.0), local(217.0), local(90.0, latitude=-33.5)]


def shift_m(place):
    """Where the scene lies in the coordinates of a georeference."""
    return np.array([500_000.0, 6_700_000.0, 20.0]) if place.is_projected else np.zeros(3)


def track_m(place):
    """Phase centres of a radar to the port side, 5 km away, on a slightly curved track."""
    along_m = np.linspace(-30, 30, 61)
    height_m = np.full(len(along_m), 3000.0)
    return np.stack([along_m, 4000 + 1e-4 * along_m**2, height_m], axis=1) + shift_m(place)


def responses(antenna_m, points_m, targets, place):
    """Sum of the targets' responses at points, before they are moved to their ranges."""
    total = 0.0
    for target_m, amplitude in targets.items():
        range_m = np.linalg.norm(np.array(target_m) + shift_m(place) - antenna_m)
        away_m = points_m - range_m
        total = total + amplitude * np.sinc(2 * BAND_HZ / LIGHT_M_S * away_m) * np.exp(
            -4j * np.pi * CARRIER_HZ / LIGHT_M_S * range_m
        )
    return total


def lines_of(place, targets=TARGETS, **fields):
    """Range lines of targets, whose spectrum is constant over the band."""
    antennas_m, at_m = track_m(place), 4900 + STEP_M * np.arange(220)
    samples = np.stack([responses(each, at_m, targets, place) for each in antennas_m])
    given = {"carrier_hz": CARRIER_HZ, "sound_speed_m_s": LIGHT_M_S, "georeference": place}
    return clsas.RangeLines(samples, 4900.0, STEP_M, antennas_m, antennas_m, **(given | fields))


def image_of(place, turn=None, targets=TARGETS):
    """The image of targets, by its definition, on a grid whose pixels have any order."""
    rows, columns = SHAPE
    row_m, column_m = np.array([0, PIXEL_M[0], 0]), np.array([PIXEL_M[1], 0, 0])
    origin_m = shift_m(place) - row_m * (rows // 2) - column_m * (columns // 2)
    if turn == "transposed":
        row_m, column_m, rows, columns = column_m, row_m, columns, rows
    elif turn == "reversed":
        origin_m, row_m = origin_m + (rows - 1) * row_m, -row_m
    grid = clsas.Grid.oriented(origin_m, row_m, column_m, (rows, columns), georeference=place)
    pixels = np.zeros(grid.shape, complex)
    for antenna_m in track_m(place):
        range_m = np.linalg.norm(grid.positions_m() - antenna_m, axis=-1)
        turns = np.exp(4j * np.pi * CARRIER_HZ / LIGHT_M_S * range_m)
        pixels += responses(antenna_m, range_m, targets, place) * turns
    return clsas.Image(pixels / len(track_m(place)), grid)


def exported(source, path, remarks=(), **options):
    """Return pixels, XML tree and elements of a file that passes the checker but for remarks."""
    clsas.export(source, path, **options)
    with path.open("rb") as file:
        checker = sarkit.verification.SicdConsistency.from_file(file)
    checker.check()
    assert len(checker.passes()) > 35
    assert set(checker.failures()) == set(remarks)
    with path.open("rb") as file, sarkit.sicd.NitfReader(file) as reader:
        tree = reader.metadata.xmltree
        return reader.read_image(), tree, sarkit.sicd.ElementWrapper(tree.getroot())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("place", "turn"), thinned(PLACES, [None, "transposed", "reversed"]), ids=str
)
def test_pixels_and_places_come_back(place, turn, tmp_path):
    image = image_of(place, turn)
    pixels, tree, root = exported(image, tmp_path / "a.nitf", lines=lines_of(place))
    assert [each.name for each in tmp_path.iterdir()] == ["a.nitf"]
    # Seen from the radar at larger y, columns run along x, and rows away from it.
    plain = image_of(place)
    expected = plain.pixels[::-1]
    assert np.abs(expected).argmax() != np.abs(plain.pixels).argmax()
    np.testing.assert_array_equal(pixels, expected if turn is None else image_as(image, turn))
    np.testing.assert_allclose(pixels, expected, atol=1e-5)  # of other grids, but for rounding
    for target_m in TARGETS:
        llh = place.to_geographic(target_m + shift_m(place))
        ecf_m = sarkit.wgs84.geodetic_to_cartesian(llh)
        at_m, _, found = sarkit.sicd.scene_to_image(tree, ecf_m)
        assert found
        # Range and Doppler of the target meet the plane of the image in its pixel.
        away_m = np.array([MIDDLE_M[1] - target_m[1], target_m[0] - MIDDLE_M[0]])
        np.testing.assert_allclose(at_m, away_m, atol=0.02)
    positions_m = plain.grid.positions_m()[::-1]
    np.testing.assert_allclose(
        root["GeoData"]["ImageCorners"],
        place.to_geographic(positions_m[[0, 0, -1, -1], [0, -1, -1, 0]])[:, :2],
        atol=1e-9,
    )
    assert root["Grid"]["ImagePlane"] == "GROUND"
    assert root["SCPCOA"]["SideOfTrack"] == "R"
    assert root["SCPCOA"]["GrazeAng"] == pytest.approx(np.degrees(np.arctan2(3000, 4000)), abs=0.05)


def test_gdal_reads_the_same_pixels(tmp_path):
    rasterio = pytest.importorskip("rasterio")
    place = local(217.0)
    clsas.export(image_of(place), tmp_path / "a.nitf", lines=lines_of(place))
    with rasterio.open(tmp_path / "a.nitf") as file:
        real, imaginary = file.read()
        corners = [(point.x, point.y) for point in file.gcps[0]]  # to a second of arc
    np.testing.assert_array_equal(real + 1j * imaginary, image_of(place).pixels[::-1])
    positions_m = image_of(place).grid.positions_m()[::-1]
    expected = place.to_geographic(positions_m[[0, 0, -1, -1], [0, -1, -1, 0]])
    np.testing.assert_allclose(corners, expected[:, 1::-1], atol=0.51 / 3600)


def image_as(image, turn):
    """Pixels of a turned image in the order of the file."""
    return image.pixels.T[::-1] if turn == "transposed" else image.pixels


def test_band_and_widths_are_those_of_the_pixels(tmp_path):
    """The response at the scene centre point, transformed with the sign that the file states."""
    place, targets = local(0.0), {MIDDLE_M: 1.0}
    image, lines = image_of(place, targets=targets), lines_of(place, targets)
    pixels, _, root = exported(image, tmp_path / "a.nitf", lines=lines)
    middle = np.unravel_index(np.abs(pixels).argmax(), SHAPE)
    assert middle == tuple(root["ImageData"]["SCPPixel"]) == (24, 28)
    fine = np.linspace(-3, 3, 2401)  # pixels
    frequency = np.fft.fftfreq(1024)
    range_m = np.hypot(4001.25, 3000)
    bandwidths = (
        2 * BAND_HZ / LIGHT_M_S * 4001.25 / range_m,
        2 * CARRIER_HZ / LIGHT_M_S * 60 / range_m,
    )
    for axis, (name, bandwidth) in enumerate(zip(("Row", "Col"), bandwidths, strict=True)):
        stated = root["Grid"][name]
        assert stated["SS"] == pytest.approx(PIXEL_M[axis], rel=1e-6)
        assert stated["Sgn"] == -1
        power = (np.abs(np.fft.fft(pixels, 1024, axis=axis)) ** 2).sum(axis=1 - axis)
        above = np.sort(frequency[power > np.median(np.sort(power)[-400:]) / 2])
        low, high = above[[0, -1]] / PIXEL_M[axis]
        assert stated["DeltaK1"] <= low + 0.03
        assert stated["DeltaK2"] >= high - 0.03
        assert stated["ImpRespBW"] == pytest.approx(bandwidth, rel=0.05)
        centre = stated["DeltaKCOAPoly"][0, 0]
        assert centre == pytest.approx((low + high) / 2, abs=0.02)
        assert stated["KCtr"] * PIXEL_M[axis] == pytest.approx(
            round(stated["KCtr"] * PIXEL_M[axis])
        )
        # Between pixels, the response is a sum over its spectrum.
        line = np.take(pixels, middle[1 - axis], axis=1 - axis)
        spectrum = np.fft.fft(np.roll(line, -middle[axis]))
        turns = np.exp(2j * np.pi * np.multiply.outer(fine, np.fft.fftfreq(len(line))))
        response = np.abs(turns @ spectrum)
        above = np.flatnonzero(response >= response.max() / np.sqrt(2))
        width_m = np.ptp(fine[above]) * PIXEL_M[axis]
        assert stated["ImpRespWid"] == pytest.approx(width_m, rel=0.05)
    geometry = 2 * CARRIER_HZ / LIGHT_M_S * 4001.25 / range_m
    row = root["Grid"]["Row"]
    assert row["KCtr"] + row["DeltaKCOAPoly"][0, 0] == pytest.approx(geometry, rel=1e-3)
    band = root["RadarCollection"]["TxFrequency"]
    assert band["Min"] == pytest.approx(CARRIER_HZ - BAND_HZ / 2, abs=0.03 * BAND_HZ)
    assert band["Max"] == pytest.approx(CARRIER_HZ + BAND_HZ / 2, abs=0.03 * BAND_HZ)


@pytest.mark.slow
def test_a_beam_sets_time_and_band_along_the_track(tmp_path):
    place = local(0.0)
    image, lines = image_of(place), lines_of(place)
    beam = clsas.BeamWindow(0.2, along=[1, 0, 0])  # 17 m of the track
    _, _, whole = exported(image, tmp_path / "a.nitf", lines=lines)
    coarse = ["check_iprbw_to_ss_osr_col"]  # pixels are far smaller than the response
    _, _, part = exported(image, tmp_path / "b.nitf", coarse, lines=lines, beam=beam)
    assert whole["Grid"]["TimeCOAPoly"].shape == (1, 1)
    assert whole["Grid"]["TimeCOAPoly"][0, 0] == pytest.approx(0.03)
    time = part["Grid"]["TimeCOAPoly"]
    # Pings are 1 m and 1 ms apart; a pixel is observed when the radar is abreast of it.
    assert time[0, 1] == pytest.approx(1e-3, rel=0.1)
    assert part["Grid"]["Col"]["ImpRespBW"] < 0.5 * whole["Grid"]["Col"]["ImpRespBW"]
    assert part["Grid"]["Col"]["ImpRespWid"] > 2 * whole["Grid"]["Col"]["ImpRespWid"]
    assert part["Grid"]["Row"]["ImpRespWid"] == pytest.approx(
        whole["Grid"]["Row"]["ImpRespWid"], rel=0.01
    )


def test_a_tilted_plane_keeps_its_direction(tmp_path):
    place = local(30.0)
    grid = clsas.Grid.oriented([-20, 25, 8], [0, -1, -0.3], [0.9, 0, 0], SHAPE, georeference=place)
    pixels = np.random.default_rng(1).normal(size=(2, *SHAPE))
    image = clsas.Image(pixels[0] + 1j * pixels[1], grid)
    read, _, root = exported(image, tmp_path / "a.ntf", lines=lines_of(place))
    np.testing.assert_array_equal(read, image.pixels)
    assert root["Grid"]["ImagePlane"] == "OTHER"
    up = sarkit.wgs84.up(root["GeoData"]["SCP"]["LLH"])
    row = root["Grid"]["Row"]
    assert row["UVectECF"] @ up == pytest.approx(-0.3 / np.hypot(1, 0.3), abs=1e-5)
    assert row["SS"] == pytest.approx(np.hypot(1, 0.3), rel=1e-6)


@pytest.mark.slow
def test_a_mosaic_is_read_patch_by_patch(tmp_path):
    place = local(217.0)
    lines, grid = lines_of(place), image_of(place).grid
    for _ in clsas.mosaic(lines, grid, tmp_path / "a.zarr", accuracy_db=-50, patches=(2, 3)):
        pass
    store = clsas.Store.opened(tmp_path / "a.zarr")
    done = []
    pixels, _, root = exported(
        store, tmp_path / "a.nitf", lines=lines, progress=lambda *steps: done.append(steps)
    )
    np.testing.assert_array_equal(pixels, store.image().pixels[::-1])
    assert done == [(n, 6) for n in range(7)]
    parameters = dict(root["ImageFormation"]["Processing"][0]["Parameter"])
    assert parameters["PATCHES"] == "6"
    assert float(parameters["ACCURACY_DB"]) == -50


OVERHEAD_M = np.stack([np.linspace(-31, 30, 61), np.zeros(61), np.full(61, 5e3)], axis=1)


def apart(lines):
    return replace(lines, rx_m=lines.rx_m + [0, 200, 0])


REFUSED = {
    "no lines": (lambda image, lines: (image, None), "lines must be given for SICD"),
    "sonar": (
        lambda image, lines: (image, replace(lines, sound_speed_m_s=1500.0)),
        "lines must be those of a radar for SICD.* got 1500 m/s: export sonar images as a GeoTIFF",
    ),
    "no place": (
        lambda image, lines: (
            clsas.Image(image.pixels, replace(image.grid, georeference=None)),
            replace(lines, georeference=None),
        ),
        "source must have a georeference for SICD",
    ),
    "another place": (
        lambda image, lines: (image, replace(lines, georeference=local(1.0))),
        "lines must have the georeference of the source",
    ),
    "heights": (
        lambda image, lines: (
            clsas.Image(image.pixels, image.grid.with_height(np.zeros(SHAPE))),
            lines,
        ),
        "source must be on a plane for SICD, got a height map",
    ),
    "points": (
        lambda image, lines: (
            clsas.Image(
                image.pixels,
                clsas.Grid.points(image.grid.positions_m(), georeference=image.georeference),
            ),
            lines,
        ),
        "source must be on a plane for SICD, got points",
    ),
    "skewed": (
        lambda image, lines: (
            clsas.Image(image.pixels, replace(image.grid, column_step_m=[0.9, 0.1, 0])),
            lines,
        ),
        "source must have perpendicular rows and columns",
    ),
    "one row": (
        lambda image, lines: (
            clsas.Image(image.pixels[:1], replace(image.grid, shape=(1, SHAPE[1]))),
            lines,
        ),
        "source must have at least 2 rows",
    ),
    "vertical": (
        lambda image, lines: (
            clsas.Image(image.pixels, replace(image.grid, row_step_m=[0, 0, 1.25])),
            lines,
        ),
        "grid must not be vertical",
    ),
    "silent": (
        lambda image, lines: (image, replace(lines, samples=0 * lines.samples)),
        "lines must have samples other than 0",
    ),
    "one ping": (
        lambda image, lines: (image, lines.select(slice(0, 1))),
        "lines must have at least 2 pings",
    ),
    "bistatic": (
        lambda image, lines: (image, apart(lines)),
        "lines must be monostatic for SICD, got transmitters and receivers up to 200 m apart",
    ),
    "shuffled": (
        lambda image, lines: (
            image,
            lines.select(np.random.default_rng(2).permutation(lines.channels)),
        ),
        "lines must come from one pass in the order of recording",
    ),
    "elsewhere": (
        lambda image, lines: (image, replace(lines, first_range_m=9000.0)),
        "lines must reach the middle of the image",
    ),
    "overhead": (
        lambda image, lines: (image, replace(lines, tx_m=OVERHEAD_M, rx_m=OVERHEAD_M)),
        "lines must look at the grid from the side, not from straight above",
    ),
    "below 0 Hz": (
        lambda image, lines: (image, replace(lines, carrier_hz=0.0)),
        "lines must have frequencies above 0 Hz",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_the_standard_cannot_describe_is_refused(name, tmp_path):
    make, message = REFUSED[name]
    image, lines = make(image_of(local(0.0)), lines_of(local(0.0)))
    with pytest.raises(ValueError, match=message):
        clsas.export(image, tmp_path / "a.nitf", lines=lines)
    assert list(tmp_path.iterdir()) == []


def test_options_without_effect_are_refused(tmp_path):
    image, lines = image_of(local(0.0)), lines_of(local(0.0))
    with pytest.raises(
        ValueError, match=r"kind must be left out, since it has no effect on \.nitf"
    ):
        clsas.export(image, tmp_path / "a.nitf", lines=lines, kind="complex")
    with pytest.raises(ValueError, match=r"beam must be left out.*\.tif with `kind='db'`"):
        clsas.export(image, tmp_path / "a.tif", beam=clsas.BeamWindow(1.0))
    with pytest.raises(TypeError, match="beam must be"):
        clsas.export(image, tmp_path / "a.nitf", lines=lines, beam=3.0)


def test_a_beam_of_a_single_ping_is_refused(tmp_path):
    image, lines = image_of(local(0.0)), lines_of(local(0.0))
    beam = clsas.BeamWindow(0.02, along=[1, 0, 0])
    with pytest.raises(ValueError, match="lines must resolve the middle of the image"):
        clsas.export(image, tmp_path / "a.nitf", lines=lines, beam=beam)
    assert list(tmp_path.iterdir()) == []


def test_heights_above_another_surface_cause_a_warning(tmp_path):
    place = replace(local(0.0), vertical_datum="NN2000")
    with pytest.warns(clsas.ClsasWarning, match="heights above NN2000 are written as heights"):
        clsas.export(image_of(place), tmp_path / "a.nitf", lines=lines_of(place))


@pytest.mark.slow
def test_places_on_the_equator_and_the_prime_meridian_are_written(tmp_path):
    """sarkit's own format of latitudes has no sign for 0."""
    place = clsas.Georeference.local(0.0, 0.0, heading_deg=90.0)
    grid = replace(image_of(place).grid, origin_m=[0.0, 0.0, 0.0])
    image = clsas.Image(image_of(place).pixels, grid)
    _, _, root = exported(image, tmp_path / "a.nitf", lines=lines_of(place))
    assert np.abs(root["GeoData"]["ImageCorners"]).min() < 1e-9


def test_a_full_disk_leaves_the_earlier_file(tmp_path, monkeypatch):
    image, lines = image_of(local(0.0)), lines_of(local(0.0))
    (tmp_path / "a.nitf").write_bytes(b"earlier")

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("clsas.maps.sicd._write_pixels", full)
    with pytest.raises(OSError, match=r"No space left on device: '.*a\.nitf'"):
        clsas.export(image, tmp_path / "a.nitf", lines=lines)
    assert (tmp_path / "a.nitf").read_bytes() == b"earlier"
    assert [each.name for each in tmp_path.iterdir()] == ["a.nitf"]


@pytest.mark.parametrize("name", ["image.nitf", "page"])
def test_a_missing_grid_is_one_warning_of_an_export(name, tmp_path, without_grids):
    place = clsas.Georeference.projected("EPSG:26710")  # NAD 27
    lines = lines_of(place) if name == "image.nitf" else None
    with pytest.warns(clsas.ClsasWarning, match="pyproj sync --file") as caught:
        clsas.export(image_of(place), tmp_path / name, lines=lines)
    assert len([each for each in caught if each.category is clsas.ClsasWarning]) == 1
