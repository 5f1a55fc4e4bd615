from dataclasses import replace

import numpy as np
import pytest
from cases import along_x

import clsas
from clsas import RangeLines, SoundSpeed, read_sound_speed
from clsas.files.scene_files import read_scene, simulation_digest
from clsas.mosaics.survey import open_survey

PROFILE = SoundSpeed([0, 10, 40], [1500, 1500, 1492.5], surface_z_m=20.0)
TRACK = along_x(5, 0.1)


def lines(profile=PROFILE):
    samples = np.random.default_rng(0).normal(size=(5, 300, 2)) @ [1, 1j]
    return RangeLines(samples, 20, 0.05, TRACK, TRACK, 1e5, 1500, sound_speed=profile)


def test_hdf5_keeps_a_profile(tmp_path):
    clsas.save(tmp_path / "lines.h5", lines())
    assert clsas.load(tmp_path / "lines.h5").sound_speed == PROFILE
    clsas.save(tmp_path / "lines.h5", lines(None))
    assert clsas.load(tmp_path / "lines.h5").sound_speed is None


def test_echoes_keep_a_profile(tmp_path):
    given = lines()
    echoes = clsas.Echoes(given.samples, 0.02, 3e4, 1e5, TRACK, TRACK, 1500, sound_speed=PROFILE)
    clsas.save(tmp_path / "echoes.h5", echoes)
    assert clsas.load(tmp_path / "echoes.h5").sound_speed == PROFILE


def test_xarray_has_depths_and_speeds():
    data = clsas.to_xarray(lines())
    assert data.attrs["sound_speed_depth_m"].tolist() == [0, 10, 40]
    assert data.attrs["sound_speed_speed_m_s"].tolist() == [1500, 1500, 1492.5]
    assert data.attrs["sound_speed_surface_z_m"] == 20


def test_cphd_refuses_a_profile(tmp_path):
    pytest.importorskip("sarkit")
    with pytest.raises(ValueError, match="lines must have no `sound_speed`"):
        clsas.write_cphd(tmp_path / "lines.cphd", lines())


def test_files_of_a_survey_have_one_profile(tmp_path):
    clsas.save(tmp_path / "a.h5", lines())
    clsas.save(tmp_path / "b.h5", replace(lines(), tx_m=TRACK + [1, 0, 0], rx_m=TRACK + [1, 0, 0]))
    assert open_survey(tmp_path).geometry.sound_speed == PROFILE
    clsas.save(tmp_path / "c.h5", lines(None))
    with pytest.raises(ValueError, match=r"c.h5: sound_speed must equal that of the survey"):
        open_survey(tmp_path)


def test_csv_with_speeds_or_what_they_follow_from(tmp_path):
    path = tmp_path / "cast.csv"
    path.write_text("speed_m_s, depth_m\n1500, 0\n1500, 10\n1492.5, 40\n")
    assert read_sound_speed(path, surface_z_m=20.0) == PROFILE
    path.write_text("depth_m,temperature_c,salinity\n0,25,35\n1000,25,35\n")
    assert read_sound_speed(path) == SoundSpeed.from_temperature([0, 1000], [25, 25], 35)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "cast.csv: columns must be depth_m, speed_m_s or depth_m, temperature_c, salinity"),
        ("depth_m,speed_m_s\n", "must have depths below the names"),
        ("depth,speed_m_s\n0,1500\n", "unknown column 'depth'.*depth_m"),
        ("depth_m,speed_m_s,salinity\n0,1500,35\n", "columns must be"),
        ("depth_m,speed_m_s\n0,1500\n1,fast\n", "line 3 must be 2 numbers, got '1,fast'"),
        ("depth_m,temperature_c,salinity\n0,25,35\n26\n", "line 3 must be 3 numbers, got '26'"),
        ("depth_m,speed_m_s\n0,4900\n10,4900\n", "cast.csv: speed_m_s .* feet per second"),
    ],
)
def test_csv_that_is_no_profile(text, message, tmp_path):
    path = tmp_path / "cast.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        read_sound_speed(path)


def test_csv_that_is_not_utf_8(tmp_path):
    path = tmp_path / "cast.csv"
    path.write_bytes("depth_m,speed_m_s\n0,1500\n".encode("utf-16"))
    with pytest.raises(ValueError, match=r"cast.csv must be text in UTF-8, got the byte 0xff at"):
        read_sound_speed(path)


def scene(tmp_path, text):
    path = tmp_path / "scene.toml"
    path.write_text(text)
    return read_scene(path)


@pytest.mark.parametrize(
    "keys",
    [
        "depth_m = [0.0, 10.0, 40.0]\nspeed_m_s = [1500.0, 1500.0, 1492.5]",
        'file = "cast.csv"',
    ],
)
def test_scenes_have_profiles(keys, tmp_path):
    cast = tmp_path / "cast.csv"
    cast.write_text("depth_m,speed_m_s\n0,1500\n10,1500\n40,1492.5\n")
    text = f"[sound_speed]\n{keys}\nsurface_z_m = 20.0\n"
    found = scene(tmp_path, text)
    assert found.sound_speed == PROFILE
    assert found.simulate == {"sound_speed": PROFILE}
    before = simulation_digest(text.encode(), tmp_path)
    cast.write_text("depth_m,speed_m_s\n0,1500\n10,1500\n40,1490\n")
    assert (simulation_digest(text.encode(), tmp_path) != before) == ("file" in keys)


def test_scenes_have_temperatures(tmp_path):
    found = scene(
        tmp_path,
        "[sound_speed]\ndepth_m = [0.0, 50.0]\ntemperature_c = [15.0, 8.0]\nsalinity = 34.0\n",
    )
    assert found.sound_speed == SoundSpeed.from_temperature([0, 50], [15, 8], 34)


@pytest.mark.parametrize(
    "keys", ["", "depth_m = [0.0, 1.0]", 'file = "a.csv"\ndepth_m = [0.0, 1.0]']
)
def test_a_table_has_one_way_to_give_a_profile(keys, tmp_path):
    with pytest.raises(ValueError, match=r"\[sound_speed\] must have the keys file; or depth_m"):
        scene(tmp_path, f"[sound_speed]\n{keys}\n")


def test_blank_lines_are_skipped(tmp_path):
    path = tmp_path / "cast.csv"
    path.write_text("\ndepth_m, speed_m_s\n\n0, 1500\n   \n20, 1490\n\n")
    assert clsas.read_sound_speed(path).speed_m_s.tolist() == [1500, 1490]
