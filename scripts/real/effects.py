"""Print which effects the images of docs/assess.md need, and the time that each effect costs.

The thesis's case and the wreck are assessed as surveys, the two recordings as lines. The radar
recording is also assessed with two known effects that do not matter: the motion of the aircraft
during the flight of a pulse, and a height for every pixel, which is the same for all. The thesis's
case is also assessed over a sloping seabed.

    python scripts/real/effects.py [CASE ...] [--device NAME] [--repeats 5] [--docs]
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import radar
import recordings
import ultrasound
from exactly import execute, prepare

import clsas
from clsas.engine.device.device import Device, open_device
from clsas.files import scene_files as config
from clsas.measures.assess import NONE_DB, Assessment, Effect

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import stored_tables

AIRCRAFT_M_S = 100.0
"""Approximate speed of the aircraft, whose positions are known, but not their times."""


def survey(name: str, **simulate: Any) -> dict[str, Any]:
    """Return the arguments of `clsas.assess` for a built-in scene."""
    scene = config.parse_scene(config.built_in_scene(name), name=name, folder=Path())
    lines = clsas.survey_lines(scene.sonar, scene.track, scene.grid, **simulate, **scene.compress)
    return {
        "lines": lines,
        "grid": scene.grid,
        "beam": scene.image.get("beam"),
        "tolerance_db": scene.image.get("tolerance_db", -50.0),
        "sonar": scene.sonar,
        "track": scene.track,
        "ends": False,
    }


def recorded_block() -> dict[str, Any]:
    """Return lines and grid of the ultrasonic recording."""
    path = recordings.folder() / ultrasound.RECORDING
    return {"lines": ultrasound.range_lines(path), "grid": ultrasound.GRID}


def recorded_car_park() -> dict[str, Any]:
    """Return lines and grid of the first degree of the radar recording."""
    path = recordings.folder() / radar.RECORDINGS[0]
    return {"lines": radar.range_lines(path), "grid": radar.GRID}


def car_park_in_full() -> dict[str, Any]:
    """Return the same lines and grid with velocities and a height map."""
    given = recorded_car_park()
    lines, grid = given["lines"], given["grid"]
    course = np.gradient(lines.tx_m, axis=0)
    velocity = AIRCRAFT_M_S * course / np.linalg.norm(course, axis=1, keepdims=True)
    heights_m = np.zeros(grid.shape)
    return {
        "lines": replace(lines, rx_velocity_m_s=velocity),
        "grid": grid.with_height(heights_m),
    }


def thesis_over_a_slope() -> dict[str, Any]:
    """Return the thesis's case 8 m above a seabed with a slope of 5 %, given as heights."""
    given = survey("thesis_wide_beam")
    x_m, y_m = given["grid"].axes_m
    heights_m = np.broadcast_to(-8.0 - 0.05 * (y_m[:, None] - 40.0), (len(y_m), len(x_m)))
    grid = given["grid"].with_height(np.ascontiguousarray(heights_m))
    scene = config.parse_scene(config.built_in_scene("thesis_wide_beam"), name="", folder=Path())
    return given | {"grid": grid, "lines": clsas.survey_lines(scene.sonar, scene.track, grid)}


CASES: dict[str, Callable[[], dict[str, Any]]] = {
    "thesis": lambda: survey("thesis_wide_beam", motion_in_flight=True),
    "wreck": lambda: survey("wreck", motion_in_flight=True),
    "ultrasound": recorded_block,
    "radar": recorded_car_park,
    "radar-in-full": car_park_in_full,
    "thesis-slope": thesis_over_a_slope,
}


FULL, SIMPLE = "full model", "simplified"
SCATTER = 0.2  # share of an image's time that is not counted as the cost of an effect


@dataclass(frozen=True)
class Found:
    """What was found out about a case.

    Attributes
    ----------
    title : str
        Name and tolerance.
    assessment : Assessment
    exact_seconds : dict of str to float
        Shortest time of the exact image with all effects and as imagers form it, by `FULL` and
        `SIMPLE`.
    """

    title: str
    assessment: Assessment
    exact_seconds: dict[str, float]


def time_exact(given: dict[str, Any], device: Device, repeats: int) -> dict[str, float]:
    """Return the shortest times of exact images, which are formed in turns."""
    seconds: dict[str, list[float]] = {FULL: [], SIMPLE: []}
    for turn in range(repeats + 1):
        for model, times in seconds.items():
            start = time.perf_counter()
            preparation = prepare(
                given["lines"],
                given["grid"],
                beam=given.get("beam"),
                device=device,
                accuracy_db=given.get("tolerance_db", -50.0),
                full_model=model == FULL,
            )
            execute(preparation)
            if turn:  # the first turn builds kernels
                times.append(time.perf_counter() - start)
    return {model: min(times) for model, times in seconds.items() if times}


def without(effect: Effect, image_seconds: float) -> str:
    """Return what an image without an effect would be."""
    if effect.error_db is None:
        return "unknown"
    if effect.error_db < NONE_DB:
        return "none"
    parts = [f"{effect.error_db:+.1f} dB"]
    if effect.most_wavelengths:
        parts.append(f"{effect.most_wavelengths:.2g} λ")
    if effect.needed:
        parts.append("**needed**")
    if effect.left_out:
        parts.append("left out")
    if effect.seconds is not None and abs(effect.seconds) > SCATTER * image_seconds:
        parts.append(f"{effect.seconds:+.2g} s")
    return ", ".join(parts)


def effects_table(cases: list[Found]) -> tuple[list[str], list[list[str]]]:
    """Return header and rows of the table of effects."""
    names = [effect.name for effect in cases[0].assessment.effects]
    rows = [
        [name, *(without(case.assessment[name], case.assessment.seconds) for case in cases)]
        for name in names
    ]
    return ["without", *(case.title for case in cases)], rows


def times_table(cases: list[Found]) -> tuple[list[str], list[list[str]]]:
    """Return header and rows of the table of times."""
    header = ["image", "neglected", f"{FULL} (s)", f"{SIMPLE} (s)"]
    rows = []
    for case in cases:
        left_out = [effect.name for effect in case.assessment.effects if effect.left_out]
        fast = {FULL: case.assessment.seconds, SIMPLE: case.assessment.simple_seconds}
        for method, seconds in {"planned": fast, "exact": case.exact_seconds}.items():
            rows.append(
                [
                    f"{case.title}, {method}",
                    ", ".join(left_out),
                    f"{seconds[FULL]:.3g}",
                    f"{seconds[SIMPLE]:.3g}" if left_out else "",
                ]
            )
    return header, rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("case", nargs="*", help=f"case: {', '.join(CASES)} (default: all)")
    parser.add_argument("--device", help="part of an OpenCL device's name, or its index")
    parser.add_argument(
        "--repeats", type=int, default=5, help="number of images of each kind (default: 5)"
    )
    parser.add_argument("--tolerance-db", type=float, help="tolerance instead of that of each case")
    parser.add_argument(
        "--docs", action="store_true", help="write the tables of the documentation, too"
    )
    arguments = parser.parse_args()
    unknown = set(arguments.case) - set(CASES)
    if unknown:
        parser.error(f"there is no case {unknown.pop()!r}; cases are {', '.join(CASES)}")
    device = open_device(arguments.device)
    cases = []
    for name in arguments.case or CASES:
        given = CASES[name]()
        if arguments.tolerance_db is not None:
            given["tolerance_db"] = arguments.tolerance_db
        assessment = clsas.assess(**given, device=device.info.index, repeats=arguments.repeats)
        title = f"{name}, {assessment.tolerance_db:g} dB"
        cases.append(Found(title, assessment, time_exact(given, device, max(arguments.repeats, 1))))
    origin = stored_tables.here(
        f"{device.info.name}, {device.info.compute_units} compute units",
        f"{device.info.platform} {device.info.driver}",
        "scripts/real/effects.py",
    )
    for stem, (header, rows) in {
        "effects": effects_table(cases),
        "times": times_table(cases),
    }.items():
        print(stored_tables.markdown(stored_tables.StoredTable(origin, header, rows), stem))
        if arguments.docs:
            path = stored_tables.TABLES / "assess" / f"{stem}.csv"
            stored_tables.write(path, origin, header, rows)


if __name__ == "__main__":
    main()
