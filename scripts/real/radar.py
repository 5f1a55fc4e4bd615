"""Image airborne X-band radar recordings (GOTCHA): a car park on the plane z = 0.

Every file contains one degree of a circle of 7 km radius, flown 7 km above the scene. The images of
all files are added coherently.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from recordings import parse_arguments

import clsas
from clsas import plot
from clsas.measures.quality import PointResponse

RECORDINGS = [f"gotcha/data_3dsar_pass1_az{degree:03}_HH.mat" for degree in (1, 2, 3)]
GRID = clsas.Grid.plane(x=(-50.0, 50.0, 1001), y=(-50.0, 50.0, 1001))


def range_lines(path: Path) -> clsas.RangeLines:
    """Return range lines of a recording, with a Hamming window over frequency.

    The lines cover one period of range, c/(2 df), centred on the range to which a pulse is
    referenced. Their outermost metre fades out, since sharp ends would cause an interpolation error
    of -65 dB along the whole line.
    """
    return clsas.read_phase_history(path, window="hamming").tapered_ends(1.0)


def find_brightest(image: clsas.Image) -> PointResponse:
    """Return the response of the brightest point of the image."""
    x_m, y_m = image.grid.axes_m
    row, column = np.unravel_index(np.abs(image.pixels).argmax(), image.grid.shape)
    return clsas.measure_point(image, (x_m[column], y_m[row]), extent_m=10.0)


def report(name: str, image: clsas.Image, pulses: int, out: Path) -> PointResponse:
    """Print the properties of the brightest point, draw the image, and return the point."""
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
        lines = range_lines(path)
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
