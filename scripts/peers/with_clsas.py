"""Images by clsas for `scripts/bench peers`, in a separate process like the other codes.

The plan of a factorized image is made once for each setting, and its time is reported separately.
"""

import sys
import time
from functools import cache

import numpy as np
from protocol import serve

import clsas

SCENE = dict(np.load(sys.argv[1]))
LINES = clsas.RangeLines(
    SCENE["samples"],
    SCENE["first_range_m"],
    float(SCENE["range_step_m"]),
    SCENE["positions_m"],
    SCENE["positions_m"],
    float(SCENE["carrier_hz"]),
    float(SCENE["sound_speed_m_s"]),
)
(COLUMNS, ROWS), CORNER_M = SCENE["pixels"].tolist(), SCENE["corner_m"]
GRID = clsas.Grid.plane(
    *(
        (first_m, first_m + (count - 1) * step_m, count)
        for first_m, step_m, count in zip(CORNER_M, SCENE["step_m"], (COLUMNS, ROWS), strict=False)
    ),
    CORNER_M[2],
)


@cache
def planned(tolerance_db: float, device: str) -> tuple[clsas.Plan, float]:
    """Return a plan and the seconds that planning took."""
    start = time.perf_counter()
    plan = clsas.plan(LINES, GRID, tolerance_db=tolerance_db, device=device)
    return plan, time.perf_counter() - start


def answer(
    image_file: str,
    device: str,
    accuracy_db: float | None = None,
    tolerance_db: float | None = None,
) -> dict:
    """Form an exact or factorized image; return the seconds of planning and of imaging."""
    plan, planning = (None, 0.0) if tolerance_db is None else planned(tolerance_db, device)
    start = time.perf_counter()
    if plan is None:
        image = clsas.backproject(LINES, GRID, accuracy_db=accuracy_db, device=device)
    else:
        image = clsas.factorize(LINES, GRID, plan, device=device)
    seconds = time.perf_counter() - start
    np.save(image_file, image.pixels)
    return {"planning": planning, "seconds": seconds}


serve(answer)
