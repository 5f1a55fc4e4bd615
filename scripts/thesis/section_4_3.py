#!/usr/bin/env python3
"""THESIS 4.3: what one error by [45] costs from far to near, where the thesis lowers its limit.

If the smallest range is not much larger than a subaperture, the thesis allows a phase error of pi/8
instead of pi. Here an image begins 100 mm from the channels, and one stage of QR x QI sums them to
subapertures of 12 mm to 96 mm. The error by [45] is the same for the same QR/QI.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import chapter5
import numpy as np
from chapter5 import ACCURACY_DB, WAVELENGTH_M, decibels
from range_errors import range_errors_m

import clsas
from clsas.engine.device.device import Device
from clsas.engine.factorized.virtual_channels import stage_errors_m

CHANNELS, SPACING_M = 1024, WAVELENGTH_M / 4
NEAREST_M, SIDE_M, PIXELS = 0.1, 12.8e-3, 1024
LEAST_PIXELS = 16  # along a side of the smallest subimages
POINTS = 300
RATIOS = (32, 16, 8, 4)  # QR/QI, for errors by [45] of about a fourth to a 32nd of the wavelength
BEAMS = (32, 64, 128, 256)  # QR


@dataclass(frozen=True)
class NearScene:
    """Points of random phase beside a line of omnidirectional channels, seen from all of them."""

    device: Device
    pixels: int = PIXELS

    @property
    def side_m(self) -> float:
        """Side of the image, metres."""
        return SIDE_M * self.pixels / PIXELS

    @cached_property
    def grid(self) -> clsas.Grid:
        """Grid of the image."""
        return chapter5.square(self.side_m, self.pixels, NEAREST_M)

    def lines(self, positions_m: np.ndarray, amplitudes: np.ndarray) -> clsas.RangeLines:
        """Return the lines of some points."""
        channels_m = np.zeros((CHANNELS, 3))
        channels_m[:, 0] = (np.arange(CHANNELS) - (CHANNELS - 1) / 2) * SPACING_M
        return clsas.simulate_lines(
            channels_m, channels_m, clsas.PointTargets(positions_m, amplitudes),
            carrier_hz=1500 / WAVELENGTH_M, bandwidth_hz=100e3, window="hamming",
        )  # fmt: skip

    @cached_property
    def middle(self) -> clsas.RangeLines:
        """Lines of one point in the middle, where subimages meet."""
        return self.lines(np.array([[0.0, NEAREST_M + self.side_m / 2, 0.0]]), np.ones(1))

    @cached_property
    def scattered(self) -> clsas.RangeLines:
        """Lines of many points all over the image."""
        random = np.random.default_rng(1)
        away_m = random.uniform(-0.5, 0.5, (POINTS, 2)) * self.side_m
        positions_m = np.pad(away_m, ((0, 0), (0, 1))) + [0, NEAREST_M + self.side_m / 2, 0]
        return self.lines(positions_m, np.exp(2j * np.pi * random.uniform(size=POINTS)))

    def exact(self, lines: clsas.RangeLines) -> clsas.Image:
        """Return the exact image."""
        return clsas.backproject(lines, self.grid, accuracy_db=ACCURACY_DB, device=self.device)

    def factorized(self, lines: clsas.RangeLines, stages: chapter5.Stages) -> clsas.Image:
        """Return the image of nearest beams."""
        plan = clsas.plan(lines, self.grid, stages=stages, device=self.device)
        return clsas.factorize(lines, self.grid, plan, device=self.device)

    def range_errors_m(self, stages: chapter5.Stages) -> np.ndarray:
        """Return range errors, metres [pixels, channels]."""
        plan = clsas.plan(self.middle, self.grid, stages=stages, device=self.device)
        ends = [0, self.pixels // 2 - 1, self.pixels // 2, self.pixels - 1]
        pixels = np.random.default_rng(1).integers(0, self.pixels, (1000, 2))
        pixels = np.concatenate([pixels, list(product(ends, ends))])
        return range_errors_m(plan, self.middle, self.grid, pixels)


def loss_db(image: clsas.Image, exact: clsas.Image) -> float:
    """Return how much weaker the point in the middle is than in the exact image, dB."""
    rows, columns = (slice(count // 2 - 4, count // 2 + 4) for count in image.grid.shape)
    peaks = [float(np.abs(each.pixels[rows, columns]).max()) for each in (exact, image)]
    return float(decibels(np.array(peaks[0]), peaks[1]))


def main() -> None:
    given, thesis = chapter5.arguments(__doc__)
    scene = NearScene(thesis.device, min(given.pixels, PIXELS))
    exact = {lines: scene.exact(lines) for lines in (scene.middle, scene.scattered)}
    rows = []
    for ratio in RATIOS:
        for beams in BEAMS:
            stages = [(beams, beams // ratio)]
            if not 2 <= beams // ratio <= scene.pixels // LEAST_PIXELS:
                continue
            sum_m = beams * SPACING_M
            formula_m = sum(stage_errors_m(stages, SPACING_M, scene.side_m, NEAREST_M))
            errors_m = scene.range_errors_m(stages)
            largest_m = float(np.abs(errors_m).max())
            rms_m = math.sqrt(np.mean(errors_m**2))
            images = {lines: scene.factorized(lines, stages) for lines in exact}
            error_db = clsas.relative_error_db(images[scene.scattered], exact[scene.scattered])
            rows.append(
                {
                    "eq. 45": chapter5.fraction(formula_m),
                    "phase, π": f"{4 * formula_m / WAVELENGTH_M:.3f}",
                    "QR x QI": chapter5.name(stages),
                    "subaperture mm": f"{1e3 * sum_m:.2f}",
                    "Rmin/subaperture": f"{NEAREST_M / sum_m:.1f}",
                    "measured": chapter5.fraction(largest_m),
                    "measured/eq. 45": f"{largest_m / formula_m:.2f}",
                    "rms/eq. 45": f"{rms_m / formula_m:.2f}",
                    "loss dB": f"{loss_db(images[scene.middle], exact[scene.middle]):.2f}",
                    "scene error dB": f"{error_db:.1f}",
                }
            )
    chapter5.report(given.out, "section_4_3", rows)
    figure = chapter5.figure()
    axes = figure.subplots()
    for phase in dict.fromkeys(row["phase, π"] for row in rows):
        same = [row for row in rows if row["phase, π"] == phase]
        ratios, errors = (
            [float(row[column]) for row in same]
            for column in ("Rmin/subaperture", "scene error dB")
        )
        axes.semilogx(ratios, errors, "o-", label=f"{same[0]['eq. 45']} by [45]")
    axes.set(xlabel="Smallest range over subaperture", ylabel="Error of 300 points (dB)")
    axes.set_xticks((1, 2, 4, 8), ("1", "2", "4", "8"))
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    axes.legend()
    chapter5.save(figure, given.out, "section_4_3")


if __name__ == "__main__":
    main()
