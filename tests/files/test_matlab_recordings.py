"""Phase histories and full matrix captures in MATLAB files."""

import struct
import zlib

import numpy as np
import pytest
from damaging import refused
from scipy.constants import speed_of_light
from scipy.io import savemat

import clsas
from clsas.engine.data.validate import ClsasWarning
from clsas.files import matlab
from clsas.files.full_matrix import read_full_matrix
from clsas.files.hdf5 import FileFormatError
from clsas.files.phase_histories import read_phase_history

POINT_M = np.array([3.0, -4.0, 0.0])


def phase_history(pulses=90, count=128, kind=np.float32, offset_m=0.0):
    """Write a radar pass over one point in single precision, as the public radar files do."""
    angle = np.linspace(-0.03, 0.03, pulses)
    antenna_m = 7000 * np.stack([np.cos(angle), np.sin(angle), 1 + 0 * angle], axis=1)
    antenna_m = antenna_m.astype(kind).astype(float)
    reference_m = np.linalg.norm(antenna_m, axis=1) + offset_m
    frequency = 9.3e9 + 1.5e6 * np.arange(count)
    range_m = np.linalg.norm(POINT_M - antenna_m, axis=1)
    cycles = 2 / speed_of_light * np.outer(frequency, range_m - reference_m)
    columns = dict(zip("xyz", antenna_m.T.astype(kind), strict=True))
    return {
        "fp": np.exp(-2j * np.pi * cycles).astype(np.complex64),
        "freq": frequency.astype(kind)[:, None],
        "r0": reference_m.astype(kind)[None],
        **{axis: values[None] for axis, values in columns.items()},
    }


def save(path, variables, compressed=True):
    savemat(path, variables, do_compression=compressed)
    return path


@pytest.mark.parametrize("nested", [True, False], ids=["structure", "variables"])
@pytest.mark.parametrize(
    ("kind", "offset_m"), [(np.float32, 0.0), (np.float64, 0.0), (np.float64, 4.321)]
)
def test_a_point_of_a_phase_history_focuses(tmp_path, nested, kind, offset_m):
    history = phase_history(kind=kind, offset_m=offset_m)
    path = save(tmp_path / "pass.mat", {"data": history} if nested else history)
    lines = clsas.load(path)
    assert (lines.channels, lines.length) == (90, 256)
    np.testing.assert_array_equal(lines.tx_m, lines.rx_m)
    grid = clsas.Grid.plane(x=(1, 5, 41), y=(-6, -2, 41))
    image = clsas.backproject(lines, grid, accuracy_db=-60)
    row, column = np.unravel_index(np.abs(image.pixels).argmax(), grid.shape)
    assert (row, column) == (20, 20)
    assert image.pixels[20, 20] == pytest.approx(lines.channels, rel=5e-3)


@pytest.mark.parametrize(("unit", "factor"), [("GHz", 1e9), ("MHz", 1e6)])
@pytest.mark.parametrize("first_hz", [9.3e9, 0.42e9, 16e9])
def test_frequencies_in_ghz_or_mhz_are_converted_with_a_warning(tmp_path, unit, factor, first_hz):
    history = phase_history(kind=np.float64)
    frequency = first_hz + 1.5e6 * np.arange(128)
    antenna_m = np.stack([history[axis][0] for axis in "xyz"], axis=1)
    range_m = np.linalg.norm(POINT_M - antenna_m, axis=1) - history["r0"][0]
    history["fp"] = np.exp(-4j * np.pi / speed_of_light * np.outer(frequency, range_m))
    path = save(tmp_path / "pass.mat", history | {"freq": frequency / factor})
    with pytest.warns(ClsasWarning, match=f"taken as {unit}"):
        lines = clsas.load(path)
    assert lines.carrier_hz == pytest.approx(frequency.mean())
    image = clsas.backproject(lines, clsas.Grid.points([POINT_M]), accuracy_db=-60)
    assert abs(image.pixels[0]) == pytest.approx(lines.channels, rel=0.01)


def test_frequencies_of_an_unclear_unit_are_refused(tmp_path):
    """Without reference ranges, MHz and GHz are equally likely."""
    history = phase_history(kind=np.float64)
    changed = {"freq": history["freq"] / 1e9, "r0": 0 * history["r0"]}
    with pytest.raises(ValueError, match=r"pass\.mat: freq must be in Hz, got 9\.3 to 9\.49"):
        clsas.load(save(tmp_path / "pass.mat", history | changed))


def test_windows_are_passed_on(tmp_path):
    path = save(tmp_path / "pass.mat", phase_history())
    plain, windowed = (read_phase_history(path, window=name) for name in ("none", "hamming"))
    widths = [np.count_nonzero(np.abs(each.samples[0]) > 0.5) for each in (plain, windowed)]
    assert widths[1] > widths[0]
    with pytest.raises(ValueError, match=r"pass\.mat: window must be 'none' or a window"):
        read_phase_history(path, window="nonsense")


ELEMENTS_M = np.stack([np.linspace(-8e-3, 8e-3, 32), np.zeros(32), np.zeros(32)], axis=1)
NOTCH_M = np.array([2e-3, 15e-3, 0.0])


def capture(every=False):
    """Write a full matrix capture of one point; without `every`, only pairs with tx <= rx."""
    tx, rx = np.indices((32, 32)).reshape(2, -1)
    if not every:
        tx, rx = tx[tx <= rx], rx[tx <= rx]
    time_s = 2e-7 + np.arange(400) / 25e6
    leg_s = np.linalg.norm(NOTCH_M - ELEMENTS_M, axis=1) / 6000
    delay = time_s[:, None] - (leg_s[tx] + leg_s[rx])
    samples = np.exp(-((delay / 1.5e-7) ** 2)) * np.cos(2 * np.pi * 5e6 * delay) + 0.02
    return {
        "time_data": samples,
        "time": time_s[:, None],
        "tx": (tx + 1).astype(np.uint8)[None],
        "rx": (rx + 1).astype(np.uint8)[None],
        "array": {"el_xc": ELEMENTS_M[None, :, 0], "centre_freq": 5e6},
        "ph_velocity": 6000.0,
    }


def image_of(lines):
    grid = clsas.Grid.plane(x=(0, 4e-3, 41), y=(13e-3, 17e-3, 41))
    return clsas.backproject(lines, grid, accuracy_db=-60)


def test_a_point_of_a_full_matrix_focuses_and_pairs_stand_for_their_reverse(tmp_path):
    half, full = (
        clsas.load(save(tmp_path / f"{every}.mat", {"exp_data": capture(every)}))
        for every in (False, True)
    )
    assert (half.channels, full.channels) == (528, 1024)
    assert half.sound_speed_m_s == 6000
    images = [image_of(lines) for lines in (half, full)]
    assert clsas.relative_error_db(*images) < -75
    row, column = np.unravel_index(np.abs(images[0].pixels).argmax(), (41, 41))
    assert (row, column) == (20, 20)


def test_a_full_matrix_as_a_cube_is_that_of_its_pairs(tmp_path):
    given = capture(every=True)
    of_pairs = clsas.load(save(tmp_path / "full.mat", given))
    cube = clsas.from_full_matrix(
        given["time_data"].T.reshape(32, 32, -1),
        ELEMENTS_M,
        sample_rate_hz=25e6,
        carrier_hz=5e6,
        sound_speed_m_s=6000,
        start_time_s=2e-7,
    )
    np.testing.assert_allclose(cube.samples, of_pairs.samples, atol=1e-5)


def test_the_sound_speed_may_be_given_and_must_be_known(tmp_path):
    given = capture()
    path = save(tmp_path / "half.mat", given)
    assert read_full_matrix(path, sound_speed_m_s=6320).sound_speed_m_s == 6320
    del given["ph_velocity"]
    path = save(path, given)
    with pytest.raises(
        ValueError, match=r"sound_speed_m_s must be given, since .* has no ph_velocity"
    ):
        read_full_matrix(path)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"tx": np.zeros((1, 528), np.uint8)}, "pairs must be from 0 to 31, got -1"),
        ({"tx": np.full((1, 528), 1.5)}, "tx and rx as whole numbers"),
        ({"rx": np.ones((1, 5), np.uint8)}, "time_data of shape"),
        ({"time": np.zeros((400, 1))}, "time in equal, ascending steps"),
        ({"time_data": np.ones((400, 528), complex)}, "time_data as real numbers"),
        ({"time_data": np.full((400, 528), np.nan)}, "samples must be finite"),
        ({"array": 3.0}, "array as a structure"),
        ({"array": {"centre_freq": 5e6}}, "el_xc as real numbers"),
        ({"array": {"el_xc": np.ones((1, 32)), "centre_freq": "x"}}, "centre_freq as real"),
    ],
)
def test_captures_that_disagree_are_refused(tmp_path, change, said):
    path = save(tmp_path / "half.mat", {"exp_data": capture() | change})
    with pytest.raises(ValueError, match=rf"half\.mat.* {said}"):
        clsas.load(path)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"x": np.ones((1, 3))}, "x, y, z and r0 for every pulse"),
        ({"freq": np.ones((128, 1))}, "freq in equal, ascending steps"),
        ({"freq": np.sqrt(np.arange(128.0))[:, None]}, "freq in equal, ascending steps"),
        ({"fp": np.ones((128, 90))}, "fp as complex numbers"),
        ({"fp": np.full((128, 90), np.nan * 1j)}, "samples must be finite"),
        ({"r0": np.full((1, 90), np.nan)}, "reference_range_m must be finite"),
        ({"y": "text"}, "y as real numbers"),
        ({"z": np.full((1, 90), np.nan)}, "tx_m must be finite, got 90 NaN .* first at .0, 2."),
        ({"x": np.zeros((1, 0))}, "x(, y, z and r0 of every pulse| as real numbers)"),
    ],
)
def test_histories_that_disagree_are_refused(tmp_path, change, said):
    path = save(tmp_path / "pass.mat", {"data": phase_history() | change})
    with pytest.raises(ValueError, match=rf"pass\.mat.* {said}"):
        clsas.load(path)


def swapped(values):
    order = np.arange(90)
    order[[40, 44]] = 44, 40
    return {name: each if name == "freq" else each[:, order] for name, each in values.items()}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda values: values | {axis: np.full((1, 90), 50.0) for axis in "xyz"},
            "all 90 pings have the same position. The navigation seems to be missing",
        ),
        (swapped, r"the track turns back \d times \(first after ping 4\d\), .* order of the file"),
    ],
)
def test_navigation_that_is_missing_or_out_of_order_is_reported(tmp_path, change, said):
    path = save(tmp_path / "pass.mat", {"data": change(phase_history(offset_m=1.0))})
    with pytest.warns(ClsasWarning, match=rf"pass\.mat: {said}"):
        assert clsas.load(path).channels == 90


def test_one_ping_is_read(tmp_path):
    history = phase_history()
    one = {name: each if name == "freq" else each[:, :1] for name, each in history.items()}
    assert clsas.load(save(tmp_path / "one.mat", one)).channels == 1


def test_files_without_a_recording_and_with_several_are_refused(tmp_path):
    path = save(tmp_path / "other.mat", {"a": np.ones(3)})
    with pytest.raises(
        FileFormatError, match=r"other\.mat must contain one structure with the fields"
    ):
        clsas.load(path)
    path = save(tmp_path / "two.mat", {"a": phase_history(), "b": phase_history()})
    with pytest.raises(FileFormatError, match="fields fp, freq, x, y, z, r0, got 2"):
        clsas.load(path)


def variable(kind, shape, parts=b""):
    """Return a matrix of a given kind in MATLAB's format 5."""
    body = struct.pack("<IIII", 6, 8, kind, 0)
    body += struct.pack("<II", 5, 4 * len(shape)) + struct.pack(f"<{len(shape)}i", *shape)
    body += b"\0" * (-4 * len(shape) % 8) + struct.pack("<HHI", 1, 1, ord("a")) + parts
    return struct.pack("<II", 14, len(body)) + body


def file_of(path, element):
    path.write_bytes(
        b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H", 0x0100) + b"IM" + element
    )
    return path


def packed(element):
    content = zlib.compress(element)
    return struct.pack("<II", 15, len(content)) + content


@pytest.mark.parametrize("wrap", [bytes, packed], ids=["plain", "compressed"])
@pytest.mark.parametrize("shape", [(30_000, 30_000), (2**31 - 1, 2**31 - 1), (-5, 1), (7,)])
def test_numbers_that_claim_more_than_they_hold_allocate_nothing(tmp_path, wrap, shape):
    path = file_of(tmp_path / "claim.mat", wrap(variable(6, shape, struct.pack("<IId", 9, 8, 1.0))))
    with pytest.raises(FileFormatError, match=r"claim\.mat is damaged: .* shape"):
        clsas.load(path)


def test_cells_and_text_are_passed_over(tmp_path):
    extra = np.empty((3,), object)
    extra[:] = [1, "a", 2.0]
    given = {"cells": extra, "text": "words", "data": phase_history(), "many": [{"a": 1}, {"a": 2}]}
    assert clsas.load(save(tmp_path / "pass.mat", given)).channels == 90


def test_a_variable_that_unpacks_beyond_memory_is_refused_unread(tmp_path, monkeypatch):
    monkeypatch.setattr(matlab.validate, "_memory_bytes", lambda: 1 << 24)
    path = file_of(tmp_path / "bomb.mat", packed(struct.pack("<II", 14, 1 << 30) + bytes(1 << 20)))
    assert path.stat().st_size < 5000
    with pytest.raises(FileFormatError, match=r"bomb\.mat is too large: unpacking it"):
        clsas.load(path)


def test_variables_must_fit_into_memory_together(tmp_path, monkeypatch):
    """Each array alone would fit: 5 MB in the file, and 8 times as much as doubles."""
    one = packed(variable(6, (5000, 1000), struct.pack("<II", 1, 5_000_000) + bytes(5_000_000)))
    path = file_of(tmp_path / "sum.mat", one + one + one)
    assert path.stat().st_size < 20_000
    monkeypatch.setattr(matlab.validate, "_memory_bytes", lambda: 80 << 20)
    words = r"sum\.mat is too large: reading numbers must ask for at most .* got 0\.0373 GiB"
    with pytest.raises(FileFormatError, match=words):
        clsas.load(path)
    with pytest.raises(FileFormatError, match="must contain one structure"):
        clsas.load(file_of(tmp_path / "one.mat", one))


def test_fields_without_numbers_take_memory_too(tmp_path, monkeypatch):
    path = file_of(tmp_path / "many.mat", packed(variable(2, (1, 1), bytes(8 * 100_000))))
    assert path.stat().st_size < 2000
    monkeypatch.setattr(matlab.validate, "_memory_bytes", lambda: 16 << 20)
    with pytest.raises(FileFormatError, match=r"many\.mat is too large: reading fields must ask"):
        clsas.load(path)


def test_nesting_without_end_is_refused(tmp_path):
    inner = variable(6, (0, 0), struct.pack("<II", 9, 0))
    names = struct.pack("<HHIII", 5, 4, 8, 1, 8) + b"deeper".ljust(8, b"\0")
    for _ in range(100):
        inner = variable(2, (1, 1), names + inner)
    with pytest.raises(FileFormatError, match="at most 32 levels of nested structures"):
        clsas.load(file_of(tmp_path / "deep.mat", inner))


@pytest.mark.parametrize("compressed", [True, False])
def test_damaged_files_end_in_one_error_or_the_same_lines(tmp_path, compressed):
    whole = save(tmp_path / "pass.mat", phase_history(8, 16), compressed).read_bytes()
    assert refused(whole, tmp_path / "damaged.mat", number=150, flips=3) > 60
