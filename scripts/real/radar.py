"""Image airborne X-band radar recordings (GOTCHA): a car park on the plane z = 0.

Every file holds one degree of a circle of 7 km radius, flown 7 km above the scene. The images of
all files are added up coherently.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from recordings import parse_arguments
from scipy import fft
from scipy.constants import speed_of_light
from scipy.io import loadmat
from scipy.signal.windows import tukey

import clsas
from clsas import plot
from clsas.products.quality import PointResponse

RECORDINGS = [f"gotcha/data_3dsar_pass1_az{degree:03}_HH.mat" for degree in (1, 2, 3)]
GRID = clsas.Grid.plane(x=(-50.0, 50.0, 1001), y=(-50.0, 50.0, 1001))


@dataclass(frozen=True, eq=False)
class PhaseHistory:
    """What a stepped-frequency radar measured.

    Attributes
    ----------
    echo : complex64 [pulses, frequencies]
        A point of amplitude A at range R of the antenna gives A exp(-j 4 pi f (R - r0)/c).
    frequency_hz : float64 [frequencies]
        Equal steps.
    antenna_m : float64 [pulses, 3]
        Where the antenna was.
    reference_range_m : float64 [pulses]
        r0.
    """

    echo: NDArray[np.complex64]
    frequency_hz: NDArray[np.float64]
    antenna_m: NDArray[np.float64]
    reference_range_m: NDArray[np.float64]

    @property
    def weights(self) -> NDArray[np.float64]:
        """Hamming window over the frequencies, of sum 1."""
        window = np.hamming(len(self.frequency_hz))
        return window / window.sum()


def read_phase_history(path: Path) -> PhaseHistory:
    """Read a file of the GOTCHA volumetric data set.

    The range r0 that a pulse is referenced to is the antenna's distance from the origin, the
    scene's centre. The file holds it as float32, in steps of 1 mm, which are 0.4 rad of phase. It
    is computed from the positions instead: these are rounded too, but that moves the ranges of all
    points alike, and drops out of R - r0.

    Raises
    ------
    ValueError
        If r0 is something else, by more than rounding explains.
    """
    data = loadmat(path, simplify_cells=True)["data"]
    frequency_hz = data["freq"].astype(np.float64)
    antenna_m = np.stack([data[axis] for axis in "xyz"], axis=-1).astype(np.float64)
    reference_range_m = np.linalg.norm(antenna_m, axis=1)
    if np.abs(reference_range_m - data["r0"]).max() > 2e-3:
        raise ValueError(f"{path} must be referenced to the origin, but its r0 says otherwise")
    return PhaseHistory(
        echo=data["fp"].T,
        # The steps are equal; float32 rounds each frequency to 1 kHz.
        frequency_hz=np.linspace(frequency_hz[0], frequency_hz[-1], len(frequency_hz)),
        antenna_m=antenna_m,
        reference_range_m=reference_range_m,
    )


def range_lines(history: PhaseHistory) -> clsas.RangeLines:
    """Return the windowed inverse Fourier transform over frequency as range lines.

    With f = f_0 + m df the sum over m of exp(-j 4 pi f (R - r0)/c) exp(+j 4 pi m df (r - r0)/c) is

        p(r - R) exp(-j 4 pi f_0 (R - r0)/c),    p(d) = sum over m of exp(j 4 pi m df d/c),

    and range lines hold p(r - R) exp(-j 4 pi f_0 R/c): they lack the phase of r0, which is put on
    in float64. The lines are one period, c/(2 df), of range, centred on r0; twice as many samples
    as frequencies leave the imager's range interpolation some room. Their outermost metre fades
    out: a sharp end would be interpolated with an error of -65 dB all along the line.
    """
    frequency_hz, reference_range_m = history.frequency_hz, history.reference_range_m
    count = 2 * len(frequency_hz)
    step_m = speed_of_light / (2 * count * (frequency_hz[1] - frequency_hz[0]))
    spectrum = (history.echo * history.weights).astype(np.complex128)
    samples = fft.fftshift(count * fft.ifft(spectrum, count), axes=1)
    cycles = 2 * frequency_hz[0] / speed_of_light * reference_range_m
    samples *= np.exp(-2j * np.pi * (cycles - np.rint(cycles)))[:, None]
    samples *= tukey(count, 0.02)
    return clsas.RangeLines(
        samples,
        first_range_m=reference_range_m - count // 2 * step_m,
        range_step_m=step_m,
        tx_m=history.antenna_m,
        rx_m=history.antenna_m,
        carrier_hz=frequency_hz[0],
        sound_speed_m_s=speed_of_light,
    )


def find_brightest(image: clsas.Image) -> PointResponse:
    """Measure the brightest point of the image."""
    x_m, y_m = image.grid.axes_m
    row, column = np.unravel_index(np.abs(image.pixels).argmax(), image.grid.shape)
    return clsas.measure_point(image, (x_m[column], y_m[row]), extent_m=10.0)


def report(name: str, image: clsas.Image, pulses: int, out: Path) -> PointResponse:
    """Print what the brightest point is like, draw the image and return the point."""
    point = find_brightest(image)
    print(
        f"{name}: {pulses} pulses; brightest at x = {point.x_m:.2f} m, y = {point.y_m:.2f} m, "
        f"{20 * np.log10(point.amplitude / pulses):.1f} dB per pulse, "
        f"{point.azimuth.resolution_m:.2f} m by {point.range.resolution_m:.2f} m (-3 dB)"
    )
    figure = plot.image_db(image, dynamic_range_db=50, title=f"{name}, {pulses} pulses")
    plot.save_png(figure, out / f"{name}.png")
    return point


def main() -> None:
    arguments = parse_arguments(__doc__, RECORDINGS)
    total, pulses = None, 0
    for path in arguments.recording:
        lines = range_lines(read_phase_history(path))
        image = clsas.backproject(lines, GRID, device=arguments.device)
        report(path.stem, image, lines.channels, arguments.out)
        total = clsas.backproject(lines, GRID, device=arguments.device, accumulate=total)
        pulses += lines.channels
    point = report("radar_sum", total, pulses, arguments.out)
    figure = plot.cuts(point)
    for axes, name in zip(figure.axes, ("x (ground range)", "y (along track)"), strict=True):
        axes.set_xlabel(f"{name} from the peak (m)")
    plot.save_png(figure, arguments.out / "radar_sum_brightest.png")
    print(f"pictures: {arguments.out}")


if __name__ == "__main__":
    main()
