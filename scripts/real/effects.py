"""Print which effects the images of docs/assess.md need, and the time that each effect costs.

The thesis's case and the wreck are assessed as surveys, the two recordings as lines. The radar
recording is also assessed with two known effects that do not matter: the motion of the aircraft
during the flight of a pulse, and a height for every pixel, which is the same for all. The thesis's
case is also assessed over a sloping seabed.

    python scripts/real/effects.py [CASE ...] [--device NAME] [--repeats 5]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import radar
import recordings
import ultrasound

import clsas
from clsas.exact.backprojection import prepare
from clsas.exact.run import execute
from clsas.files import scene_files as config
from clsas.measures.assessment_result import Assessment
from clsas.opencl.device import open_device

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


def show(name: str, found: Assessment) -> None:
    """Print an assessment as a Markdown table."""
    print(
        f"\n**{name}**: {found.channels} channels, {' x '.join(map(str, found.pixels))} pixels, "
        f"tolerance {found.tolerance_db:g} dB; {1e3 * found.seconds:.0f} ms with all effects "
        f"modelled, {1e3 * found.simple_seconds:.0f} ms as imagers form it\n"
    )
    columns = ("effect", "modelled", "error", "wavelengths, at most", "needed", "time", "left out")
    print("| " + " | ".join(columns) + " |\n" + "|---" * len(columns) + "|")
    for e in found.effects:
        error = (
            "-" if e.error_db is None else f"{e.error_db:.1f} dB" if e.error_db > -250 else "none"
        )
        most = f"{e.most_wavelengths:.2g}" if e.most_wavelengths else "-"
        needed = {True: "yes", False: "no", None: "-"}[e.needed]
        seconds = "-" if e.seconds is None else f"{1e3 * e.seconds:+.0f} ms"
        cells = (e.name, "yes" if e.modelled else "no", error, most, needed, seconds)
        print("| " + " | ".join((*cells, "yes" if e.left_out else "")) + " |", flush=True)


def show_exact(given: dict[str, Any], device: str | None, repeats: int) -> None:
    """Print the times of the exact image with all effects and as imagers form it, in turns."""
    seconds: dict[bool, list[float]] = {True: [], False: []}
    opened = open_device(device)
    for turn in range(repeats + 1):
        for full_model, times in seconds.items():
            start = time.perf_counter()
            preparation = prepare(
                given["lines"],
                given["grid"],
                beam=given.get("beam"),
                device=opened,
                accuracy_db=given.get("tolerance_db", -50.0),
                full_model=full_model,
            )
            execute(preparation)
            if turn:
                times.append(time.perf_counter() - start)
    full, simple = (min(times) for times in seconds.values())
    left_out = ", ".join(preparation.left_out) or "nothing"
    print(f"\nExact: {full:.2f} s with all effects, {simple:.2f} s as formed (without {left_out})")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("case", nargs="*", help=f"case: {', '.join(CASES)} (default: all)")
    parser.add_argument("--device", help="part of an OpenCL device's name, or its index")
    parser.add_argument(
        "--repeats", type=int, default=5, help="number of images of each kind (default: 5)"
    )
    parser.add_argument("--tolerance-db", type=float, help="tolerance instead of that of each case")
    arguments = parser.parse_args()
    for name in arguments.case or CASES:
        if name not in CASES:
            parser.error(f"there is no case {name!r}; cases are {', '.join(CASES)}")
        given = CASES[name]()
        if arguments.tolerance_db is not None:
            given["tolerance_db"] = arguments.tolerance_db
        show(name, clsas.assess(**given, device=arguments.device, repeats=arguments.repeats))
        if arguments.repeats:
            show_exact(given, arguments.device, arguments.repeats)


if __name__ == "__main__":
    main()
