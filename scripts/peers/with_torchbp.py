"""Images by torchbp for `scripts/bench peers`, run in an environment with torchbp.

In torchbp x is ground range and y is along-track, so both are exchanged here. torchbp interpolates
range lines linearly and leaves their oversampling to the caller; it is done here, and its time is
included. There is no planning.
"""

import os
import sys
import time
import warnings

import numpy as np
import torch
import torchbp
from protocol import serve

warnings.simplefilter("ignore")  # about guard bands; the table has the true errors
torch.set_num_threads(len(os.sched_getaffinity(0)))
LIGHT_M_S = 299_792_458.0
SCENE = dict(np.load(sys.argv[1]))
(COLUMNS, ROWS), (STEP_X, STEP_Y) = SCENE["pixels"].tolist(), SCENE["step_m"].tolist()
CENTRE_HZ, BEGIN_M = float(SCENE["centre_hz"]), float(SCENE["begin_m"])
RANGE_STEP_M = float(SCENE["range_step_m"])
BAND_HZ = float(np.diff(SCENE["band_hz"])[0])
PROFILES = torch.from_numpy(SCENE["profiles"])
# The origin is the middle of the track, as the polar grids of torchbp require.
MIDDLE_M = SCENE["positions_m"].mean(axis=0) * [1, 1, 0]
POSITIONS_M = torch.from_numpy((SCENE["positions_m"] - MIDDLE_M)[:, [1, 0, 2]].astype(np.float32))
LEFT_M, NEAR_M, _ = SCENE["corner_m"] - MIDDLE_M
CARTESIAN = {
    "x": (NEAR_M, NEAR_M + ROWS * STEP_Y),
    "y": (LEFT_M, LEFT_M + COLUMNS * STEP_X),
    "nx": ROWS,
    "ny": COLUMNS,
}


def upsampled(factor: int) -> dict:
    """Return arguments of every former, with lines upsampled by a factor."""
    spectrum = torch.fft.fft(PROFILES, dim=-1)
    count = spectrum.shape[1]
    half = (count + 1) // 2
    filled = torch.zeros((len(spectrum), factor * count), dtype=torch.complex64)
    filled[:, :half] = spectrum[:, :half]
    filled[:, half - count :] = spectrum[:, half:]
    return {
        "data": torch.fft.ifft(filled, dim=-1) * factor,
        "fc": CENTRE_HZ,
        "r_res": RANGE_STEP_M / factor,
        "pos": POSITIONS_M,
        "d0": -BEGIN_M,
    }


def polar_grid(oversampling: float, lanczos: int) -> dict:
    """Return the polar grid of the image, with a margin for its interpolation."""
    across_m = np.array([NEAR_M, NEAR_M + (ROWS - 1) * STEP_Y])
    along_m = np.array([LEFT_M, LEFT_M + (COLUMNS - 1) * STEP_X])
    if across_m[0] <= 0:
        raise ValueError("polar grids of torchbp cover only one side of the track")
    x_m, y_m = np.meshgrid(across_m, np.append(along_m, np.clip(0, *along_m)))
    range_m = np.hypot(x_m, y_m)
    sine = y_m / range_m
    aperture_m = float(np.ptp(POSITIONS_M.numpy(), axis=0).max())
    range_step_m = LIGHT_M_S / (2 * BAND_HZ * oversampling)
    sine_step = LIGHT_M_S / (CENTRE_HZ + BAND_HZ / 2) / (2 * aperture_m * oversampling)
    margin = 2 * lanczos
    first_m, least = range_m.min() - margin * range_step_m, sine.min() - margin * sine_step
    ranges = int((range_m.max() - first_m) / range_step_m) + margin
    sines = int((sine.max() - least) / sine_step) + margin
    return {
        "r": (first_m, first_m + ranges * range_step_m),
        "theta": (least, least + sines * sine_step),
        "nr": ranges,
        "ntheta": sines,
    }


def exact(upsampling: int) -> torch.Tensor:
    """Return the exact image, to which every channel contributes in every pixel."""
    return torchbp.ops.backprojection_cart_2d(grid=CARTESIAN, **upsampled(upsampling))


def cfbp(upsampling: int, **settings: float) -> torch.Tensor:
    """Return an image factorized on Cartesian grids."""
    return torchbp.ops.cfbp(grid=CARTESIAN, **upsampled(upsampling), **settings)


def cfbp_adaptive(upsampling: int, **settings: float) -> torch.Tensor:
    """Return an image factorized on Cartesian grids that are finer at near range."""
    data_oversample = upsampling / (RANGE_STEP_M * 2 * BAND_HZ / LIGHT_M_S)
    return torchbp.ops.cfbp_adaptive(
        grid=CARTESIAN, data_oversample=data_oversample, **upsampled(upsampling), **settings
    )


def polar(former: str, upsampling: int, grid: float, lanczos: int, **settings) -> torch.Tensor:
    """Return an image formed on a polar grid and interpolated from there."""
    image_grid = polar_grid(grid, lanczos)
    image = getattr(torchbp.ops, former)(
        grid=image_grid, dealias=True, alias_fmod=0.0, **upsampled(upsampling), **settings
    )
    return torchbp.ops.polar_to_cart(
        image, torch.zeros(3), image_grid, CARTESIAN, CENTRE_HZ, method=("lanczos", lanczos)
    )


FORMERS = {"exact": exact, "cfbp": cfbp, "cfbp_adaptive": cfbp_adaptive}


def answer(former: str, image_file: str, **settings: float) -> dict:
    """Form an image; return the seconds that it took."""
    start = time.perf_counter()
    with torch.inference_mode():
        image = FORMERS[former](**settings) if former in FORMERS else polar(former, **settings)
    seconds = time.perf_counter() - start
    np.save(image_file, image.reshape(ROWS, COLUMNS).numpy())
    return {"planning": 0.0, "seconds": seconds}


serve(answer)
