"""Valid calls of imagers, plans, image measures and navigation."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io

import clsas
from api_calls.scene import EMPTY, LARGE, Call, fields, nothing, scene
from clsas.engine.factorized.costs import Costs


def imaging(folder: Path) -> dict[str, Call]:
    s = scene(folder)
    lines, grid, beam, plan = s.lines, s.grid, s.beam, s.plan
    certificate = clsas.certify(s.image, lines, beam=beam, pixels=40, seed=1)
    few = lines.select(slice(0, 20))
    scene_names = {"lines": ("samples", "range_step_m", "carrier_hz"), "grid": ("height_m",)}
    whole = {"lines": lines, "grid": grid}
    optional = ("None",)
    device = {"device": "device"}
    history = scipy.io.loadmat(folder / "pass.mat", simplify_cells=True)["data"]
    tx_m = np.stack([history[axis] for axis in "xyz"], axis=1)
    capture = np.cos(np.arange(60)[:, None] / 2 + np.arange(3)).T
    return {
        "backproject": Call(
            clsas.backproject,
            whole
            | {
                "device": 0,
                "accuracy_db": -50.0,
                "taps": 4,
                "upsampling": 2.0,
                "beam": beam,
                "certificate": False,
                "on_miss": "warn",
                "accumulate": s.image,
                "progress": nothing,
            },
            kinds=device,
            names=scene_names,
            accepts=dict.fromkeys(
                ("taps", "upsampling", "beam", "certificate", "accumulate", "progress"), optional
            ),
        ),
        "factorize": Call(
            clsas.factorize,
            whole
            | {
                "plan_or_tolerance": plan,
                "beam": None,
                "device": 0,
                "certificate": False,
                "on_miss": "warn",
                "accumulate": s.image,
                "progress": nothing,
            },
            kinds=device,
            names=scene_names,
            accepts=dict.fromkeys(("beam", "certificate", "accumulate", "progress"), optional),
        ),
        "wavenumber": Call(
            clsas.wavenumber,
            whole | {"beam": beam, "motion_compensation": True, "workers": 1},
            names=scene_names,
            accepts=dict.fromkeys(("beam", "workers"), optional),
        ),
        "plan": Call(
            clsas.plan,
            whole
            | {
                "tolerance_db": None,
                "tolerance_wavelengths": None,
                "stages": [(2, 2)],
                "beam": beam,
                "device": 0,
                "memory_bytes": 1 << 30,
                "costs": Costs(),
                "taps": None,
                "depth": None,
                "full_model": False,
            },
            kinds=device,
            names=scene_names,
            accepts=dict.fromkeys(("beam", "memory_bytes", "costs"), optional) | {"stages": EMPTY},
        ),
        "Imager": Call(
            clsas.Imager,
            whole
            | {
                "plan": plan,
                "tolerance_db": None,
                "accuracy_db": None,
                "beam": None,
                "device": 0,
            },
            kinds=device,
            names=scene_names,
            accepts=dict.fromkeys(("tolerance_db", "accuracy_db", "beam"), optional),
        ),
        "Imager:tolerance": Call(
            clsas.Imager,
            whole | {"tolerance_db": -30.0, "beam": beam},
            names=scene_names,
            accepts={"beam": optional},
        ),
        "Imager:accuracy": Call(
            clsas.Imager,
            whole | {"accuracy_db": -50.0, "beam": beam},
            names=scene_names,
            accepts={"beam": optional},
        ),
        "Imager.close": Call(clsas.Imager(lines, grid, plan).close, {}),
        "Imager:called": Call(
            clsas.Imager(lines, grid, accuracy_db=-50.0),
            {
                "lines": lines,
                "certificate": False,
                "on_miss": "warn",
                "accumulate": s.image,
                "progress": nothing,
            },
            accepts=dict.fromkeys(("certificate", "accumulate", "progress"), optional),
        ),
        "plan:tolerance": Call(
            clsas.plan,
            whole
            | {
                "tolerance_db": -30.0,
                "tolerance_wavelengths": None,
                "stages": None,
                "taps": (4, 4),
                "depth": 1,
                "costs": Costs(),
            },
            names=scene_names,
            accepts={
                "taps": optional,
                "depth": optional,
                "costs": optional,
                "tolerance_wavelengths": ("number",),
            },
        ),
        "plan:wavelengths": Call(
            clsas.plan,
            whole | {"tolerance_wavelengths": 0.01, "full_model": True, "costs": Costs()},
            names=scene_names,
            accepts={"costs": optional},
        ),
        "factorize:tolerance": Call(
            clsas.factorize,
            whole | {"plan_or_tolerance": -30.0, "beam": beam},
            names=scene_names | {"plan_or_tolerance": ("tolerance_db",)},
            accepts={"beam": optional},
        ),
        "Plan.check": Call(plan.check, whole),
        "Plan.describe": Call(plan.describe, {}),
        "Plan.from_json": Call(clsas.Plan.from_json, {"text": plan.to_json()}),
        "Plan.to_json": Call(plan.to_json, {"filters": True}),
        "assess": Call(
            clsas.assess,
            whole
            | {
                "beam": beam,
                "tolerance_db": -40.0,
                "sonar": s.sonar,
                "track": s.track,
                "pointing": clsas.Pointing(),
                "element_pattern": True,
                "device": 0,
                "costs": Costs(),
                "repeats": 0,
                "ends": False,
            },
            kinds=device,
            names=scene_names,
            skips={"repeats": LARGE},
            accepts=dict.fromkeys(("beam", "sonar", "track", "pointing", "costs"), optional),
        ),
        "certify": Call(
            clsas.certify,
            {
                "image": s.image,
                "lines": lines,
                "beam": beam,
                "pixels": 40,
                "seed": 1,
                "scale": False,
                "device": 0,
            },
            kinds=device,
            names={"lines": scene_names["lines"]},
            accepts=dict.fromkeys(("beam", "seed"), optional),
        ),
        "Certificate.describe": Call(
            certificate.describe, {"tolerance_db": -40.0}, accepts={"tolerance_db": optional}
        ),
        "Certificate.verdict": Call(certificate.verdict, {"tolerance_db": -40.0}),
        "inspect": Call(
            clsas.inspect,
            whole | {"device": 0, "beam": beam, "element_length_m": 0.1},
            kinds=device,
            names=scene_names,
            accepts=dict.fromkeys(("grid", "beam", "element_length_m"), optional),
        ),
        "list_devices": Call(clsas.list_devices, {}),
        "measure_point": Call(
            clsas.measure_point,
            {"image": s.image, "near": (0.1, 15.0), "search_m": 0.2, "extent_m": 0.3},
            accepts=dict.fromkeys(("search_m", "extent_m"), optional),
            names={"image": ("near",)},
        ),
        "tradeoff": Call(
            clsas.tradeoff,
            whole
            | {
                "tolerances_db": (-30.0, -40.0),
                "stages": [[(2, 2)]],
                "beam": beam,
                "device": 0,
                "repeats": 1,
                "study": False,
                "progress": nothing,
            },
            kinds=device,
            names=scene_names,
            skips={"repeats": LARGE},
            accepts=dict.fromkeys(("beam", "progress"), optional)
            | {"tolerances_db": EMPTY, "stages": (*optional, *EMPTY)},
        ),
        "from_phase_history": Call(
            clsas.from_phase_history,
            {
                "samples": history["fp"].T,
                "first_frequency_hz": np.full(8, 9e9),
                "frequency_step_hz": np.full(8, 1e6),
                "reference_range_m": history["r0"],
                "tx_m": tx_m,
                "rx_m": tx_m,
                "sound_speed_m_s": 3e8,
                "band_hz": (9e9, 9.006e9),
                "window": "hann",
                "oversampling": 2.0,
                "sign": -1,
            },
            accepts={"samples": ("an Image",), "band_hz": optional},
        ),
        "from_full_matrix": Call(
            clsas.from_full_matrix,
            {
                "samples": capture,
                "elements_m": np.array([[0.0, 0.0, 0.0], [1e-3, 0.0, 0.0]]),
                "sample_rate_hz": 25e6,
                "carrier_hz": 5e6,
                "sound_speed_m_s": 6000.0,
                "start_time_s": 0.0,
                "pairs": (np.array([0, 0, 1]), np.array([0, 1, 1])),
                "bandwidth_hz": 4e6,
                "window": "hann",
                "oversampling": 2.0,
            },
            accepts={"bandwidth_hz": optional},
        ),
        "mosaic": Call(
            lambda **given: clsas.mosaic(**given).image(),
            {
                "source": few,
                "grid": grid,
                "tolerance_db": None,
                "tolerance_wavelengths": None,
                "stages": None,
                "accuracy_db": -50.0,
                "beam": beam,
                "patches": (2, 1),
                "memory_bytes": 1 << 28,
                "device": 0,
                "client": None,
                "certificate": False,
                "on_miss": "warn",
                "follow_s": None,
            },
            kinds=device,
            skips={"source": ("str",)},
            names=scene_names,
            accepts=dict.fromkeys(
                ("accuracy_db", "beam", "patches", "memory_bytes", "certificate"), optional
            ),
        ),
        "mosaic:tolerance": Call(
            _anew(folder / "new.zarr"),
            {
                "source": folder / "lines.h5",
                "grid": grid,
                "store": folder / "new.zarr",
                "tolerance_db": -30.0,
                "patches": (2, 2),
            },
            names=scene_names,
            accepts={
                "store": optional,
                "patches": optional,
                "tolerance_db": optional,
                "source": ("RangeLines", "folder"),
            },
        ),
        "Mosaic.image": Call(
            clsas.mosaic(few, grid, accuracy_db=-50.0, patches=(2, 1)).image,
            {"tell": nothing},
            accepts={"tell": optional},
        ),
    }


def _anew(store: Path, function: Callable = clsas.mosaic) -> Callable:
    """Return a function, preceded by the removal of the store that the last call left."""

    def anew(**given: Any) -> Any:
        shutil.rmtree(store, ignore_errors=True)
        return function(**given)

    return anew


def navigation(folder: Path) -> dict[str, Call]:
    s = scene(folder)
    optional = ("None",)
    array = clsas.Sonar(
        s.sonar.pulse, [[0.05 * n, 0.0, 0.0] for n in range(8)], tx_length_m=0.1, rx_length_m=0.1
    )
    track = clsas.Track.straight((-1.0, 0.0, 0.0), (1.0, 0.0, 0.0), 12, 0.1)
    rng = np.random.default_rng(0)
    at = np.stack([rng.uniform(-1.5, 1.5, 150), rng.uniform(14, 16, 150), np.zeros(150)], axis=1)
    overlapping = clsas.compress(
        clsas.simulate(array, track, clsas.PointTargets(at, np.exp(2j * np.pi * rng.random(150))))
    )
    tx_m = np.outer(np.linspace(-1, 1, 40), [1, 0, 0]) + [0, 0, 5]
    seabed_m = np.stack([rng.uniform(-1, 1, 5000), rng.uniform(14.2, 16, 5000), np.zeros(5000)], 1)
    amplitudes = rng.standard_normal((5000, 2)) @ [1, 1j]
    lower, upper = (
        clsas.simulate_lines(
            tx_m, tx_m + [0, 0, up_m], clsas.PointTargets(seabed_m, amplitudes),
            carrier_hz=100e3, bandwidth_hz=20e3,
        )
        for up_m in (0.0, 0.2)
    )  # fmt: skip
    found = clsas.heights(lower, upper, s.grid, search_m=(-0.3, 0.4), window_m=0.3)
    pair = {
        "a": lower,
        "b": upper,
        "found": found,
        "known_sd_m": 0.01,
        "unknowns": ("phase",),
        "tolerance_db": -30.0,
        "beam": None,
        "device": 0,
    }
    of_pair: dict[str, Any] = {
        "kinds": {"device": "device"},
        "names": {"a": ("b", "found"), "b": ("a", "found"), "found": ("mask",)},
        "accepts": {"beam": ("None", "a BeamWindow")},
    }
    errors = clsas.pair_errors(lower, upper, found, known_height_m=0.0, unknowns=("phase",))
    return {
        "micronavigate": Call(
            clsas.micronavigate,
            {
                "lines": overlapping,
                "range_m": (14.25, 15.75),
                "window_m": 0.5,
                "side": "port",
                "seabed_z_m": 0.0,
                "element_length_m": (0.1, 0.1),
                "sway_sd_m": np.full(12, 0.1),
                "yaw_sd_deg": np.full(12, 0.5),
                "surge_sd_m": np.full(12, 0.1),
                "correlation_pings": 5.0,
                "unknowns": ("sway", "yaw", "surge"),
                "most_step_m": 0.1,
                "progress": nothing,
            },
            accepts=dict.fromkeys(
                (
                    "range_m",
                    "window_m",
                    "seabed_z_m",
                    "element_length_m",
                    "correlation_pings",
                    "progress",
                ),
                optional,
            ),
        ),
        "interferogram": Call(clsas.interferogram, {"a": s.image, "b": s.image, "window_m": 0.5}),
        "Interferogram": Call(
            clsas.Interferogram, fields(clsas.interferogram(s.image, s.image, 0.5))
        ),
        "heights": Call(
            clsas.heights,
            {
                "a": lower,
                "b": upper,
                "grid": s.grid,
                "search_m": (-0.3, 0.4),
                "window_m": 0.3,
                "tolerance_db": -30.0,
                "least_coherence": 0.5,
                "beam": None,
                "device": 0,
                "progress": nothing,
            },
            kinds={"device": "device"},
            names={"a": ("b",), "b": ("a",)},
            accepts=dict.fromkeys(("window_m", "progress"), optional)
            | {"beam": ("None", "a BeamWindow")},
            may_be_nan=True,
        ),
        "mosaic_heights": Call(
            _anew(folder / "heights.zarr", clsas.mosaic_heights),
            {
                "a": lower,
                "b": upper,
                "grid": s.grid,
                "store": folder / "heights.zarr",
                "search_m": (-0.3, 0.4),
                "window_m": 0.3,
                "tolerance_db": -30.0,
                "least_coherence": 0.5,
                "beam": None,
                "patch_m": 2.0,
                "device": 0,
                "progress": nothing,
            },
            kinds={"device": "device"},
            names={"a": ("b", "source"), "b": ("a", "source")},
            accepts=dict.fromkeys(("window_m", "progress", "patch_m"), optional)
            | {"beam": ("None", "a BeamWindow"), "b": ("None",)},
            skips={"a": ("str",), "b": ("str",)},
        ),
        "Heights": Call(clsas.Heights, fields(found), may_be_nan=True),
        "pair_errors": Call(
            clsas.pair_errors,
            pair | {"known_height_m": 0.0, "points_m": None, "other": None},
            **of_pair,
        ),
        "pair_errors:points": Call(
            clsas.pair_errors,
            pair | {"points_m": [[0.0, 15.0, 0.0], [0.2, 14.8, 0.0]]},
            **of_pair,
        ),
        "PairErrors.corrected": Call(
            errors.corrected, {"a": lower, "b": upper}, names={"a": ("b",), "b": ("a",)}
        ),
        "PairErrors.describe": Call(errors.describe, {}),
        "PairErrors.held_in_words": Call(errors.held_in_words, {}),
        "autofocus": Call(
            clsas.autofocus,
            {
                "lines": s.lines,
                "grid": s.grid,
                "beam": s.beam,
                "unknowns": ("sway",),
                "device": 0,
                "progress": nothing,
            },
            kinds={"device": "device"},
            accepts=dict.fromkeys(("beam", "progress"), optional),
        ),
        "calibrate_track": Call(
            clsas.calibrate_track,
            {
                "lines": s.lines,
                "points_m": np.array(s.targets.positions_m),
                "unknowns": ("time_offset",),
                "search_m": 0.2,
                "track": s.track,
                "progress": nothing,
            },
            accepts=dict.fromkeys(("search_m", "track", "progress"), optional),
        ),
    }
