"""AirSAS scenes, from synthetic files with the schema of the public data set."""

import shutil

import h5py
import numpy as np
import pytest

import clsas
from clsas.engine.data import validate
from clsas.engine.data.validate import ClsasWarning
from clsas.files import airsas
from clsas.files.airsas import read_airsas
from clsas.files.hdf5 import FileFormatError

RATE_HZ, GROUP_DELAY = 100e3, 38.2
START_HZ, STOP_HZ, DURATION_S, TAPER = 30e3, 10e3, 1e-3, 0.1
SPEAKER_M = np.array([0.0, 0.0, 1.1])
MICROPHONES_M = np.array([[0.1, 0.0, 1.1], [0.14, 0.01, 1.12]])
POINTS_M = np.array([[1.5, 1.7, 0.6], [1.9, 2.1, 0.6]])
RAIL_M = np.linspace(0.5, 2.5, 201)
PARAMETERS = [
    ("Sample rate", RATE_HZ), ("Group delay", GROUP_DELAY), ("Channels", 4), ("Range", "10 V"),
    ("a", 1), ("b", 2), ("c", 3), ("Start frequency", START_HZ), ("Stop frequency", STOP_HZ),
    ("Pulse length", DURATION_S), ("Amplitude", 1), ("Window", "Tukey"), ("Taper", TAPER),
]  # fmt: skip


def samples_of(microphone_m, speed_m_s, length=1900):
    """Return real-valued echoes with the recorder's delay, an offset and the transmission."""
    pulse = clsas.Pulse(
        (START_HZ + STOP_HZ) / 2, abs(STOP_HZ - START_HZ), DURATION_S, "down", TAPER
    )
    time_s = (np.arange(length) - GROUP_DELAY) / RATE_HZ
    result = np.full((len(RAIL_M), length), 0.05)

    def arrival(delay_s):
        at = time_s - delay_s
        return (pulse.envelope(at) * np.exp(2j * np.pi * pulse.carrier_hz * at)).real

    for ping, rail_m in enumerate(RAIL_M):
        result[ping] += 30 * arrival(np.linalg.norm(SPEAKER_M - microphone_m) / speed_m_s[ping])
        for point_m in POINTS_M:
            path_m = sum(
                np.linalg.norm(point_m - sensor_m - [rail_m, 0, 0])
                for sensor_m in (SPEAKER_M, microphone_m)
            )
            result[ping] += arrival(path_m / speed_m_s[ping])
    return result


def scene(folder, drift_c=0.0, header=True):
    """Write a scene whose temperature drifts while the array moves along the rail."""
    shared = folder / "characterization data"
    shared.mkdir()
    (folder / "scenes").mkdir()
    rows = [f"{name},{value},unit" for name, value in PARAMETERS]
    text = ["Parameter,Value,Units"] * header + rows
    (shared / "acquistionParams.csv").write_text("\n".join(text) + "\n")
    sensors = [f"{n},{x},{y},{z}" for n, (x, y, z) in enumerate([SPEAKER_M, *MICROPHONES_M])]
    text = ["Sensor,X,Y,Z"] * header + sensors
    (shared / "sensorCoordinates.csv").write_text("\n".join(text) + "\n")
    celsius = np.linspace(20 - drift_c / 2, 20 + drift_c / 2, len(RAIL_M))
    path = folder / "scenes" / "t1e1_01.h5"
    with h5py.File(path, "w") as file:
        file.attrs["collection_date"] = "2020-06-01"
        file["na/position"] = RAIL_M[None]
        file["na/temperature"] = np.stack([celsius - 0.1, celsius + 0.1])
        file["na/humidity"] = np.full((1, len(RAIL_M)), 40.0)
        for number, microphone_m in enumerate(MICROPHONES_M, start=1):
            file[f"ch{number}/ts"] = samples_of(microphone_m, 331.6 + 0.61 * celsius)
            file[f"ch{number}/img_re"] = np.zeros((3, 3))
    return path


@pytest.fixture(scope="module")
def still(tmp_path_factory):
    return scene(tmp_path_factory.mktemp("still"))


def image_of(lines, point_m=POINTS_M[0]):
    x, y, z = point_m
    grid = clsas.Grid.plane((x - 0.05, x + 0.05, 41), (y - 0.05, y + 0.05, 41), z)
    return clsas.backproject(lines, grid, accuracy_db=-60)


@pytest.mark.parametrize("point_m", POINTS_M)
def test_points_focus_where_they_are(still, point_m):
    lines = clsas.load(still)
    assert lines.channels == 2 * len(RAIL_M)
    assert lines.carrier_hz == 20e3
    assert lines.sound_speed_m_s == pytest.approx(343.8)
    image = image_of(lines, point_m)
    row, column = np.unravel_index(np.abs(image.pixels).argmax(), image.grid.shape)
    assert (row, column) == (20, 20)
    # Echoes of amplitude 1 from all channels add up in phase.
    peak = image.pixels[20, 20] / lines.channels
    assert peak == pytest.approx(1.0, abs=0.06)


@pytest.mark.slow
def test_a_drifting_temperature_is_made_good(tmp_path, still):
    drifting = clsas.load(scene(tmp_path, drift_c=6.0, header=False))
    steady, found = (image_of(each).pixels for each in (clsas.load(still), drifting))
    assert np.abs(found).argmax() == np.abs(steady).argmax()
    assert np.abs(found).max() == pytest.approx(np.abs(steady).max(), rel=0.02)


def test_microphones_can_be_chosen(still):
    both, second = read_airsas(still), read_airsas(still, channels=[2])
    np.testing.assert_allclose(second.samples, both.samples[1::2], atol=1e-6)
    np.testing.assert_array_equal(second.rx_m, both.rx_m[1::2])
    for wrong in ([3], [], [0], ["a"]):
        with pytest.raises((ValueError, TypeError), match="channels must be"):
            read_airsas(still, channels=wrong)


def test_the_folder_of_what_scenes_share_can_be_given(still, tmp_path):
    alone = tmp_path / "alone.h5"
    alone.write_bytes(still.read_bytes())
    with pytest.raises(FileNotFoundError, match=r"acquistionParams\.csv"):
        read_airsas(alone)
    shared = still.parent.parent / "characterization data"
    assert read_airsas(alone, shared=shared, channels=[1]).channels == len(RAIL_M)


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("na/position", np.zeros((1, 7)), "/ch1/ts of shape .pings, time., 7 by 1900"),
        ("na/position", np.full((1, 201), np.nan), "finite numbers in /na/position"),
        ("na/temperature", np.zeros((2, 7)), "/na/temperature for 201 pings"),
        ("na/temperature", np.full((2, 201), 900.0), "degrees Celsius, got 900 to 900"),
        ("na/temperature", None, "numbers in /na/temperature"),
        ("ch2/ts", np.zeros((201, 5)), "/ch2/ts of shape"),
        ("ch2/ts", b"text", "ts as numbers"),
        ("ch2/ts", h5py.ExternalLink("/etc/hostname", "/x"), "got a link to another place"),
    ],
)
def test_scenes_that_disagree_are_refused(still, tmp_path, name, value, said):
    path = tmp_path / "scene.h5"
    path.write_bytes(still.read_bytes())
    with h5py.File(path, "r+") as file:
        del file[name]
        if value is not None:
            file[name] = value
    with pytest.raises(FileFormatError, match=rf"scene\.h5 .*{said}"):
        read_airsas(path, shared=still.parent.parent / "characterization data")


def swapped(rail):
    rail[:, [90, 95]] = rail[:, [95, 90]]
    return rail


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (np.zeros_like, "all 201 pings have the same position"),
        (swapped, r"turns back \d times \(first after ping 9\d\)"),
    ],
)
def test_navigation_that_is_missing_or_out_of_order_is_reported(still, tmp_path, change, said):
    path = tmp_path / "scene.h5"
    path.write_bytes(still.read_bytes())
    with h5py.File(path, "r+") as file:
        file["na/position"][...] = change(file["na/position"][...])
    with pytest.warns(ClsasWarning, match=rf"scene\.h5: .*{said}"):
        lines = read_airsas(
            path, channels=[1], shared=still.parent.parent / "characterization data"
        )
    assert lines.channels == len(RAIL_M)


def test_other_hdf5_files_are_refused_by_name(tmp_path):
    lines = clsas.RangeLines(np.ones((2, 3), complex), 1.0, 0.1, [0] * 3, [0] * 3, 1e5, 1500.0)
    clsas.save(tmp_path / "lines.h5", lines)
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["na/position"] = [1.0]
    for name, got in (("lines.h5", "first_range_m"), ("other.h5", "na")):
        said = rf"{name} is an HDF5 file, but not an AirSAS scene: .* got \['{got}'"
        with pytest.raises(FileFormatError, match=said):
            read_airsas(tmp_path / name)


@pytest.mark.parametrize(
    ("file", "old", "new", "said"),
    [
        ("acquistionParams.csv", "100000.0", "fast", "number in column 2"),
        ("acquistionParams.csv", "100000.0", "-1", "sample rate must be"),
        ("acquistionParams.csv", "0.001", "0", "duration_s must be"),
        ("acquistionParams.csv", "Taper,0.1,unit", "", "must have 13 parameters, got 12"),
        ("acquistionParams.csv", "10000.0", "30000.0", "bandwidth_hz must be"),
        ("sensorCoordinates.csv", "1.12", "nan", "number in column 4"),
        ("sensorCoordinates.csv", "Sensor", "\udcff", "is not a table"),
    ],
)
def test_tables_that_disagree_are_refused(still, tmp_path, file, old, new, said):
    shared = still.parent.parent / "characterization data"
    for source in shared.iterdir():
        text = source.read_text()
        if source.name == file:
            assert old in text
            text = text.replace(old, new)
        (tmp_path / source.name).write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(FileFormatError, match=rf"{file}.*{said}"):
        read_airsas(still, shared=tmp_path)


def test_microphones_must_fit_into_memory_together_before_any_is_read(still, tmp_path, monkeypatch):
    """Every byte of the file takes 4 bytes in memory, and 3.2 more as lines."""
    shutil.copytree(still.parent.parent, tmp_path / "copy")
    path = tmp_path / "copy" / "scenes" / still.name
    with h5py.File(path, "r+") as file:
        for name in ("ch1/ts", "ch2/ts"):
            del file[name]
            silent = np.zeros((len(RAIL_M), 5000), np.int8)
            file.create_dataset(name, data=silent, compression="gzip")

    def compressed(*_, **__):
        raise ValueError("as far as this")  # stop before compression, which has another budget

    monkeypatch.setattr(airsas, "compress", compressed)
    monkeypatch.setattr(validate, "_memory_bytes", lambda: 16 << 20)
    with pytest.raises(ValueError, match="as far as this"):
        read_airsas(path)
    monkeypatch.setattr(validate, "_memory_bytes", lambda: 13 << 20)
    words = (
        r"is too large: reading /ch1/ts to /ch2/ts must ask for at most 0\.0127 GiB, .* got 0\.01"
    )
    with pytest.raises(FileFormatError, match=words):
        read_airsas(path)
    with pytest.raises(ValueError, match="as far as this"):
        read_airsas(path, channels=[2])
