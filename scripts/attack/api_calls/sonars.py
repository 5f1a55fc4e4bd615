"""Valid calls of sonars, tracks, beams, scenes and the simulator."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import clsas
from api_calls.scene import EMPTY, Call, fields, nothing, scene
from clsas.simulation.scenes import Observer


def sonars(folder: Path) -> dict[str, Call]:
    s = scene(folder)
    pulse = s.sonar.pulse
    coded = clsas.Pulse.phase_code(1e5, 1e-3, (1, 1, -1, 1))
    beam = clsas.BeamWindow(20.0, "tukey", 3.0, 0.3, along=[1.0, 0, 0])
    inverse = {"wavelength_m": 0.015}
    times = np.linspace(-1e-4, 1.1e-3, 7)
    observer = Observer(np.array([0.0, 0.0, 2.0]))
    pointing = clsas.Pointing.squint(0.1)
    optional = ("None",)
    profile = clsas.SoundSpeed([0.0, 40.0], [1500.0, 1490.0], 20.0)
    place = clsas.Georeference.local(60.39, 5.32, heading_deg=217.0)
    unplaced = {"georeference": optional}
    sizes = ("tx_length_m", "rx_length_m", "tx_height_m", "rx_height_m")
    motions = ("surge_m", "sway_m", "heave_m", "yaw_rad", "pitch_rad", "roll_rad")
    return {
        "Pulse": Call(
            clsas.Pulse,
            {
                "carrier_hz": 1e5,
                "bandwidth_hz": 2e4,
                "duration_s": 1e-3,
                "code": "up",
                "taper": 0.1,
            },
        ),
        "Pulse.phase_code": Call(
            clsas.Pulse.phase_code,
            {"carrier_hz": 1e5, "duration_s": 1e-3, "chips": (1, -1, 1), "taper": 0.1},
            names={"chips": ("code",)},
        ),
        "Pulse.envelope": Call(pulse.envelope, {"time_s": times}, accepts={"time_s": EMPTY}),
        "Pulse.spectrum": Call(
            coded.spectrum,
            {"frequency_hz": np.array([0.0, 1e3, -2e3])},
            accepts={"frequency_hz": EMPTY},
        ),
        "Sonar": Call(
            clsas.Sonar,
            fields(s.sonar) | dict.fromkeys(sizes, 0.2) | {"bank_numbers": [0]},
            accepts={each: optional for each in (*sizes, "sample_rate_hz", "bank_numbers")},
            names={"pulse": ("bandwidth_hz",)},
        ),
        "Sonar.bank": Call(clsas.Sonar.hisas_1030().bank, {"number": 1}),
        "Sonar.channel_banks": Call(clsas.Sonar.hisas_1030().channel_banks, {"pings": 3}),
        "Sonar.hisas_1030": Call(clsas.Sonar.hisas_1030, {}),
        "Sonar.edgetech": Call(clsas.Sonar.edgetech, {}),
        "Sonar.sensotek": Call(clsas.Sonar.sensotek, {}),
        "Sonar.thesis_wide_beam": Call(clsas.Sonar.thesis_wide_beam, {}),
        "Track": Call(clsas.Track, fields(s.track) | {"georeference": place}, accepts=unplaced),
        "Track.straight": Call(
            clsas.Track.straight,
            {
                "start_m": np.zeros(3),
                "velocity_m_s": np.array([1.0, 0.0, 0.0]),
                "pings": 7,
                "ping_interval_s": 0.2,
                **{name: np.linspace(0, 0.1, 7) for name in motions},
            },
            skips=dict.fromkeys(motions, ("class",)),
        ),
        "channels": Call(
            clsas.channels, {"sonar": s.sonar, "track": s.track, "motion_in_flight": False}
        ),
        "Pointing": Call(
            clsas.Pointing,
            {"squint_rad": (0.1, 0.2), "depression_rad": 0.1, "spot_m": (1.0, 2.0, 3.0)},
            accepts={"spot_m": optional},
        ),
        "Pointing.axes": Call(pointing.axes, {"track": s.track}),
        "Pointing.broadside": Call(clsas.Pointing.broadside, {"depression_rad": 0.1}),
        "Pointing.scan": Call(
            clsas.Pointing.scan,
            {"angles_rad": np.array([0.0, 0.1]), "depression_rad": 0.1},
            names={"angles_rad": ("squint_rad",)},
        ),
        "Pointing.spot": Call(
            clsas.Pointing.spot,
            {"point_m": np.array([1.0, 2.0, 3.0])},
            names={"point_m": ("spot_m",)},
        ),
        "Pointing.squint": Call(
            clsas.Pointing.squint,
            {"angle_rad": 0.1, "depression_rad": 0.1},
            names={"angle_rad": ("squint_rad",)},
        ),
        "BeamWindow": Call(
            clsas.BeamWindow,
            {
                "width_deg": 20.0,
                "shape": "tukey",
                "squint_deg": 3.0,
                "taper": 0.3,
                "element_length_m": 0.1,
                "along": np.array([1.0, 0.0, 0.0]),
                "normalise": False,
                "track_pings": 7,
            },
            accepts=dict.fromkeys(("element_length_m", "along", "track_pings"), optional),
        ),
        "BeamWindow.of_element": Call(
            clsas.BeamWindow.of_element, {"length_m": 0.1, "wavelength_m": 0.015, "shape": "hann"}
        ),
        "BeamWindow.divided": Call(beam.divided, {"count": 3}),
        "BeamWindow.directions": Call(beam.directions, {"lines": s.lines}),
        "BeamWindow.weights": Call(
            beam.weights,
            {"q": np.linspace(-0.5, 0.5, 9), **inverse},
            accepts={"wavelength_m": ("inf",), "q": EMPTY},
        ),
        "PointTargets": Call(
            clsas.PointTargets,
            {
                "positions_m": np.array([[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]]),
                "amplitudes": np.array([1.0, 2.0]),
            },
            accepts={"amplitudes": ("complex array", "complex")},
        ),
        "Seabed": Call(
            clsas.Seabed,
            {
                "x_m": (-1.0, 1.0),
                "y_m": (14.0, 16.0),
                "heights_m": np.zeros((4, 5)),
                "texture": np.ones((4, 5)),
                "density_m2": 20.0,
                "seed": 3,
                "floor_db": -40.0,
            },
        ),
        "Seabed.height_m": Call(
            s.seabed.height_m,
            {"x_m": np.array([0.0, 0.5]), "y_m": np.array([14.5, 15.5])},
            accepts={"x_m": EMPTY, "y_m": EMPTY},
            may_be_nan=True,
        ),
        "Seabed.lit": Call(
            s.seabed.lit,
            {
                "points_m": np.array([[0.0, 14.5, 0.5], [0.5, 15.5, 0.5]]),
                "eye_m": np.array([0.0, 0.0, 5.0]),
            },
        ),
        "simulate": Call(
            clsas.simulate,
            {
                "sonar": s.sonar,
                "track": s.track,
                "scene": s.targets,
                "pointing": pointing,
                "spreading": False,
                "motion_in_flight": False,
                "element_pattern": True,
                "phase_centres": False,
                "range_m": (14.0, 16.5),
                "snr_db": 20.0,
                "seed": 1,
                "sound_speed": profile,
                "workers": 1,
                "progress": nothing,
            },
            accepts=dict.fromkeys(
                ("pointing", "range_m", "snr_db", "sound_speed", "workers", "progress"), optional
            ),
        ),
        "simulate_lines": Call(
            clsas.simulate_lines,
            {
                "tx_m": np.array(s.lines.tx_m),
                "rx_m": np.array(s.lines.rx_m),
                "scene": s.targets,
                "carrier_hz": 1e5,
                "bandwidth_hz": 2e4,
                "window": "hann",
                "oversampling": 2.0,
                "sound_speed_m_s": 1500.0,
                "first_range_m": np.full(40, 14.0),
                "length": 100,
                "rx_velocity_m_s": np.ones((40, 3)),
                "sound_speed": profile,
                "workers": 1,
                "progress": nothing,
            },
            accepts=dict.fromkeys(
                (
                    "first_range_m",
                    "length",
                    "rx_velocity_m_s",
                    "sound_speed",
                    "workers",
                    "progress",
                ),
                optional,
            ),
        ),
        "compress": Call(
            clsas.compress,
            {
                "echoes": s.echoes,
                "window": "hann",
                "oversampling": 2.0,
                "bandwidth_hz": 2e4,
                "replica": clsas.Replica(np.exp(1j * np.linspace(0, 30, 41) ** 2 / 30), 4e4),
                "equalize": True,
                "progress": nothing,
            },
            accepts=dict.fromkeys(("bandwidth_hz", "replica", "progress"), optional),
        ),
        "survey_lines": Call(
            clsas.survey_lines,
            {
                "sonar": s.sonar,
                "track": s.track,
                "grid": s.grid,
                "motion_in_flight": False,
                "phase_centres": False,
                "window": "hann",
                "oversampling": 2.0,
                "sound_speed": profile,
            },
            accepts={"sound_speed": optional},
        ),
        "limits": Call(
            clsas.limits,
            {
                "sonar": s.sonar,
                "track": s.track,
                "grid": s.grid,
                "beam": s.beam,
                "range_m": (10.0, 60.0),
                "window": "hann",
                "pointing": clsas.Pointing(),
                "element_pattern": True,
                "motion_in_flight": False,
            },
            accepts=dict.fromkeys(("track", "grid", "beam", "range_m", "pointing"), optional),
        ),
        "check_sampling": Call(
            clsas.check_sampling,
            {
                "sonar": s.sonar,
                "track": s.track,
                "grid": s.grid,
                "beam": s.beam,
                "element_length_m": 0.1,
                "wavelength_m": 0.015,
            },
            accepts=dict.fromkeys(
                ("track", "grid", "beam", "element_length_m", "wavelength_m"), optional
            )
            | {"sonar": ("RangeLines",)},
        ),
        **{
            f"{name}.{method}": Call(getattr(obj, method), {"observer": observer})
            for name, obj in (("PointTargets", s.targets), ("Seabed", s.seabed))
            for method in ("spheres", "visible")
        },
        "BeamWindow.block_error": Call(beam.block_error, {"reach": 0.01}),
        "BeamWindow.plane_error": Call(
            beam.plane_error, {"reach": 0.01, **inverse}, accepts={"wavelength_m": ("inf",)}
        ),
        "BeamWindow.fullness": Call(
            beam.fullness,
            {"sine": np.linspace(-0.3, 0.3, 40), **inverse, "share": 1.0},
            accepts={"wavelength_m": ("inf",), "sine": EMPTY},
        ),
        "BeamWindow.table": Call(beam.table, inverse, accepts={"wavelength_m": ("inf",)}),
    }
