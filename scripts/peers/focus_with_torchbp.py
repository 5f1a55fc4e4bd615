"""Autofocus by torchbp for `scripts/bench peers --autofocus`, run in an environment with torchbp.

The frame is that of torchbp: x is the look direction, y is along-track, and the origin is the
middle of the track. Images of sonars have a polar grid, on which torchbp accounts for the pattern
of the elements. Images of a radar pass have a Cartesian grid.
"""

import sys
import time

import numpy as np
import torch
from protocol import serve
from torchbp import autofocus, ops

LIGHT_M_S = 299_792_458.0
SCENE = dict(np.load(sys.argv[1]))
UPSAMPLING = 8  # since torchbp interpolates lines linearly
POSITIONS_M = torch.from_numpy(SCENE["frame_m"].astype(np.float32))
GRID = {name: tuple(SCENE[name]) for name in ("r", "theta", "x", "y") if name in SCENE}
GRID |= {name: int(SCENE[name]) for name in ("nr", "ntheta", "nx", "ny") if name in SCENE}
COMMON = {
    "img": None,
    "pos": POSITIONS_M,
    "fc": float(SCENE["centre_hz"]),
    "r_res": float(SCENE["range_step_m"]) / UPSAMPLING,
    "grid": GRID,
    "d0": -float(SCENE["begin_m"]),
}


def lines() -> torch.Tensor:
    """Return upsampled lines."""
    spectrum = np.fft.fftshift(np.fft.fft(SCENE["profiles"]), axes=1)
    count = spectrum.shape[1]
    filled = np.zeros((len(spectrum), UPSAMPLING * count), np.complex64)
    first = (UPSAMPLING * count) // 2 - count // 2
    filled[:, first : first + count] = spectrum
    return torch.from_numpy(np.fft.ifft(np.fft.ifftshift(filled, axes=1)).astype(np.complex64))


def pattern() -> dict:
    """Return the two-way pattern of the elements, sinc^2, or nothing if there are no elements."""
    if "element_wavelengths" not in SCENE:
        return {}
    widest = np.pi / 6
    azimuth = np.linspace(-widest, widest, 512, endpoint=False)
    gain = np.sinc(float(SCENE["element_wavelengths"]) * np.sin(azimuth)) ** 2
    return {
        "g": torch.from_numpy(np.tile(gain.astype(np.float32), (8, 1))),
        "g_extent": [-widest, -widest, widest, widest],
        "att": torch.zeros_like(POSITIONS_M),
    }


def answer(former: str, image_file: str, **settings: float | str) -> dict:
    """Write the displacement of every position in the frame, and return the seconds taken."""
    start = time.perf_counter()
    with torch.inference_mode():
        data = lines()
        if former == "image":
            form = ops.backprojection_cart_2d if "x" in GRID else ops.backprojection_polar_2d
            options = {name: value for name, value in COMMON.items() if name != "img"}
            moved = form(data, **options, **pattern())
        elif former == "gpga":
            _, phase = autofocus.gpga(data=data, **COMMON, **pattern(), **settings)
            distance_m = phase * LIGHT_M_S / (4 * np.pi * COMMON["fc"])
            moved = torch.zeros_like(POSITIONS_M)
            moved[:, 0] = distance_m
        else:
            _, found = autofocus.gpga_tde(data=data, **COMMON, **pattern(), **settings)
            moved = found - POSITIONS_M
    seconds = time.perf_counter() - start
    np.save(image_file, moved.numpy())
    return {"planning": 0.0, "seconds": seconds}


serve(answer)
