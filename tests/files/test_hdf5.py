import dataclasses
import hashlib
import os
import subprocess
import sys
from dataclasses import replace

import h5py
import numpy as np
import pytest

from clsas.engine.data import validate
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.certificate import Certificate
from clsas.engine.data.georeference import Georeference
from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Formed, Image
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.system import Pulse
from clsas.engine.signal.echoes import Echoes
from clsas.files import hdf5 as io
from clsas.files.hdf5 import FileFormatError, load, read_geometry, read_samples, save
from clsas.interferometry.interferogram import Interferogram
from clsas.interferometry.result import Heights

UTM = Georeference(crs="EPSG:32632", vertical_datum="NN2000")
LOCAL = Georeference.local(60.39, 5.32, 1 / 3, heading_deg=217)
PLANE = Grid.plane(x=(1e6, 1e6 + 0.7, 5), y=(40, 41 / 3, 3), z=-1 / 3)


def complex_noise(random, *shape):
    return (random.normal(size=shape) + 1j * random.normal(size=shape)).astype(np.complex64)


def objects():
    """One object of every kind, of noise."""
    random = np.random.default_rng(3)

    def noise(*shape):
        return random.normal(size=shape)

    tx_m, rx_m = 1e7 + noise(4, 3), 1e7 + noise(4, 3)
    # -0, the smallest and the largest number must be kept bit for bit.
    samples = complex_noise(random, 4, 6)
    samples[0, :3] = [complex(-0.0, 0.0), np.finfo(np.float32).smallest_subnormal, 3.4e38]
    return {
        "plane": PLANE,
        "oriented": Grid.oriented(noise(3), noise(3), noise(3), (2, 3)),
        "height map": PLANE.with_height(noise(3, 5)),
        "points": Grid.points(noise(2, 3, 4, 3)),
        "local": Grid.points(noise(2, 3), georeference=LOCAL),
        "projected": Image(complex_noise(random, 3, 5), replace(PLANE, georeference=UTM)),
        "placed lines": RangeLines(samples, 1, 0.1, tx_m, rx_m, 0, 1500, georeference=LOCAL),
        "image": Image(complex_noise(random, 3, 5), PLANE),
        "formed image": Image(
            complex_noise(random, 3, 5),
            PLANE,
            Formed("factorized", -40 / 3, "taps", -20 / 3, None, ("relief", "µ"), "GPU", "1", "a"),
        ),
        "image of a beam": Image(
            complex_noise(random, 3, 5),
            PLANE,
            Formed("exact", None, "", None, BeamWindow(5, along=[[0, 1, 0]]), (), "", "1", "b"),
        ),
        "image of points": Image(complex_noise(random, 7), Grid.points(noise(7, 3))),
        "interferogram": Interferogram(*np.abs(noise(4, 3, 5)), PLANE, 0.1),
        "heights": Heights(
            noise(3, 5),
            np.abs(noise(3, 5)),
            1 / (1 + noise(3, 5) ** 2),
            noise(3, 5) > 0,
            *np.abs(noise(2, 3, 5)),
            Image(complex_noise(random, 3, 5), PLANE.with_height(noise(3, 5))),
            0.1,
            Certificate(64, 15, 0.1, 2 / 3, 1e-5 / 3, 1e-12, 1e-18, [[2, 4]], [-40 / 3]),
        ),
        "lines": RangeLines(samples, noise(4), 1 / 3, tx_m, rx_m, 1e6 / 3, 1500.1),
        "moving lines": RangeLines(samples, 40, 0.1, tx_m, rx_m, 0, 1500, noise(4, 3)),
        "looking lines": RangeLines(
            samples, 40, 0.1, tx_m, rx_m, 0, 1500, look_direction=noise(4, 3)
        ),
        "looking echoes": Echoes(
            samples, 0.1, 1e5, 1e6, tx_m, rx_m, 1500, look_direction=[0.1, 1, 0.2]
        ),
        "echoes": Echoes(
            samples, 0.1, 1e5 / 3, 1e6, tx_m, rx_m, 1500, Pulse(1e6, 1e5 / 3, 1e-3, "down")
        ),
        "phase code": Echoes(
            samples, noise(4), 1e5, 1e6, tx_m, rx_m, 1500, Pulse.phase_code(1e6, 1e-3), noise(4, 3)
        ),
        "passband without a pulse": Echoes(
            noise(4, 6).astype(np.float32), 0, 1e6, 2e5, tx_m, rx_m, 1500
        ),
    }


OBJECTS = objects()
EVERY_OBJECT = pytest.mark.parametrize("obj", OBJECTS.values(), ids=OBJECTS.keys())


def digest(obj):
    """Return a digest of every bit, type and name in an object."""
    if dataclasses.is_dataclass(obj):
        text = repr([(f.name, digest(getattr(obj, f.name))) for f in dataclasses.fields(obj)])
        text = type(obj).__name__ + text
    elif isinstance(obj, np.ndarray):
        text = f"{obj.dtype.str} {obj.shape} {hashlib.sha256(obj.tobytes()).hexdigest()}"
    else:
        text = f"{type(obj).__name__} {obj!r}"
    return hashlib.sha256(text.encode()).hexdigest()


def run_beside(code, *arguments):
    """Return what Python code that may import this module prints in another process."""
    folders = [os.path.dirname(__file__), *sys.path]
    return subprocess.run(
        [sys.executable, "-c", code, *arguments],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, folders))},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    ).stdout


@EVERY_OBJECT
def test_round_trip_keeps_every_bit(obj, tmp_path):
    save(tmp_path / "file.h5", obj)
    assert digest(load(tmp_path / "file.h5")) == digest(obj)
    assert os.listdir(tmp_path) == ["file.h5"]


@pytest.mark.slow
def test_another_process_reads_every_bit(tmp_path):
    paths = [str(tmp_path / f"{name}.h5") for name in OBJECTS]
    for path, obj in zip(paths, OBJECTS.values(), strict=True):
        save(path, obj)
    code = "import sys, test_hdf5 as t\nfor p in sys.argv[1:]: print(t.digest(t.load(p)))"
    assert run_beside(code, *paths).split() == [digest(obj) for obj in OBJECTS.values()]


def test_schema_is_the_documented_one(tmp_path):
    save(tmp_path / "image.h5", OBJECTS["image"])
    with h5py.File(tmp_path / "image.h5") as file:
        assert dict(file.attrs) == {"format": b"clsas", "version": 1, "kind": b"image"}
        assert set(file) == {"pixels", "grid"}
        assert set(file["grid"]) == {"origin_m", "row_step_m", "column_step_m"}
        assert file["grid"].attrs["kind"] == b"grid"
        assert list(file["grid"].attrs["shape"]) == [3, 5]
        np.testing.assert_array_equal(file["pixels"], OBJECTS["image"].pixels)


def test_a_file_by_another_program_loads(tmp_path):
    with h5py.File(tmp_path / "lines.h5", "w") as file:
        file.attrs.update(format="clsas", version=1, kind="range_lines", range_step_m=0.1)
        file.attrs.update(carrier_hz=100_000, sound_speed_m_s=1500)
        file["samples"] = np.ones((2, 3), np.complex128)
        file["first_range_m"] = [1, 2]
        file["tx_m"] = file["rx_m"] = np.zeros((2, 3), ">f4")
    lines = load(tmp_path / "lines.h5")
    assert lines.samples.dtype == np.complex64
    assert lines.tx_m.dtype == np.float64
    assert lines.rx_velocity_m_s is None


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
@pytest.mark.parametrize("exists", [False, True])
def test_an_interrupted_save_leaves_nothing(error, exists, tmp_path, monkeypatch):
    path = tmp_path / "file.h5"
    if exists:
        path.write_bytes(b"what was there")
    begun = []

    def interrupted(_):
        begun.extend(os.listdir(tmp_path))
        raise error

    monkeypatch.setattr(io.os, "fsync", interrupted)
    with pytest.raises(error):
        save(path, OBJECTS["lines"])
    assert (
        len(set(begun) - {"file.h5"}) == 1
    )  # the file that was being written under a temporary name
    assert os.listdir(tmp_path) == (["file.h5"] if exists else [])
    assert not exists or path.read_bytes() == b"what was there"


FULL_DISK = """
import dataclasses, errno, resource, sys, test_hdf5 as t
resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, 10_000))
for path in sys.argv[1:]:
    try:
        samples = t.complex_noise(t.np.random.default_rng(0), 4, 5000)
        t.save(path, dataclasses.replace(t.OBJECTS["lines"], samples=samples))
    except OSError as error:
        print(errno.errorcode[error.errno])
"""


@pytest.mark.slow
def test_a_full_disk_is_an_error_and_leaves_nothing(tmp_path):
    (tmp_path / "old.h5").write_bytes(b"what was there")
    done = run_beside(FULL_DISK, str(tmp_path / "new.h5"), str(tmp_path / "old.h5"))
    assert done.split() == ["EFBIG", "EFBIG"]  # and the interpreter exited normally
    assert os.listdir(tmp_path) == ["old.h5"]
    assert (tmp_path / "old.h5").read_bytes() == b"what was there"


def test_save_replaces(tmp_path):
    for name in ("lines", "plane"):
        save(tmp_path / "file.h5", OBJECTS[name])
    assert digest(load(tmp_path / "file.h5")) == digest(PLANE)


def test_save_names_bad_input(tmp_path):
    with pytest.raises(TypeError, match=r"obj must be of type Grid or RangeLines or .*, got dict"):
        save(tmp_path / "file.h5", {})
    with pytest.raises(FileNotFoundError, match="there is no folder"):
        save(tmp_path / "none" / "file.h5", PLANE)
    with pytest.raises(IsADirectoryError, match="it is a folder"):
        save(tmp_path, PLANE)
    with pytest.raises(ValueError, match="path must be a path, got an empty one"):
        save("", PLANE)
    with pytest.raises(TypeError, match="path must be a path, got None"):
        load(None)
    assert os.listdir(tmp_path) == []


def test_load_leaves_missing_files_to_python(tmp_path):
    with pytest.raises(FileNotFoundError):
        load(tmp_path / "none.h5")
    with pytest.raises(IsADirectoryError):
        load(tmp_path)


@pytest.mark.parametrize("content", [b"", b"not HDF5 at all", b"\x89PNG\r\n\x1a\n" + bytes(1000)])
def test_load_refuses_what_is_not_hdf5(content, tmp_path):
    path = tmp_path / "file.h5"
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match=r"file\.h5 is not an HDF5 file"):
        load(path)


def change(file, name):
    """Damage an open file of range lines in one of several ways."""
    match name:
        case "foreign":
            del file.attrs["format"]
        case "of another format":
            file.attrs["format"] = "NetCDF"
        case "newer":
            file.attrs["version"] = 2
        case "of version 0":
            file.attrs["version"] = 0
        case "of a version in words":
            file.attrs["version"] = "zzz"
        case "without version":
            del file.attrs["version"]
        case "of unknown kind":
            file.attrs["kind"] = "hologram"
        case "without kind":
            del file.attrs["kind"]
        case "without samples":
            del file["samples"]
        case "without step":
            del file.attrs["range_step_m"]
        case "of one channel too many":
            del file["tx_m"]
            file["tx_m"] = np.zeros((5, 3))
        case "with NaN":
            file["first_range_m"][1] = np.nan
        case "with text":
            file.attrs["carrier_hz"] = "much"


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("foreign", "is an HDF5 file, but was not written by clsas"),
        ("of another format", "is an HDF5 file, but was not written by clsas"),
        ("newer", "is of format version 2, but this clsas reads version 1"),
        ("of version 0", "is of format version 0, but this clsas reads version 1"),
        ("of a version in words", "is damaged: its attribute version must be a number, got 'zzz'"),
        ("without version", "is damaged: .*version"),
        ("of unknown kind", "contains an object of unknown kind 'hologram'"),
        ("without kind", "contains an object of unknown kind None"),
        ("without samples", "lacks samples of the range_lines"),
        ("without step", "lacks range_step_m of the range_lines"),
        ("of one channel too many", r"is damaged: tx_m must have shape \(4, 3\)"),
        ("with NaN", "is damaged: first_range_m must be finite, got 1 NaN"),
        ("with text", "is damaged: carrier_hz must be one real number in Hz"),
    ],
)
def test_load_names_what_is_wrong(name, words, tmp_path):
    path = tmp_path / "file.h5"
    save(path, OBJECTS["lines"])
    with h5py.File(path, "r+") as file:
        change(file, name)
    with pytest.raises(FileFormatError, match=rf"file\.h5 {words}"):
        load(path)


@pytest.mark.parametrize("chunks", [None, (2, 4)])
@pytest.mark.parametrize("shape", [(4, 6), (10**6, 10**6)])
def test_samples_never_written_are_refused(shape, chunks, tmp_path):
    path = tmp_path / "file.h5"
    save(path, OBJECTS["lines"])
    with h5py.File(path, "r+") as file:
        del file["samples"]
        samples = file.create_dataset("samples", shape, np.complex64, chunks=chunks)
        if chunks is not None:
            samples[:2, :6] = samples[2:4, :4] = 1  # all but one of the chunks of the small one
    with pytest.raises(FileFormatError, match=r"file\.h5 lacks a part of /samples, of shape"):
        load(path)


def elsewhere(file, name, folder):
    """Replace a dataset by one whose values are in another file or place."""
    del file[name]
    match folder.name:
        case "external link":
            file[name] = h5py.ExternalLink(folder / "other.h5", name)
        case "soft link":
            file[name] = h5py.SoftLink("/first_range_m")
        case "external storage":
            file.create_dataset(name, (4, 3), "f8", external=[(folder / "other.h5", 0, 96)])
        case "virtual dataset":
            layout = h5py.VirtualLayout((4, 3), "f8")
            layout[...] = h5py.VirtualSource(folder / "other.h5", name, (4, 3))
            file.create_virtual_dataset(name, layout)


@pytest.mark.parametrize("name", ["samples", "tx_m"])
@pytest.mark.parametrize(
    "way", ["external link", "soft link", "external storage", "virtual dataset"]
)
def test_only_the_file_itself_is_read(way, name, tmp_path):
    folder = tmp_path / way
    folder.mkdir()
    path = folder / "file.h5"
    for each in (path, folder / "other.h5"):
        save(each, OBJECTS["lines"])
    with h5py.File(path, "r+") as file:
        elsewhere(file, name, folder)
    with pytest.raises(FileFormatError, match=rf"file\.h5 must contain {name} itself, got a "):
        load(path)
    with pytest.raises(FileFormatError, match=rf"file\.h5 must contain {name} itself, got a "):
        read_geometry(path)
    if name == "samples":
        with pytest.raises(FileFormatError, match=r"file\.h5 must contain samples itself"):
            read_samples(path, slice(1), slice(1))


def test_an_object_is_no_part_of_itself(tmp_path):
    path = tmp_path / "file.h5"
    save(path, OBJECTS["echoes"])
    with h5py.File(path, "r+") as file:
        del file["pulse"]
        file["pulse"] = file["/"]
    with pytest.raises(FileFormatError, match="contains another object as pulse of the echoes"):
        load(path)


def test_what_does_not_fit_into_memory_is_refused_before_it_is_read(tmp_path, monkeypatch):
    path = tmp_path / "file.h5"
    save(path, OBJECTS["lines"])
    with h5py.File(path, "r+") as file:
        del file["samples"]
        shape = 4, 1 << 20
        file.create_dataset("samples", data=np.zeros(shape, np.complex64), compression="gzip")
    assert path.stat().st_size < 1 << 20
    assert load(path).samples.shape == shape
    monkeypatch.setattr(validate, "_memory_bytes", lambda: 10 << 20)
    monkeypatch.setattr(h5py.Dataset, "__getitem__", None)
    words = r"file\.h5 is too large: reading /samples must ask for at most 0.00977 GiB"
    with pytest.raises(FileFormatError, match=words):
        load(path)
    with pytest.raises(FileFormatError, match=words):
        read_samples(path, slice(0, 4), slice(0, 1 << 20))


def test_datasets_must_fit_into_memory_together(tmp_path, monkeypatch):
    path = tmp_path / "file.h5"
    channels = 1 << 18
    at_m = np.zeros((channels, 3))
    save(path, RangeLines(np.ones((channels, 1), np.complex64), 0.0, 0.1, at_m, at_m, 1e5, 1500.0))
    monkeypatch.setattr(validate, "_memory_bytes", lambda: 15 << 20)
    with pytest.raises(FileFormatError, match=r"reading /rx_m must ask for at most .* GiB, what"):
        load(path)
    monkeypatch.setattr(validate, "_memory_bytes", lambda: 18 << 20)
    assert load(path).channels == channels


@pytest.mark.parametrize("values", [np.array([b"x"] * 4), np.ones(4, "?")], ids=["text", "bool"])
def test_other_than_numbers_are_refused(values, tmp_path):
    path = tmp_path / "file.h5"
    save(path, OBJECTS["lines"])
    with h5py.File(path, "r+") as file:
        del file["first_range_m"]
        file["first_range_m"] = values
    with pytest.raises(FileFormatError, match="must contain first_range_m as numbers, got"):
        load(path)


def test_a_pipe_or_device_is_refused_unopened(tmp_path):
    os.mkfifo(tmp_path / "pipe.h5")
    for path, kind in ((tmp_path / "pipe.h5", "a pipe"), ("/dev/zero", "a device")):
        with pytest.raises(FileFormatError, match=f"must be an ordinary file, got {kind}"):
            load(path)


def test_a_pulse_alone_is_no_file(tmp_path):
    path = tmp_path / "file.h5"
    save(path, OBJECTS["echoes"])
    with h5py.File(path, "r+") as file:
        for name, value in file["pulse"].attrs.items():
            file.attrs[name] = value
    with pytest.raises(FileFormatError, match="contains only a Pulse"):
        load(path)


def test_truncated_files_are_refused(tmp_path):
    save(tmp_path / "whole.h5", OBJECTS["lines"])
    whole = (tmp_path / "whole.h5").read_bytes()
    path = tmp_path / "file.h5"
    for size in range(0, len(whole), 97):
        path.write_bytes(whole[:size])
        with pytest.raises(FileFormatError, match=r"file\.h5 is (damaged|not an HDF5 file)"):
            load(path)


@pytest.mark.slow
def test_damaged_bytes_never_become_data(tmp_path):
    save(tmp_path / "whole.h5", OBJECTS["lines"])
    whole = (tmp_path / "whole.h5").read_bytes()
    path = tmp_path / "file.h5"
    random = np.random.default_rng(0)
    found = 0
    for position in random.integers(0, len(whole), 400):
        damaged = bytearray(whole)
        damaged[position] ^= 1 << random.integers(8)
        path.write_bytes(damaged)
        try:
            assert digest(load(path)) == digest(OBJECTS["lines"])  # the changed bytes are unused
        except FileFormatError:
            found += 1
    assert found > 200


def test_saving_keeps_links_modes_and_what_is_no_file(tmp_path):
    grid = Grid.plane((0, 1, 2), (0, 1, 2))
    private, link, pipe = (tmp_path / f"{name}.h5" for name in ("private", "link", "pipe"))
    private.touch(mode=0o600)
    link.symlink_to(private)
    os.mkfifo(pipe)
    save(link, grid)
    assert link.is_symlink()
    assert private.stat().st_mode & 0o777 == 0o600
    assert load(private).shape == grid.shape
    with pytest.raises(ValueError, match=r"pipe\.h5 must be an ordinary file, got a pipe"):
        save(pipe, grid)
    assert pipe.is_fifo()
