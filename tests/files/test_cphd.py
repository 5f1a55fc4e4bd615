"""CPHD files in both domains, monostatic and bistatic, written and read."""

import errno
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from damaging import refused
from scipy.constants import speed_of_light

import clsas
from clsas import cli
from clsas.engine.data import validate
from clsas.engine.data.georeference import Georeference
from clsas.engine.data.validate import ClsasWarning
from clsas.files import cphd
from clsas.files.cphd import read_cphd, write_cphd
from clsas.files.hdf5 import FileFormatError

pytest.importorskip("sarkit", reason="sarkit (extra radar) is not installed")

import sarkit.cphd
import sarkit.verification

POINTS_M = np.array([[0.0, 20.0, 0.0], [0.5, 21.0, 0.0], [-0.7, 19.2, 0.0]])
GRID = clsas.Grid.plane(x=(-1, 1, 81), y=(18.5, 21.5, 121))


def sonar_lines(receivers=1, pings=60):
    sonar = clsas.Sonar(
        clsas.Pulse(100e3, 20e3, 1e-3), [[0.03 * n, 0, 0] for n in range(receivers)]
    )
    number = np.arange(pings)
    position_m = np.stack([0.06 * number - 1.8, 0.02 * np.sin(number), 0.01 * np.cos(number)], 1)
    track = clsas.Track(position_m, 0.1 * number)
    return clsas.compress(clsas.simulate(sonar, track, clsas.PointTargets(POINTS_M)))


def at(lines, origin_m):
    return replace(lines, tx_m=lines.tx_m + origin_m, rx_m=lines.rx_m + origin_m)


def on_carrier(lines):
    """Return the lines with their carrier, sampled densely enough for it."""
    dense = clsas.simulate_lines(
        lines.tx_m, lines.rx_m, clsas.PointTargets(POINTS_M), carrier_hz=20e3,
        bandwidth_hz=15e3, oversampling=4.0,
    )  # fmt: skip
    range_m = dense.first_range_m[:, None] + np.arange(dense.length) * dense.range_step_m
    samples = dense.samples * np.exp(2j * dense.wavenumber_rad_m * range_m)
    return replace(dense, samples=samples, carrier_hz=0.0)


UTM_M = np.array([597_300.0, 6_643_100.0, -20.0])
CASES = {
    "monostatic": (sonar_lines, GRID),
    "array": (lambda: sonar_lines(3), GRID),
    "UTM": (
        lambda: at(sonar_lines(3), UTM_M),
        clsas.Grid.oriented(UTM_M + [-1, 18.5, 0], [0, 0.025, 0], [0.025, 0, 0], (121, 81)),
    ),
    "on its carrier": (lambda: on_carrier(sonar_lines()), GRID),
}


def findings(path):
    """Return what the consistency checker for the standard finds in a file."""
    with path.open("rb") as file:
        checker = sarkit.verification.CphdConsistency.from_file(file, thorough=True)
        checker.check()
    assert len(checker.passes()) > 50
    return checker.failures()


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_what_was_written_passes_the_checker_and_gives_the_same_image(name, tmp_path):
    make, grid = CASES[name]
    lines = make()
    path = tmp_path / "lines.cphd"
    clsas.save(path, lines)
    assert findings(path) == {}
    again = clsas.load(path)
    np.testing.assert_allclose(again.tx_m, lines.tx_m, atol=1e-8)
    np.testing.assert_allclose(again.rx_m, lines.rx_m, atol=1e-8)
    assert again.sound_speed_m_s == lines.sound_speed_m_s
    images = [clsas.backproject(each, grid, accuracy_db=-80) for each in (again, lines)]
    assert clsas.relative_error_db(*images) < -80


LOOKS = {
    "port": [0, 1, -0.2],
    "starboard": [0.1, -1, -0.2],
    "both": np.tile([[0, 1.0, 0], [0, -1.0, 0]], (30, 1)),
    "unknown": None,
}


def test_the_georeference_is_kept(tmp_path):
    place = Georeference.local(60.39, 5.32, -12.5, heading_deg=217, vertical_datum="NN2000")
    path = tmp_path / "lines.cphd"
    write_cphd(path, replace(sonar_lines(), georeference=place))
    assert findings(path) == {}
    assert read_cphd(path).georeference == place


@pytest.mark.parametrize("name", LOOKS)
def test_the_look_direction_is_kept_and_states_the_side_of_the_track(name, tmp_path):
    lines = replace(sonar_lines(), look_direction=LOOKS[name])
    path = tmp_path / "lines.cphd"
    write_cphd(path, lines)
    assert findings(path) == {}
    again = read_cphd(path)
    if name == "unknown":  # the file has to state a side, which is none
        assert again.look_direction is None
    else:
        np.testing.assert_allclose(again.look_direction, lines.look_direction, atol=1e-15)
    side = b"R" if name == "starboard" else b"L"
    assert b"<SideOfTrack>" + side + b"</" in path.read_bytes()
    unknown = (replace(each, look_direction=None) for each in (again, lines))  # GRID is to port
    images = [clsas.backproject(each, GRID, accuracy_db=-80) for each in unknown]
    assert clsas.relative_error_db(*images) < -80


@pytest.mark.parametrize("bistatic", [True, False])
@pytest.mark.parametrize(("side", "look"), [(b"L", 1.0), (b"R", -1.0)])
def test_antennas_of_a_foreign_file_look_to_its_side_of_the_track(tmp_path, bistatic, side, look):
    path = tmp_path / "pass.cphd"
    foreign(path, bistatic=bistatic)
    content = path.read_bytes()
    path.write_bytes(content.replace(b"<SideOfTrack>L<", b"<SideOfTrack>" + side + b"<"))
    np.testing.assert_allclose(
        read_cphd(path).look_direction, np.tile([0, look, 0], (47, 1)), atol=1e-12
    )


def at_rest(vectors):
    vectors["TxVel"] = 0


def opposite(vectors):
    vectors["RcvVel"] *= -1


def without_velocity(vectors):
    vectors["TxVel"][7] = np.nan


@pytest.mark.parametrize("change", [at_rest, opposite, without_velocity])
def test_without_one_direction_of_motion_the_side_is_unknown(tmp_path, change):
    path = tmp_path / "pass.cphd"
    foreign(path)
    change_vectors(path, change)
    assert read_cphd(path).look_direction is None


def test_a_radar_sees_the_wavelengths_of_the_sonar(tmp_path):
    """Another processor assumes the speed of light: the file must focus without our parameter."""
    lines = sonar_lines()
    write_cphd(tmp_path / "lines.cphd", lines)
    content = (tmp_path / "lines.cphd").read_bytes()
    (tmp_path / "radar.cphd").write_bytes(
        content.replace(cphd.SPEED.encode(), b"other.speed_of_waves_")
    )
    radar = read_cphd(tmp_path / "radar.cphd")
    assert radar.sound_speed_m_s == speed_of_light
    assert radar.wavenumber_rad_m == pytest.approx(lines.wavenumber_rad_m, rel=1e-12)
    images = [clsas.backproject(each, GRID, accuracy_db=-80) for each in (radar, lines)]
    assert clsas.relative_error_db(*images) < -80


def foreign(
    path, *, sign=-1, bistatic=True, kind="CF8", domain="FX", hae=False, pulses=48, margin=0.0
):
    """Write a file in the FX or TOA domain with the analytic signal of a point.

    Bands, frequency steps and scale factors differ from vector to vector; one vector is not normal.
    Samples beyond the band, by a share of it on either side, are strong noise.
    """
    count = 200
    angle = np.linspace(-0.02, 0.02, pulses)
    tx_m = 4000 * np.stack([np.sin(angle), -np.cos(angle), 0.6 + 0 * angle], axis=1)
    rx_m = tx_m + [900.0, 200.0, -300.0] if bistatic else tx_m
    lines = clsas.RangeLines(
        np.ones((pulses, count), complex), 4600.0, 0.25, tx_m, rx_m, 10e9, speed_of_light
    )
    vectors, _ = cphd._vectors(lines, np.zeros(3))
    point_m = (vectors["SRPPos"][0] - cphd._EQUATOR_M) @ cphd._AXES.T
    target_m = point_m + [4.0, -6.0, 1.0]

    def delay_s(position_m):
        legs = (np.linalg.norm(each - position_m, axis=1) for each in (tx_m, rx_m))
        return sum(legs) / speed_of_light

    excess_s = (delay_s(target_m) - delay_s(point_m))[:, None]
    vary = 1 + 0.003 * angle / angle.max()
    vectors["FX1"], vectors["FX2"] = 9.8e9 * vary, 10.2e9 * vary
    number = np.arange(count)
    if domain == "FX":
        band = vectors["FX2"] - vectors["FX1"]
        vectors["SC0"] = vectors["FX1"] - margin * band
        vectors["SCSS"] = (1 + 2 * margin) * band / count
        frequency = vectors["SC0"][:, None] + number * vectors["SCSS"][:, None]
        signal = np.exp(sign * 2j * np.pi * frequency * excess_s)
        outside = (frequency < vectors["FX1"][:, None]) | (frequency > vectors["FX2"][:, None])
        signal[outside] = 30 * np.exp(1j * np.random.default_rng(1).uniform(0, 9, outside.sum()))
        vectors["TOA1"], vectors["TOA2"] = -0.4 / vectors["SCSS"], 0.4 / vectors["SCSS"]
    else:
        vectors["SCSS"] = 0.5e-9
        vectors["SC0"] = -60e-9 - 1e-9 * vary
        time = vectors["SC0"][:, None] + number * vectors["SCSS"][:, None]
        band, middle = (vectors["FX2"] - vectors["FX1"]), (vectors["FX2"] + vectors["FX1"]) / 2
        signal = np.sinc(band[:, None] * (time - excess_s))
        signal = signal * np.exp(sign * 2j * np.pi * middle[:, None] * excess_s)
        vectors["TOA1"], vectors["TOA2"] = time[:, 0], time[:, -1]
    vectors["SIGNAL"][5] = 0
    signal[5] = 0
    tree = cphd._document(sarkit.cphd, lines, vectors, np.zeros(3), domain)
    root = sarkit.cphd.ElementWrapper(tree.getroot())
    root["Global"]["SGN"] = sign
    root["Channel"]["Parameters"][0]["SignalNormal"] = False
    root["CollectionID"]["Parameter"] = []
    root["Data"]["SignalArrayFormat"] = kind
    if hae:
        root["SceneCoordinates"]["ReferenceSurface"] = {
            "HAE": {"uIAXLL": [0.0, 1.57e-7], "uIAYLL": [1.57e-7, 0.0]}
        }
    stored = signal.astype(np.complex64)
    if kind != "CF8":
        dtype = sarkit.cphd.binary_format_string_to_dtype(kind)
        stored = np.empty(signal.shape, dtype)
        scale = 0.9 * np.iinfo(dtype["real"]).max
        stored["real"], stored["imag"] = np.rint(scale * signal.real), np.rint(scale * signal.imag)
    with path.open("wb") as file:
        cphd.write_vectors(sarkit.cphd, file, tree, vectors, stored)
    return target_m


FOREIGN = {
    "FX": {},
    "FX with more than the band": {"margin": 0.3},
    "FX of the other sign": {"sign": 1},
    "FX monostatic": {"bistatic": False},
    "FX of 16-bit numbers": {"kind": "CI4"},
    "FX of 8-bit numbers": {"kind": "CI2"},
    "FX over the ellipsoid": {"hae": True},
    "TOA": {"domain": "TOA"},
    "TOA of the other sign": {"domain": "TOA", "sign": 1},
}


@pytest.mark.parametrize("name", FOREIGN)
def test_a_point_of_a_foreign_file_focuses_in_phase(name, tmp_path):
    path = tmp_path / "pass.cphd"
    x, y, z = foreign(path, **FOREIGN[name])
    assert findings(path) == {} or name == "FX over the ellipsoid"
    lines = read_cphd(path)
    assert lines.channels == 47  # one vector is not flagged as normal
    grid = clsas.Grid.plane((x - 2, x + 2, 81), (y - 2, y + 2, 81), z)
    image = clsas.backproject(lines, grid, accuracy_db=-60)
    row, column = np.unravel_index(np.abs(image.pixels).argmax(), grid.shape)
    assert (row, column) == (40, 40)
    scale = {"CI4": 0.9 * 32767, "CI2": 0.9 * 127}.get(FOREIGN[name].get("kind"), 1.0)
    assert image.pixels[40, 40] / scale == pytest.approx(47, rel=0.01)


def test_channels_are_chosen_by_name(tmp_path):
    foreign(tmp_path / "pass.cphd")
    assert read_cphd(tmp_path / "pass.cphd", channel="1").channels == 47
    with pytest.raises(ValueError, match="channel must be one of '1', got 'HH'"):
        read_cphd(tmp_path / "pass.cphd", channel="HH")
    with pytest.raises(ValueError, match=r"window must be 'none' or"):
        read_cphd(tmp_path / "pass.cphd", window="nonsense")


def test_lines_that_cphd_cannot_hold_are_refused(tmp_path):
    lines = replace(sonar_lines(), rx_velocity_m_s=[1.0, 0, 0])
    with pytest.raises(ValueError, match="lines must have no `rx_velocity_m_s`"):
        clsas.save(tmp_path / "lines.cphd", lines)
    with pytest.raises(TypeError, match="obj must be of type RangeLines"):
        clsas.save(tmp_path / "grid.cphd", GRID)
    with pytest.raises(ValueError, match=r"path must end in \.cphd, got"):
        write_cphd(tmp_path / "lines.h5", sonar_lines())
    assert not list(tmp_path.iterdir())


def run(*args):
    """Return the exit code of a clsas command."""
    with pytest.raises(SystemExit) as end:
        cli.main([str(arg) for arg in args], prog_name="clsas")
    return end.value.code


def test_the_command_converts_both_ways_and_images(tmp_path, capsys):
    clsas.save(tmp_path / "lines.h5", sonar_lines())
    assert run("convert", tmp_path / "lines.h5", tmp_path / "lines.cphd") == 0
    assert run("convert", tmp_path / "lines.cphd", tmp_path / "again.h5") == 0
    axes = ("--x=-1:1:41", "--y=18.5:21.5:61", "--exact")
    for name in ("lines.h5", "lines.cphd", "again.h5"):
        assert run("image", tmp_path / name, *axes, "-o", tmp_path / f"{name}.image.h5") == 0
    images = [clsas.load(path) for path in sorted(tmp_path.glob("*.image.h5"))]
    assert clsas.relative_error_db(images[0], images[1]) < -80
    assert clsas.relative_error_db(images[1], images[2]) < -80
    assert run("convert", tmp_path / "lines.h5", tmp_path / "lines.tif") == 2
    assert run("convert", tmp_path / "lines.h5", tmp_path / "lines.h5") == 2


@pytest.mark.slow
def test_without_sarkit_the_message_says_how_to_install_it(tmp_path):
    (tmp_path / "pass.cphd").write_bytes(b"CPHD/1.1.0\n" + bytes(200))
    program = f"""
import sys
sys.modules["sarkit"] = None
import clsas
clsas.load({str(tmp_path / "pass.cphd")!r})
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert "sarkit is not installed, and is needed for CPHD files: pip install " in done.stderr
    assert "'sarkit>=" in done.stderr


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (b"<NumSamples>200<", b"<NumSamples>201<", "exceed its SIGNAL block"),
        (b"<NumVectors>48<", b"<NumVectors>49<", "exceed its"),
        (b"<NumVectors>48<", b"<NumVectors>-8<", "must contain vectors|is damaged"),
        (b"<SignalArrayFormat>CF8<", b"<SignalArrayFormat>CF4<", "unknown format 'CF4'"),
        (b"<DomainType>FX<", b"<DomainType>XX<", "its domain must be one of"),
        (b"<SGN>-1<", b"<SGN>-7<", "sign"),
        (b"PVP_BLOCK_SIZE := ", b"PVP_BLOCK_SIZE := 99999", "is damaged: its PVP block ends"),
        (b"XML_BLOCK_BYTE_OFFSET", b"XML_BLOCK_BYTE_OFFSER", "lacks XML_BLOCK_BYTE_OFFSET"),
        (b"<uIAX>", b"<uIAQ>", "is damaged"),
        (b"<X>0.0</X>", b"<X>2.0</X>", "orthogonal image area axes|is damaged"),
    ],
)
def test_files_that_claim_something_else_are_refused(tmp_path, old, new, said):
    path = tmp_path / "pass.cphd"
    foreign(path)
    content = path.read_bytes()
    assert old in content
    path.write_bytes(content.replace(old, new))
    with pytest.raises(FileFormatError, match=rf"pass\.cphd .*({said})"):
        clsas.load(path)


def lost(vectors):
    vectors["TxPos"][20:23, 1] = np.nan


def repeated(vectors):
    vectors["TxTime"][30] = vectors["TxTime"][29]


def everywhere(vectors):
    vectors["SRPPos"] = np.nan


def at_one_place(vectors):
    vectors["TxPos"], vectors["RcvPos"] = vectors["TxPos"][0], vectors["RcvPos"][0]


@pytest.mark.parametrize(
    ("change", "said", "channels"),
    [
        (lost, r"3 of 48 vectors lack finite positions .* vector 20\) and are left out", 44),
        (repeated, r"TxTime does not ascend after 1 of 47 vectors \(first after vector 29\)", 47),
        (at_one_place, "all 47 pings have the same position", 47),
        (everywhere, "must contain vectors with a signal and complete positions, got none", None),
    ],
)
@pytest.mark.parametrize("domain", ["FX", "TOA"])
def test_navigation_that_is_missing_or_repeated_is_reported(
    tmp_path, change, said, channels, domain
):
    path = tmp_path / "pass.cphd"
    foreign(path, domain=domain)
    change_vectors(path, change)
    if channels is None:
        with pytest.raises(FileFormatError, match=rf"pass\.cphd {said}"):
            read_cphd(path)
        return
    with pytest.warns(ClsasWarning, match=rf"pass\.cphd: {said}"):
        assert read_cphd(path).channels == channels


def change_vectors(path, change):
    """Change parameters of the vectors in a file."""
    with path.open("rb") as file:
        reader = sarkit.cphd.Reader(file)
        tree = reader.metadata.xmltree
        vectors, signal = reader.read_pvps("1"), reader.read_signal("1")
    vectors = np.array(vectors)
    change(vectors)
    with path.open("wb") as file:
        cphd.write_vectors(sarkit.cphd, file, tree, vectors, signal)


def test_a_signal_beyond_memory_is_refused_unread(tmp_path, monkeypatch):
    foreign(tmp_path / "pass.cphd")
    monkeypatch.setattr(validate, "_memory_bytes", lambda: 1000)
    monkeypatch.setattr(validate, "_SMALL_BYTES", 1000)
    with pytest.raises(FileFormatError, match="is too large: reading its signal"):
        clsas.load(tmp_path / "pass.cphd")


def test_damaged_files_end_in_one_error_or_in_lines(tmp_path):
    foreign(tmp_path / "pass.cphd", pulses=8)
    whole = (tmp_path / "pass.cphd").read_bytes()
    # Header, XML and vectors.
    assert refused(whole, tmp_path / "damaged.cphd", number=100, flips=5, within=9000) > 50


@pytest.mark.parametrize("written", ["write_pvp", "write_signal"])
def test_a_full_disk_is_the_only_message(tmp_path, monkeypatch, caplog, written):
    """The writer's own warning about arrays that are missing would hide the cause."""

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(sarkit.cphd.Writer, written, full)
    with pytest.raises(OSError, match=r"No space left on device: '.*a\.cphd'"):
        write_cphd(tmp_path / "a.cphd", sonar_lines())
    assert not caplog.records
    assert not list(tmp_path.iterdir())
