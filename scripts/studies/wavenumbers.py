"""Errors and times of wavenumber images beside exact ones."""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

import clsas

COLUMNS = ("image", "error dB", "wavenumber s", "exact s")
BEAMS = {
    "Hann, 5 degrees": clsas.BeamWindow(5, "hann"),
    "Hann, 8 degrees": clsas.BeamWindow(8, "hann"),
    "Hann, 16 degrees": clsas.BeamWindow(16, "hann"),
    "Tukey, 16 degrees": clsas.BeamWindow(16, "tukey"),
    "Hamming, 16 degrees": clsas.BeamWindow(16, "hamming"),
    "rectangular, 16 degrees": clsas.BeamWindow(16, "rectangular"),
}
SWAYS_M = (0.01, 0.05, 0.2)
SWAYING_BEAM = clsas.BeamWindow(8, "hann", along=np.array([1.0, 0, 0]))
_RUNS = 3  # runs in turn, of which the fastest counts


@dataclass(frozen=True)
class Scene:
    """A track of 80 m at 125 kHz, and 512 x 512 pixels from points on them.

    Attributes
    ----------
    sway_m, altitude_m : float
        Amplitude of the sway, and height of the track over the pixels.
    near_m, far_m : float
        Swath.
    pixels : int
        Number along each side.
    """

    sway_m: float = 0.0
    altitude_m: float = 0.0
    near_m: float = 55.0
    far_m: float = 75.0
    pixels: int = 512

    def lines_and_grid(self) -> tuple[clsas.RangeLines, clsas.Grid]:
        """Return the lines, and a grid of 4 cm along the track."""
        x = np.arange(800) * 0.1 - 40
        y = self.sway_m * np.sin(2 * np.pi * x / 12)
        track_m = np.stack([x, y, self.altitude_m + 0 * x], axis=1)
        right_m = -10 + 0.04 * (self.pixels - 1)
        grid = clsas.Grid.plane((-10, right_m, self.pixels), (self.near_m, self.far_m, self.pixels))
        random = np.random.default_rng(0)
        low, high = [-12, self.near_m - 2, 0], [12, self.far_m + 2, 0]
        points = clsas.PointTargets(
            random.uniform(low, high, (300, 3)), random.normal(size=(300, 2)) @ [1, 1j]
        )
        lines = clsas.simulate_lines(
            track_m,
            track_m,
            points,
            carrier_hz=125e3,
            bandwidth_hz=15e3,
            window="hamming",
        )
        return lines, grid


def rows(device: str | None = None, pixels: int = 512) -> Iterator[list[str]]:
    """Yield a row for every beam, and for every sway of two swaths."""
    for name, beam in BEAMS.items():
        yield [name, *compared(Scene(pixels=pixels), beam, device)]
    for sway_m in SWAYS_M:
        cells = compared(Scene(sway_m, pixels=pixels), SWAYING_BEAM, device)
        yield [f"sway of {100 * sway_m:g} cm; Hann, 8 degrees, from 55 to 75 m", *cells]
    for sway_m in SWAYS_M:
        scene = Scene(sway_m, altitude_m=15.0, near_m=20.0, pixels=pixels)
        cells = compared(scene, SWAYING_BEAM, device)
        yield [f"sway of {100 * sway_m:g} cm, from 20 to 75 m, 15 m below the track", *cells]


def compared(scene: Scene, beam: clsas.BeamWindow, device: str | None) -> list[str]:
    """Return the error of the wavenumber image, and the least times of both images."""
    lines, grid = scene.lines_and_grid()
    forms = {
        "wavenumber": lambda: clsas.wavenumber(lines, grid, beam=beam),
        "exact": lambda: clsas.backproject(lines, grid, beam=beam, device=device),
    }
    images: dict[str, clsas.Image] = {}
    taken: dict[str, list[float]] = {name: [] for name in forms}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", clsas.ClsasWarning)
        for _ in range(_RUNS):
            for name, form in forms.items():
                start = time.perf_counter()
                images[name] = form()
                taken[name].append(time.perf_counter() - start)
    error_db = clsas.relative_error_db(images["wavenumber"], images["exact"])
    return [f"{error_db:.1f}", *(f"{min(each):.2f}" for each in taken.values())]
