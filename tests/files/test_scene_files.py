import io
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
import scene_keys
from pydantic_core import PydanticUndefined

import clsas
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.declared import declared
from clsas.engine.data.system import BARKER_13
from clsas.files import scene_files as config
from clsas.files.csv_files import read_track
from clsas.files.scene_tables import PRESETS, SceneTables
from clsas.files.tables import models_in
from clsas.inspection.sampling import check_sampling
from clsas.simulation.scenes import PointTargets, Seabed
from clsas.simulation.seabeds import rocks

DOCS = Path(__file__).parents[2] / "docs" / "scene-files.md"
EXAMPLE, *_ = re.findall(r"```toml\n(.*?)```", DOCS.read_text(), re.DOTALL)

TRACK = """
[track]
start_m = [0, 0, 0]
velocity_m_s = [2, 0, 0]
pings = 400
ping_interval_s = 0.1
"""
GRID = """
[grid]
x = { start_m = 0, stop_m = 1, count = 3 }
y = { start_m = 5, stop_m = 8, count = 4 }
"""
SLANTED = """
[grid]
origin_m = [0, 20, -1]
row_step_m = [0, 0.1, 0.02]
column_step_m = [0.1, 0, 0]
shape = [2, 3]
"""
SONAR = """
[sonar]
rx_m = [[0, 0, 0], [0.1, 0, 0]]
[sonar.pulse]
carrier_hz = 1e5
duration_s = 1e-3
"""


def parse(text, folder=Path()):
    return config.parse_scene(text.encode(), name="scene.toml", folder=folder)


def saved(array):
    """Bytes of a NumPy file."""
    file = io.BytesIO()
    np.save(file, array, allow_pickle=True)
    return file.getvalue()


def refused(text, folder=Path()):
    with pytest.raises(ValueError, match=r"^scene\.toml: ") as error:
        parse(text, folder)
    return str(error.value)


def test_documented_example_is_read_as_written():
    scene = parse(EXAMPLE)
    sonar, track, targets, grid = scene.need("sonar", "track", "targets", "grid")
    assert sonar.pulse.carrier_hz == 300e3
    assert sonar.pulse.bandwidth_hz == 60e3
    assert sonar.receivers == 16
    np.testing.assert_allclose(np.diff(sonar.rx_m[:, 0]), 0.02)
    assert sonar.tx_length_m == sonar.rx_length_m == 0.02
    assert sonar.tx_height_m is None
    assert track.pings == 20
    np.testing.assert_allclose(track.positions_m[:, 0], -1.425 + 0.15 * np.arange(20))
    sway = 0.02 * np.sin(2 * np.pi * track.time_s / 4)
    np.testing.assert_allclose(track.positions_m[:, 1], sway, atol=1e-12)
    assert 0 < np.abs(track.yaw_rad).max() < np.radians(2.5)
    np.testing.assert_array_equal(targets.positions_m, [[0, 20, 0], [0.15, 20.1, 0]])
    np.testing.assert_array_equal(targets.amplitudes, [1, 0.5])
    assert grid.shape == (201, 201)
    assert scene.simulate.pop("pointing").depression_rad == pytest.approx(np.radians(14))
    assert scene.simulate == {"motion_in_flight": True, "snr_db": 20}
    assert scene.compress == {"window": "hamming"}
    assert scene.image == {"accuracy_db": -60}


def test_dial_and_beam():
    text = "[image]\nstages = [[2, 4], [2, 2]]\n[image.beam]\nwidth_deg = 20\nshape = 'hann'"
    image = parse(text).image
    assert image["stages"] == [(2, 4), (2, 2)]
    assert (image["beam"].width_deg, image["beam"].shape) == (20, "hann")
    assert image.keys() == {"stages", "beam"}
    assert parse("[image]\ntolerance_db = -30").image == {"tolerance_db": -30}


def documented_keys():
    """Return key and default of every row of every table in docs/scene-files.md, by TOML table."""
    tables = {}
    for section in DOCS.read_text().split("\n## ")[2:]:
        heading, _, body = section.partition("\n")
        rows = {}
        for cells in re.findall(r"^\| (`.*)\|$", body, re.MULTILINE):
            names, _, default, _ = re.split(r" *\| *", cells.strip(" "), maxsplit=3)
            rows |= dict.fromkeys(re.findall("`(.+?)`", names), default)
        for name in re.findall(r"`\[+(.+?)\]+`", heading):
            tables[name] = rows
    return tables


def tables(model, path=()):
    for name, info in model.model_fields.items():
        for table in models_in(info.annotation):
            yield ".".join((*path, name)), table
            yield from tables(table, (*path, name))


def test_every_key_is_documented_with_its_default():
    documented = documented_keys()
    models = dict(tables(SceneTables))
    assert documented.keys() == models.keys()
    for path, model in models.items():
        shared = path in {f"track.{motion}" for motion in ("surge", "sway", "heave")}
        other = {"amplitude_deg"} if shared else {"amplitude_m"} if path[:6] == "track." else set()
        assert documented[path].keys() - other == model.model_fields.keys(), path
        for name in model.model_fields.keys() - declared(model).keys():
            default, info = documented[path][name], model.model_fields[name]
            if info.default is PydanticUndefined:
                assert default == "required", (path, name)
            elif info.default is not None:
                assert tomllib.loads(f"a = {default.strip('`')}")["a"] == info.default, (path, name)


def test_documented_keys_are_those_declared():
    text = DOCS.read_text()
    assert scene_keys.filled(text) == text, "run scripts/pages tables"


def test_presets_and_built_in_scenes():
    for preset in PRESETS:
        assert parse(f"[sonar]\npreset = '{preset}'").sonar.receivers > 1
    scene = config.parse_scene(
        config.built_in_scene("thesis_wide_beam"), name="built in", folder=Path()
    )
    sonar, track, _, grid = scene.need("sonar", "track", "targets", "grid")
    # THESIS chapter 5: 10 pings of 64 receivers fill an aperture of 5.28 m evenly.
    centres = np.sort((track.positions_m[:, :1] + (sonar.rx_m[:, 0] + sonar.tx_m[0]) / 2).ravel())
    np.testing.assert_allclose(np.diff(centres), 5.28 / 640)
    assert grid.shape == (1024, 1024)
    assert grid.axes_m[1][[0, -1]] == pytest.approx([40, 45])
    # Its phase centres are too far apart for its elements; nothing else is wrong.
    assert [finding.name for finding in check_sampling(sonar, track, grid)] == [
        "along_track_spacing"
    ]
    with pytest.raises(ValueError, match=r"'thesis_wide_beam'.*got 'other'"):
        config.built_in_scene("other")


def test_the_wreck_comes_with_clsas():
    """THESIS chapter 6: 6 receivers, 200 pings over 80 m, 0.2 m of sway, a wreck at 60 m."""
    scene = config.parse_scene(config.built_in_scene("wreck"), name="built in", folder=Path())
    sonar, track, seabed, grid = scene.need("sonar", "track", "targets", "grid")
    assert (sonar.receivers, track.pings) == (6, 200)
    assert 200 * np.diff(track.positions_m[:, 0]) == pytest.approx(80)
    assert np.ptp(track.positions_m[:, 1]) == pytest.approx(0.4, abs=0.01)
    # The heading follows the course, so that beams are broadside to it, as windows assume.
    course = np.gradient(track.positions_m[:, 1], track.positions_m[:, 0])
    np.testing.assert_allclose(track.yaw_rad[1:-1], course[1:-1], atol=1e-4)
    assert isinstance(seabed, Seabed)
    assert seabed.heights_m.max() == 6.5
    assert grid.shape == (1024, 1024)
    assert grid.axes_m[0][[0, -1]] == pytest.approx(seabed.x_m)
    assert grid.axes_m[1][[0, -1]] == pytest.approx(seabed.y_m)
    assert scene.image["tolerance_db"] == -40
    # The window is wider than the two-way pattern at -6 dB, and narrower than its main lobe.
    window = BeamWindow.of_element(sonar.rx_length_m, sonar.wavelength_m)
    nulls_deg = 2 * np.degrees(np.arcsin(sonar.wavelength_m / sonar.rx_length_m))
    assert window.width_deg < scene.image["beam"].width_deg < nulls_deg
    assert not check_sampling(sonar, track, grid)


def test_seabeds():
    table = "[seabed]\nx_m = [-3, 3]\ny_m = [20, 30]\nposition_m = [0, 25]\ncell_m = 0.25\n"
    seabed = parse(f"{table}scene = 'rocks'\ncount = 3\nseed = 4\nfloor_db = -40").targets
    assert isinstance(seabed, Seabed)
    assert (seabed.x_m, seabed.y_m, seabed.steps_m) == ((-3, 3), (20, 30), (0.25, 0.25))
    assert (seabed.seed, seabed.floor_db, seabed.density_m2) == (4, -40, 600)
    again = rocks((-3, 3), (20, 30), position_m=(0, 25), cell_m=0.25, count=3, seed=4)
    np.testing.assert_array_equal(seabed.heights_m, again.heights_m)
    pipe = parse(f"{table}scene = 'pipeline'\nheading_deg = 90\ndensity_m2 = 50").targets
    assert (pipe.heights_m[:, 12] > 0.5).all()
    assert pipe.density_m2 == 50


def test_targets_beside_a_seabed():
    table = "[[targets]]\nposition_m = [0, 1, 2]\n[seabed]\nscene = 'pipeline'\ncell_m = 1"
    targets, seabed = parse(table).need("targets")[0]
    assert isinstance(targets, PointTargets)
    assert isinstance(seabed, Seabed)


def test_phase_codes():
    code = parse(f"{SONAR}code = {list(BARKER_13)}").sonar.pulse
    assert code.code == BARKER_13
    assert code.bandwidth_hz == pytest.approx(13e3)


def test_random_motion_keeps_its_power_and_its_slowest_speed():
    text = f"{TRACK}[track.heave]\namplitude_m = 0.3\nperiod_s = 2.0\nrandom_seed = "
    heave = parse(f"{text}4").track.positions_m[:, 2]
    np.testing.assert_array_equal(heave, parse(f"{text}4").track.positions_m[:, 2])
    assert not np.allclose(heave, parse(f"{text}5").track.positions_m[:, 2])
    power = [np.mean(parse(f"{text}{seed}").track.positions_m[:, 2] ** 2) for seed in range(40)]
    assert np.mean(power) == pytest.approx(0.3**2 / 2, rel=0.1)
    spectrum = np.abs(np.fft.rfft(heave * np.hanning(len(heave)))) ** 2
    faster = np.fft.rfftfreq(len(heave), 0.1) > 1 / 2.0 + 0.1
    assert spectrum[faster].sum() < 1e-4 * spectrum.sum()


def test_angles_are_degrees_with_a_phase():
    table = "[track.roll]\namplitude_deg = 3\nperiod_s = 4\nphase_deg = 90"
    roll = parse(f"{TRACK}{table}").track.roll_rad
    expected = np.radians(3) * np.cos(2 * np.pi * 0.1 * np.arange(400) / 4)
    np.testing.assert_allclose(roll, expected, atol=1e-12)


@pytest.mark.parametrize(
    ("keys", "field", "expected"),
    [
        ("squint_deg = 10", "squint_rad", (np.pi / 18,)),
        ("squint_deg = [0, 90]", "squint_rad", (0, np.pi / 2)),
        ("spot_m = [1, 2, 3]", "spot_m", (1, 2, 3)),
    ],
)
def test_pointing(keys, field, expected):
    pointing = parse(f"[simulate.pointing]\n{keys}").simulate["pointing"]
    assert getattr(pointing, field) == pytest.approx(expected)


def test_windows_with_a_parameter():
    assert parse('[compress]\nwindow = ["kaiser", 6.0]').compress == {"window": ("kaiser", 6.0)}


def test_track_file(tmp_path):
    (tmp_path / "track.csv").write_text(
        "time_s, x_m, y_m, z_m, yaw_deg\n"
        "0, 1e6, 5, 0, 0\n"
        "0.5, 1000001, 5, 0, 90\n"
        "1, 1000003, 5, 0, 0\n"
    )
    track = parse("[track]\nfile = 'track.csv'", tmp_path).track
    np.testing.assert_array_equal(track.positions_m[:, 0], [1e6, 1e6 + 1, 1e6 + 3])
    np.testing.assert_allclose(track.yaw_rad, [0, np.pi / 2, 0])
    np.testing.assert_allclose(track.velocity_m_s[:, 0], [2, 3, 4])
    (tmp_path / "track.csv").write_text("vx_m_s,vy_m_s,vz_m_s,time_s,x_m,y_m,z_m\n1,2,3,0,0,0,0\n")
    assert parse("[track]\nfile = 'track.csv'", tmp_path).track.velocity_m_s.tolist() == [[1, 2, 3]]


GEOGRAPHIC = (
    "time_s,latitude_deg,longitude_deg,height_m,heading_deg,pitch_deg\n"
    "0,60.39,5.32,-20,0,2\n5,60.3901,5.32,-20,0,2\n"
)


def test_a_track_file_may_have_latitudes_and_longitudes(tmp_path):
    pytest.importorskip("pyproj")
    (tmp_path / "track.csv").write_text(GEOGRAPHIC)
    table = "[track]\nfile = 'track.csv'\n"
    expected = clsas.Track.from_geographic(
        [60.39, 60.3901], [5.32, 5.32], -20.0, 0.0, [0.0, 5.0], pitch_deg=2.0
    )
    scene = parse(table + GRID, tmp_path)
    np.testing.assert_array_equal(scene.track.positions_m, expected.positions_m)
    np.testing.assert_allclose(scene.track.pitch_rad, -np.radians(2))
    assert scene.track.georeference == expected.georeference
    assert scene.georeference == scene.grid.georeference == expected.georeference
    place = "[georeference]\nlatitude_deg = 60.39\nlongitude_deg = 5.32\nheading_deg = 90.0\n"
    scene = parse(table + place, tmp_path)
    assert scene.track.georeference == clsas.Georeference.local(60.39, 5.32, heading_deg=90.0)
    np.testing.assert_allclose(scene.track.positions_m[0], [0, 0, -20], atol=1e-6)
    np.testing.assert_allclose(scene.track.positions_m[1], [0, 11.14, -20], atol=0.01)
    np.testing.assert_allclose(scene.track.yaw_rad, np.pi / 2)


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("height_m", "z_m", "column 'z_m' must be left out with latitude_deg and longitude_deg"),
        ("pitch_deg", "yaw_deg", "column 'yaw_deg' must be left out with latitude_deg"),
        (",heading_deg", ",pitch_deg", "column 'heading_deg' must be present once"),
        ("60.39,", "91,", "latitude_deg must be"),
        ("latitude_deg", "lattitude_deg", "did you mean 'latitude_deg'"),
    ],
)
def test_wrong_latitudes_and_longitudes_are_one_message(before, after, message, tmp_path):
    pytest.importorskip("pyproj")
    (tmp_path / "track.csv").write_text(GEOGRAPHIC.replace(before, after, 1))
    with pytest.raises(ValueError, match=rf"track\.csv: .*{message}"):
        parse("[track]\nfile = 'track.csv'", tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("time_s,x_m,y_m,z\n", "unknown column 'z': did you mean 'z_m'"),
        ("time_s,x_m,y_m\n", "column 'z_m' must be present once"),
        ("time_s,x_m,y_m,z_m,z_m\n", "column 'z_m' must be present once"),
        ("time_s,x_m,y_m,z_m,yaw_deg,yaw_deg\n", "column 'yaw_deg' must be present once"),
        ("time_s,x_m,y_m,z_m,vx_m_s\n", "column 'vy_m_s' must be present once"),
        ("", "column 'time_s' must be present once"),
        ("time_s,x_m,y_m,z_m\n", "must have at least one ping below the names of the columns"),
        ("time_s,x_m,y_m,z_m\n0,0,0,0\n1,2,3\n", "line 3 must be 4 numbers, got '1,2,3'"),
        ("time_s,x_m,y_m,z_m\n0,0,0,zero\n", "line 2 must be 4 numbers, got '0,0,0,zero'"),
        ("time_s,x_m,y_m,z_m\n0,0,0,nan\n", "positions_m must be finite"),
        ("time_s,x_m,y_m,z_m\n0,0,0,0\n1,inf,0,0\n", "of 6 values, the first at [1, 0]"),
        ("time_s,x_m,y_m,z_m\nnan,0,0,0\n", "time_s must be finite"),
        ("time_s,x_m,y_m,z_m,yaw_deg\n0,0,0,0,nan\n", "yaw_rad must be finite"),
        ("time_s,x_m,y_m,z_m\n1,0,0,0\n0,0,0,0\n", "time_s must ascend"),
        (
            "time_s,x_m,y_m,z_m\n0,0,0,0\n2,1,0,0\n1,2,0,0\n3,3,0,0\n",
            "got a step of -1 s from ping 1 to the next (out of order; 1 such steps)",
        ),
        (
            "time_s,x_m,y_m,z_m\n0,0,0,0\n1,1,0,0\n1,2,0,0\n1,3,0,0\n",
            "got a step of 0 s from ping 1 to the next (repeated; 2 such steps): sort pings",
        ),
    ],
)
def test_bad_track_files(tmp_path, text, message):
    (tmp_path / "track.csv").write_text(text)
    told = refused("[track]\nfile = 'track.csv'", tmp_path)
    assert message in told
    assert "[track] file" in told
    assert "track.csv" in told


def test_a_track_file_that_is_no_text(tmp_path):
    (tmp_path / "track.csv").write_bytes(b"\xff\x00\xfe")
    told = refused("[track]\nfile = 'track.csv'", tmp_path)
    assert "[track] file" in told
    assert "must be text in UTF-8" in told
    assert "track.csv" in told


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("sonar = [", "not a TOML file: "),
        ("[mosaic]\nstore = ''", "[mosaic] store must be a path, got an empty one"),
        ("[sonr]", "unknown table [sonr]: did you mean 'sonar'?"),
        ("[lake]", "unknown table [lake]; allowed are sonar, track, targets, seabed, grid, "),
        (
            "[sonar.pulse]\ncarier_hz = 1e6\nduration_s = 1e-3",
            "unknown key 'carier_hz' in [sonar.pulse]: did you mean 'carrier_hz'?",
        ),
        (
            "[sonar.pulse]\ncarrier_khz = 100\nduration_s = 1e-3",
            "unknown key 'carrier_khz' in [sonar.pulse]: did you mean 'carrier_hz'?",
        ),
        ("[sonar.pulse]\ncarrier_hz = 1e6", "missing key 'duration_s' in [sonar.pulse]"),
        ("[sonar]\nspeed = 1500", "unknown key 'speed' in [sonar]"),
        (
            SONAR.replace("1e5", '"100 kHz"'),
            "[sonar.pulse] carrier_hz must be a number, got '100 kHz'",
        ),
        (
            f"{SONAR}bandwidth_hz = -1",
            "[sonar.pulse] bandwidth_hz must be finite and > 0 Hz, got -1",
        ),
        (
            f"{SONAR}bandwidth_hz = 3e5",
            "[sonar.pulse] bandwidth_hz must be finite and <= 200000 Hz, got 300000",
        ),
        (f"{SONAR}bandwidth_hz = nan", "[sonar.pulse] bandwidth_hz must be finite"),
        (SONAR, "[sonar.pulse] bandwidth_hz must be given: only a phase code"),
        (
            f"{SONAR}code = true",
            "[sonar.pulse] code must be a text in quotes or a list in [...], got True",
        ),
        (
            f"{SONAR}bandwidth_hz = 1e4\ncode = 'sideways'",
            "[sonar.pulse] code must be one of 'up', 'down'",
        ),
        ("[sonar]\npreset = 'hugin'", "[sonar] preset must be one of 'thesis_wide_beam'"),
        (
            "[sonar]\npreset = 'edgetech'\nspacing_m = 1",
            "preset must be the only key, got also spacing",
        ),
        (
            "[sonar]\nreceivers = 3",
            "[sonar] pulse must be given as [sonar.pulse], or `preset` instead",
        ),
        (
            f"[sonar]\nreceivers = 3\n{SONAR[SONAR.index('[sonar.p') :]}",
            "[sonar] rx_m must be given, or `receivers` and `spacing_m`, and not both",
        ),
        (SONAR.replace("[0.1, 0, 0]", "[0.1, 0]"), "[sonar] rx_m[1] must be a list of 3, got"),
        ("[track]\npings = 3", "[track] start_m must be given, or `file`"),
        (TRACK.replace("400", "2.5"), "[track] pings must be a whole number, got 2.5"),
        (TRACK.replace("400", "0"), "[track] pings must be at least 1, got 0"),
        (f"{TRACK}file = 'a.csv'", "[track] file must be the only key, got also ping_interval_s"),
        (
            f"{TRACK}[track.yaw]\namplitude_m = 1\nperiod_s = 1",
            "unknown key 'amplitude_m' in [track.yaw]: did you mean 'amplitude_deg'?",
        ),
        (f"{TRACK}[track.sway]\namplitude_m = 1\nperiod_s = 0", "[track.sway] period_s must be"),
        (
            f"{TRACK}[track.sway]\namplitude_m = 1\nperiod_s = 1\nphase_deg = 1\nrandom_seed = 1",
            "[track.sway] phase_deg must be left out with `random_seed`",
        ),
        (
            "[[targets]]\nposition_m = [0, 1, 2]\n[[targets]]\nposition = [0, 1, 2]",
            "unknown key 'position' in [[targets]] number 2: did you mean 'position_m'?",
        ),
        ("[seabed]", "missing key 'scene' in [seabed]"),
        (
            "[seabed]\nscene = 'lake'",
            "[seabed] scene must be one of 'wreck', 'pipeline', 'rocks', got 'lake'",
        ),
        (
            "[seabed]\nscene = 'rocks'\nmast_m = 3.0",
            "[seabed] mast_m must be left out with the scene 'rocks'",
        ),
        ("[seabed]\nscene = 'wreck'\nx_m = [1]", "[seabed] x_m must be a list of 2, got [1]"),
        ("[seabed]\nscene = 'wreck'\nx_m = [3, 1]", "[seabed] x_m must be first < last in m"),
        ("[seabed]\nscene = 'wreck'\nfloor_db = 3", "[seabed] floor_db must be finite and >="),
        (
            "[seabed]\nscene = 'wreck'\ndensity = 3",
            "unknown key 'density' in [seabed]: did you mean 'density_m2'?",
        ),
        ("[targets]\nposition_m = [0, 1, 2]", "targets must be one or more tables [[targets]]"),
        ("targets = []", "[[targets]] positions_m must have shape (any, 3) and no empty axis"),
        (GRID.replace("count = 3", "count = 0"), "[grid] x"),
        (GRID.replace("count = 3", "n = 3"), "unknown key 'n' in [grid.x]"),
        (GRID.replace("x =", "z ="), "unknown key 'z' in [grid]: did you mean 'z_m'?"),
        (
            "[grid]\nx = { start_m = 0, stop_m = 1, count = 3 }",
            "[grid] y must be given, or `origin_m`",
        ),
        (SLANTED.replace("shape = [2, 3]", ""), "[grid] shape must be given"),
        (
            SLANTED + "z_m = 2",
            "[grid] z_m must be left out with `column_step_m`: give `x`, `y` and",
        ),
        (SLANTED.replace("0.1, 0.02]", "0, 0]"), "[grid] row_step_m must not be zero"),
        (SLANTED.replace("[2, 3]", "[2, 3, 4]"), "[grid] shape must be a list of 2"),
        ("[simulate]\nrange_m = [1]", "[simulate] range_m must be a list of 2, got [1]"),
        ("[simulate]\nspreading = 1", "[simulate] spreading must be true or false, got 1"),
        (
            "[simulate.pointing]\nspot_m = [0, 1, 0]\nsquint_deg = 3",
            "[simulate.pointing] spot_m must be the only key",
        ),
        ("[simulate.pointing]\nsquint_deg = nan", "[simulate.pointing] squint_deg must be finite"),
        (
            "[simulate.pointing]\ndepression_deg = inf",
            "[simulate.pointing] depression_deg must be finite degrees, got inf",
        ),
        (
            f"{TRACK}[track.roll]\namplitude_deg = 1\nperiod_s = 1\nphase_deg = nan",
            "[track.roll] phase_deg must be finite degrees, got nan",
        ),
        (TRACK.replace("400", "10_000_000_000_000"), "[track] pings must ask for at most"),
        ("[simulate]\nsnr_db = nan", "[simulate] snr_db must be finite"),
        ("[simulate]\nseed = -1", "[simulate] seed must be at least 0, got -1"),
        (
            "[simulate]\nrange_m = [5, 1]",
            "[simulate] range_m must be two ascending numbers in m",
        ),
        (
            "[image]\naccuracy_db = -60\ntaps = 4\nupsampling = 2",
            "accuracy_db must be left",
        ),
        ("[compress]\nwindow = 'foo'", "[compress] window must be 'none' or a window of SciPy"),
        ("[compress]\nwindow = []", "[compress] window must be 'none' or a window of SciPy"),
        (
            "[compress]\noversampling = 0",
            "[compress] oversampling must be finite and >= 1 and <= 10000, got 0",
        ),
        ("[image]\ntaps = 3", "[image] taps must be one of 2, 4, 6, 8, got 3"),
        ("[image]\naccuracy_db = 5", "[image] accuracy_db must be finite and < 0 and >= -85 dB"),
        ("[image]\nupsampling = nan", "[image] upsampling must be finite and >= 1 and <= 64"),
        (
            "[image]\ntolerance_db = -50\ntaps = 4\nstages = [[2, 2]]",
            "[image] tolerance_db must be the only request, got also stages, taps",
        ),
        (
            "[image]\ntolerance_db = -90",
            "[image] tolerance_db must be finite and >= -85 and <= -10",
        ),
        (
            "[image]\ntolerance_wavelengths = 0",
            "[image] tolerance_wavelengths must be finite and >",
        ),
        ("[image]\nstages = [[2, 0]]", "[image] QI of stages must be at least 1, got 0"),
        ("[image]\nstages = [[2]]", "[image] stages[0] must be a list of 2, got [2]"),
        ("[image.beam]\nshape = 'hann'", "missing key 'width_deg' in [image.beam]"),
        ("[image.beam]\nwidth_deg = 0", "[image.beam] width_deg must be finite"),
    ],
)
def test_mistakes_are_named_with_their_place(text, message):
    assert message in refused(text)


def test_mistakes_have_their_parts_as_data():
    with pytest.raises(clsas.ArgumentError) as caught:
        parse("[compress]\noversampling = 0")
    error = caught.value
    assert (error.where, error.argument) == ("scene.toml: [compress]", "oversampling")
    assert error.given == "0"


def test_a_mistyped_key_is_one_mistake_and_every_mistake_is_told():
    told = refused("[sonar.pulse]\ncarier_hz = 1e6\nduration_s = '1 ms'\n[grid]\nx = 1")
    lines = told.splitlines()
    assert len(lines) == 3  # carrier, duration, x
    assert all(line.strip().startswith("scene.toml: ") for line in lines)
    assert "missing key 'carrier_hz'" not in told


def test_a_plane_of_any_direction():
    grid = parse(SLANTED).grid
    assert grid.shape == (2, 3)
    np.testing.assert_allclose(
        grid.positions_m()[[0, 1], [0, 2]], [[0, 20, -1], [0.2, 20.1, -0.98]]
    )


@pytest.mark.parametrize("name", ["heights.csv", "heights.npy"])
@pytest.mark.parametrize("table", [SLANTED, GRID], ids=["slanted", "horizontal"])
def test_heights_are_read_from_a_file(tmp_path, table, name):
    plane = parse(table).grid
    heights = np.random.default_rng(1).normal(size=plane.shape)
    if name == "heights.csv":
        np.savetxt(tmp_path / name, heights, delimiter=",", fmt="%.17g")
    else:
        np.save(tmp_path / name, heights)
    scene = parse(f"{table}height_file = '{name}'", tmp_path)
    np.testing.assert_array_equal(scene.grid.height_m, heights)
    np.testing.assert_array_equal(scene.grid.positions_m()[..., :2], plane.positions_m()[..., :2])
    assert scene.files == {"grid.height_file": tmp_path / name}


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("none.npy", None, "must be readable: No such file or directory"),
        ("heights.txt", b"1", "must end in .csv or .npy"),
        ("heights.npy", b"nothing of NumPy's", "must be an intact NumPy file"),
        ("heights.npy", saved(np.zeros((2, 3)))[:-1], "must be an intact NumPy file"),
        (
            "heights.npy",
            saved(np.zeros((2, 3))).replace(b"(2, 3), ", b"(2, -3),"),
            "must be an intact NumPy file",
        ),
        ("heights.npy", saved(np.zeros((2, 3), object)), "must be an intact NumPy file"),
        ("heights.npy", saved(np.zeros((2, 3), complex)), "must hold real numbers, got complex128"),
        ("heights.npy", saved(np.zeros((3, 2))), "must hold 2 x 3 heights (rows x columns of the"),
        ("heights.npy", saved(np.array(1.0)), "got one in"),
        ("heights.csv", b"1,2,3\n4,5,six\n", "must hold numbers separated by commas"),
        ("heights.csv", b"1,2,3\n4,5\n", "columns changed from 3 to 2 at row 2: "),
        ("heights.csv", b"\xff\xfe", "must hold numbers separated by commas"),
        ("heights.csv", b"1,2,3\n4,5,nan\n", "must hold finite heights"),
        ("heights.csv", b"1,2,3\n", "got 1 x 3 in"),
        ("heights.csv", b"\n", "must hold numbers separated by commas: the file is empty"),
    ],
)
def test_heights_that_cannot_be_used_are_refused(tmp_path, name, content, message):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    told = refused(f"{SLANTED}height_file = '{name}'", tmp_path)
    assert told.startswith("scene.toml: [grid] height_file must ")
    assert message in told
    assert told.count("\n") == 0


def test_missing_tables_are_named():
    scene = parse(GRID)
    assert scene.need("grid") == (scene.grid,)
    with pytest.raises(
        ValueError, match=r"^scene\.toml: missing table \[\[targets\]\] or \[seabed\]$"
    ):
        scene.need("grid", "targets")


def test_files_that_cannot_be_read(tmp_path):
    with pytest.raises(FileNotFoundError):
        config.read_scene(tmp_path / "none.toml")
    (tmp_path / "scene.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(ValueError, match=r"scene\.toml: not a TOML file"):
        config.read_scene(tmp_path / "scene.toml")
    (tmp_path / "scene.toml").write_text("[track]\nfile = 'none.csv'")
    with pytest.raises(
        ValueError, match=r"scene\.toml: \[track\] file must be readable: No such file .*none\.csv"
    ):
        config.read_scene(tmp_path / "scene.toml")


@pytest.mark.parametrize("depth", [100, 300, 500, 100_000])
@pytest.mark.parametrize("start", ["a=", "[[targets]]\nposition_m="])
def test_nested_tables_are_one_error(depth, start):
    text = start + "[" * depth + "]" * depth
    with pytest.raises(
        ValueError, match=r"scene.toml: .*(nested too deep|must be|unknown)"
    ) as error:
        config.parse_scene(text.encode(), name="scene.toml", folder=Path())
    assert len(str(error.value)) < 1000


def test_a_thousand_mistakes_are_one_short_message():
    text = "\n".join(f"key{i} = 1" for i in range(1000))
    with pytest.raises(ValueError, match="unknown table") as error:
        config.parse_scene(text.encode(), name="scene.toml", folder=Path())
    lines = str(error.value).splitlines()
    assert len(lines) == 21
    assert lines[-1] == "  scene.toml: and 980 more mistakes"


@pytest.mark.parametrize(
    "text",
    [
        '[sonar]\npreset = "{}"',
        '[sonar]\n"{}" = 1',
        '"{}" = 1',
        '[track]\npings = "{}"',
        '[seabed]\nscene = "rocks"\n"{}" = 1',
        '[simulate]\nsnr_db = ["{}"]',
    ],
)
def test_messages_shorten_and_escape_what_was_given(text):
    text = text.format("\\u001b[31m" + "x" * 100_000)
    with pytest.raises(ValueError, match=r"\\x1b\[31mxxx") as error:
        config.parse_scene(text.encode(), name="scene.toml", folder=Path())
    assert len(str(error.value)) < 500
    assert "\x1b" not in str(error.value)


def test_a_damaged_track_is_one_short_message(tmp_path):
    path = tmp_path / "track.csv"
    for text in ("x" * 10**6, "time_s,x_m,y_m,z_m\n" + "1" * 200_000, 'time_s,"x_m\n\0'):
        path.write_text(text)
        with pytest.raises(ValueError, match=r"track\.csv") as error:
            read_track(path)
        assert len(str(error.value)) < 500


def test_the_recording_to_process_may_be_elsewhere(tmp_path):
    """Only `clsas process` reads it; other commands use the rest of the scene."""
    path = tmp_path / "scene.toml"
    path.write_text(f'{GRID}\n[process]\nlines = "nowhere.h5"\n')
    scene = config.read_scene(path)
    assert scene.grid.shape == (4, 3)
    assert scene.process["lines"] == tmp_path / "nowhere.h5"


def test_a_georeference_places_track_and_grid():
    course = (
        "[track]\nstart_m = [0.0, 0.0, 0.0]\nvelocity_m_s = [1.0, 0.0, 0.0]\npings = 2\n"
        "ping_interval_s = 1.0\n[grid]\nx = { start_m = 0.0, stop_m = 1.0, count = 2 }\n"
        "y = { start_m = 0.0, stop_m = 1.0, count = 2 }\n"
    )
    local = "[georeference]\nlatitude_deg = 60.39\nlongitude_deg = 5.32\nheading_deg = 217.0\n"
    scene = parse(course + local)
    expected = clsas.Georeference.local(60.39, 5.32, heading_deg=217)
    assert scene.georeference == scene.track.georeference == scene.grid.georeference == expected
    pytest.importorskip("pyproj")
    scene = parse('[georeference]\ncrs = "EPSG:32632"\nvertical_datum = "NN2000"')
    assert scene.georeference == clsas.Georeference("EPSG:32632", vertical_datum="NN2000")
    for text, message in (
        ("heading_deg = 0.0\nlatitude_deg = 1.0", "longitude_deg must be given, or `crs`"),
        ('crs = "EPSG:32632"\nheading_deg = 0.0', "heading_deg must be left out with `crs`"),
        ('crs = "EPSG:99999"', "crs must be one that PROJ knows"),
        ("latitude_deg = 151.0\nlongitude_deg = -33.0\nheading_deg = 0.0", "probably swapped"),
    ):
        assert message in refused(f"[georeference]\n{text}")
