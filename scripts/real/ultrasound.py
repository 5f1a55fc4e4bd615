"""Image an ultrasonic full-matrix capture of a notched aluminium block.

The elements of a linear array transmitted in turn, and all others received. The recording is
bistatic and consists of real samples, which still have their carrier.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from recordings import parse_arguments

import clsas
from clsas import plot
from clsas.measures.quality import PointResponse

RECORDING = "fmc_aluminium/contact_notch_aluminium.mat"
SOUND_SPEED_M_S = 6320.0  # longitudinal waves in aluminium

# Section below the array, which lies along x at the depth y = 0.
GRID = clsas.Grid.plane(x=(-20e-3, 20e-3, 401), y=(2e-3, 45e-3, 431))


def range_lines(path: Path) -> clsas.RangeLines:
    """Return range lines of a recording: its analytic signals after mixing down.

    The pulse is unknown, but short enough that no compression is needed. Its spectrum lies between
    0 and twice the frequency of the array. The window is zero at both ends of this band. It
    therefore removes a constant offset of the samples, and neither transmission nor back wall
    rings.
    """
    return clsas.read_full_matrix(path, sound_speed_m_s=SOUND_SPEED_M_S)


def find_notch_tip(image: clsas.Image) -> PointResponse:
    """Return the response of the brightest point that is 10 mm or more from both faces."""
    x_m, depth_m = image.grid.axes_m
    inside = (depth_m > 10e-3) & (depth_m < 30e-3)
    amplitude = np.where(inside[:, None], np.abs(image.pixels), 0)
    row, column = np.unravel_index(amplitude.argmax(), amplitude.shape)
    return clsas.measure_point(image, (x_m[column], depth_m[row]), extent_m=5e-3)


def back_wall_depth_m(image: clsas.Image) -> np.ndarray:
    """Return the depth of the strongest echo below 30 mm, for columns within 4 mm of x = 0."""
    x_m, depth_m = image.grid.axes_m
    below = depth_m > 30e-3
    strip = np.abs(image.pixels[below][:, np.abs(x_m) < 4e-3])
    return depth_m[below][strip.argmax(axis=0)]


def draw(image: clsas.Image, tip: PointResponse, path: Path) -> None:
    """Write a picture of the section in the usual way: depth downwards, in millimetres."""
    figure = plot.image_db(image, dynamic_range_db=50, title="Aluminium block, notch and back wall")
    axes = figure.axes[0]
    axes.invert_yaxis()
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(lambda value, _: f"{1e3 * value:g}")
    axes.set(xlabel="x (mm)", ylabel="depth (mm)")
    axes.annotate(
        f"notch tip\n{1e3 * tip.x_m:.2f}, {1e3 * tip.y_m:.2f} mm",
        xy=(tip.x_m - 1.5e-3, tip.y_m),
        xytext=(-8e-3, tip.y_m),
        color="white",
        ha="center",
        va="center",
        arrowprops={"arrowstyle": "->", "color": "white"},
    )
    plot.save_png(figure, path)


def main() -> None:
    arguments = parse_arguments(__doc__, [RECORDING])
    for path in arguments.recording:
        lines = range_lines(path)
        print(f"{path.name}: {lines.channels} pairs of elements, {lines.length} samples each")
        image = clsas.backproject(lines, GRID, device=arguments.device)
        tip, wall_m = find_notch_tip(image), back_wall_depth_m(image)
        level_db = 20 * np.log10(tip.amplitude / np.abs(image.pixels).max())
        print(
            f"  notch tip: x = {1e3 * tip.x_m:.2f} mm, depth {1e3 * tip.y_m:.2f} mm, "
            f"{level_db:.1f} dB re the maximum; {1e3 * tip.azimuth.resolution_m:.2f} mm wide "
            f"and {1e3 * tip.range.resolution_m:.2f} mm deep (-3 dB)\n"
            f"  back wall: depth {1e3 * np.median(wall_m):.1f} mm, "
            f"varies by {1e3 * np.ptp(wall_m):.1f} mm over the middle 8 mm"
        )
        picture = arguments.out / f"{path.stem}.png"
        draw(image, tip, picture)
        print(f"  picture: {picture}")


if __name__ == "__main__":
    main()
