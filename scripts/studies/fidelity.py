"""Phase errors of interferograms of factorized images, beside those of their pixels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.ndimage import uniform_filter

import clsas
from clsas.measures.elevation import phase_per_height
from clsas.selftest import wreck

COLUMNS = (
    "scene",
    "tolerance dB",
    "error of the images dB",
    "correlation of both",
    "phase error mrad",
    "99.9 % below mrad",
    "mean mrad",
    "phase error / image error",
    "1/sqrt(looks)",
    "height error mm",
)
TOLERANCES_DB = (-30, -40, -50, -60)
REFERENCE_DB = -85.0
WINDOW = 9  # pixels along each side of a window
COHERENT = 0.7  # least coherence of the windows that count

_SPEED_M_S, _CARRIER_HZ, _BAND_HZ = 1500.0, 100e3, 30e3
_ALTITUDE_M, _BASELINE_M = 12.0, 0.25


@dataclass(frozen=True, eq=False)
class Case:
    """Lines of two banks, and the image that is formed of each.

    Attributes
    ----------
    lines : RangeLines
        Lines of two banks.
    grid : Grid
    beam : BeamWindow
    """

    lines: clsas.RangeLines
    grid: clsas.Grid
    beam: clsas.BeamWindow

    @cached_property
    def turn_rad_m(self) -> float:
        """Phase between the banks per metre of height, in the middle of the grid."""
        middle_m = self.grid.positions_m().reshape(-1, 3).mean(axis=0)
        low, high = (self.lines.bank(number) for number in range(2))
        tx_m, low_m, high_m = (
            each.mean(axis=0, keepdims=True) for each in (low.tx_m, low.rx_m, high.rx_m)
        )
        wavelength_m = 2 * np.pi / self.lines.wavenumber_rad_m
        return abs(float(phase_per_height(middle_m[None], tx_m, low_m, high_m, wavelength_m)[0]))

    def images(self, tolerance_db: float | None, device: str) -> list[np.ndarray]:
        """Return the pixels of both banks; exact ones if there is no tolerance."""
        found = []
        for number in range(2):
            lines = self.lines.bank(number)
            if tolerance_db is None:
                image = clsas.backproject(
                    lines, self.grid, accuracy_db=REFERENCE_DB, beam=self.beam, device=device
                )
            else:
                image = clsas.factorize(
                    lines, self.grid, tolerance_db, beam=self.beam, device=device
                )
            found.append(image.pixels)
        return found


def interferogram(pixels: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean product of both images in windows, and their coherence."""
    one, other = (each.astype(np.complex128) for each in pixels)
    product = one * other.conj()
    mean = uniform_filter(product.real, WINDOW) + 1j * uniform_filter(product.imag, WINDOW)
    powers = [uniform_filter(np.abs(each) ** 2, WINDOW) for each in (one, other)]
    return mean, np.abs(mean) / np.sqrt(np.maximum(powers[0] * powers[1], 1e-300))


def correlation(images: list[np.ndarray], exact: list[np.ndarray]) -> float:
    """Return the correlation of the errors of both images, relative to the phases of the pixels."""
    one, other = (
        (image - ideal) * np.exp(-1j * np.angle(ideal))
        for image, ideal in zip(images, exact, strict=True)
    )
    return float(np.vdot(one, other).real / (np.linalg.norm(one) * np.linalg.norm(other)))


def looks(pixels: np.ndarray) -> float:
    """Return the number of independent looks in a window, from the correlation of the pixels."""
    power = np.abs(np.fft.fft2(pixels, [2 * n for n in pixels.shape])) ** 2
    correlation = np.fft.ifft2(power)
    lags = np.arange(-WINDOW + 1, WINDOW)
    correlation = np.abs(correlation[np.ix_(lags, lags)] / correlation[0, 0]) ** 2
    pairs = WINDOW - np.abs(lags)
    return WINDOW**4 / float(pairs @ correlation @ pairs)


def speckle() -> Case:
    """Return two banks over speckle on a relief of about +-0.4 m, 30 to 35 m away."""
    random, count = np.random.default_rng(12), 100_000
    xyz_m = random.uniform([-3, 28, 0], [3, 34.5, 0], (count, 3))
    xyz_m[:, 2] = 0.25 * np.sin(xyz_m[:, 0] * 2) + 0.15 * np.cos(1.5 * xyz_m[:, 1] + xyz_m[:, 0])
    scatterers = clsas.PointTargets(xyz_m, random.standard_normal((count, 2)) @ [1, 1j])
    tx_m = np.zeros((2 * 400, 3))
    tx_m[:, 0] = np.repeat(np.linspace(-5, 5, 400), 2)
    tx_m[:, 2] = _ALTITUDE_M
    banks = np.tile([0, 1], 400)
    rx_m = tx_m + np.multiply.outer(banks - 0.5, [0, 0, _BASELINE_M])
    lines = clsas.simulate_lines(
        tx_m, rx_m, scatterers, carrier_hz=_CARRIER_HZ, bandwidth_hz=_BAND_HZ, window="hamming",
        sound_speed_m_s=_SPEED_M_S, first_range_m=29.5, length=680,
    )  # fmt: skip
    grid = clsas.Grid.plane((-2, 2, 201), (28.5, 34, 276))
    lines = clsas.RangeLines(**vars(lines) | {"bank_numbers": banks})
    return Case(lines, grid, clsas.BeamWindow(18.0, "hann"))


def sunken() -> Case:
    """Return the built-in scene of a wreck and two banks."""
    scene = wreck.scene("wreck_two_banks")
    (grid,) = scene.need("grid")
    return Case(wreck.lines(name="wreck_two_banks"), grid, scene.image["beam"])


SCENES = {"speckle on a relief": speckle, "wreck": sunken}


def rows(device: str, scenes: tuple[str, ...] = tuple(SCENES)) -> Iterator[list[str]]:
    """Yield a row for every scene and tolerance."""
    for name in scenes:
        case = SCENES[name]()
        exact = case.images(None, device)
        product, coherence = interferogram(exact)
        coherent, share = coherence >= COHERENT, 1 / np.sqrt(looks(exact[0]))
        for tolerance_db in TOLERANCES_DB:
            images = case.images(tolerance_db, device)
            errors = [
                np.linalg.norm(image - ideal) / np.linalg.norm(ideal)
                for image, ideal in zip(images, exact, strict=True)
            ]
            error = float(np.sqrt(np.mean(np.square(errors))))
            phase = np.angle(interferogram(images)[0] * product.conj())[coherent]
            deviation = float(np.std(phase))
            yield [
                name,
                f"{tolerance_db}",
                f"{20 * np.log10(error):.1f}",
                f"{correlation(images, exact):.2f}",
                f"{1e3 * deviation:.3g}",
                f"{1e3 * np.quantile(np.abs(phase), 0.999):.3g}",
                f"{1e3 * np.mean(phase):.2g}",
                f"{deviation / error:.2f}",
                f"{share:.2f}",
                f"{1e3 * deviation / case.turn_rad_m:.2g}",
            ]
