"""Images by FastSAR for `scripts/bench peers`, run in an environment with FastSAR.

Formers are set up once for each setting, and that time is reported separately, since FastSAR can
reuse the plan for a geometry. A mosaic is planned and formed in the same call, and FastSAR's timers
separate the two.
"""

import os
import sys
import time
import warnings
from collections.abc import Callable
from functools import cache

# Form one patch after the other, with timers. Otherwise planning would share the cores of imaging.
os.environ.update(FASTSAR_TIMING="1", FASTSAR_MOSAIC_PREFETCH="0")

import numpy as np
from fastsar import ExactFormer, ImageFormer, ffbp_cpu, patches
from protocol import serve

warnings.simplefilter("ignore")  # about predicted errors; the table has the true ones
ffbp_cpu.lib()  # compiles the kernels, which should not count as planning
SCENE = dict(np.load(sys.argv[1]))
(COLUMNS, ROWS), (STEP_X, STEP_Y) = SCENE["pixels"].tolist(), SCENE["step_m"].tolist()
CENTRE_M = SCENE["corner_m"] + [COLUMNS / 2 * STEP_X, ROWS / 2 * STEP_Y, 0.0]
FIRST_HZ, STEP_HZ = float(SCENE["first_hz"]), float(SCENE["step_hz"])
SAMPLES = SCENE["history"].shape[1]


@cache
def exact(interpolator: str, upsampling: int) -> tuple[Callable, float]:
    """Return a former of exact images and the seconds that its setup took."""
    start = time.perf_counter()
    former = ExactFormer(
        SCENE["positions_m"],
        FIRST_HZ,
        STEP_HZ,
        SAMPLES,
        COLUMNS,
        ROWS,
        STEP_X,
        STEP_Y,
        backend="cpu",
        window=False,
        interp=interpolator,
        upsample=upsampling,
        ref=SCENE["ref_m"],
        center=tuple(CENTRE_M),
    )
    return former, time.perf_counter() - start


@cache
def whole(target_db: float) -> tuple[Callable, float]:
    """Return a former of the whole image and the seconds that its setup took.

    FastSAR's rule chooses final tiles by the predicted error. If they are too large for the
    approximation of plane waves, it uses a finer grid.
    """
    start = time.perf_counter()
    positions_m = SCENE["positions_m"] - CENTRE_M
    highest_hz = FIRST_HZ + SAMPLES * STEP_HZ
    grid = COLUMNS, ROWS, STEP_X, STEP_Y
    tile, (finer_x, finer_y), _ = patches.tile_plan(
        positions_m, highest_hz, *grid, *np.eye(3)[:2], target_db
    )
    former = ImageFormer(
        positions_m,
        FIRST_HZ,
        STEP_HZ,
        SAMPLES,
        COLUMNS * finer_x,
        ROWS * finer_y,
        STEP_X / finer_x,
        STEP_Y / finer_y,
        backend="cpu",
        window=False,
        T=tile,
        ref=SCENE["ref_m"],
    )

    def form(history: np.ndarray) -> np.ndarray:
        return former(history)[::finer_x, ::finer_y]

    return form, time.perf_counter() - start


def mosaic(patch: int, target_db: float) -> tuple[np.ndarray, float, float]:
    """Return an image of patches, the seconds of planning, and the seconds of all the rest."""
    timers = patches._Timer.acc
    timers.clear()
    start = time.perf_counter()
    image = patches.form_mosaic(
        {
            "S": SCENE["history"],
            "fmin": FIRST_HZ,
            "df": STEP_HZ,
            "ref": SCENE["ref_m"],
            "band": tuple(SCENE["band_hz"]),
        },
        SCENE["positions_m"],
        SCENE["corner_m"],
        COLUMNS,
        ROWS,
        STEP_X,
        STEP_Y,
        patch=(patch, patch),
        backend="cpu",
        target_db=target_db,
    )
    seconds = time.perf_counter() - start
    planning = timers["form_mosaic: plan and former"]
    return image, planning, seconds - planning


def answer(former: str, image_file: str, **settings: float | str) -> dict:
    """Form an image; return the seconds of planning and of imaging."""
    if former == "mosaic":
        image, planning, seconds = mosaic(**settings)
    else:
        form, planning = {"exact": exact, "whole": whole}[former](**settings)
        start = time.perf_counter()
        image = form(SCENE["history"])
        seconds = time.perf_counter() - start
    np.save(image_file, image.T)
    return {"planning": planning, "seconds": seconds}


serve(answer)
