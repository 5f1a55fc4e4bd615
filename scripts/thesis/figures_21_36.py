#!/usr/bin/env python3
"""THESIS figures 21 to 36: images and azimuth responses by error, and of interpolated plans."""

import math

import chapter5
import numpy as np
from chapter5 import decibels
from scipy import signal

import clsas
from clsas.measures.quality import measure_cut

# Three beams are combined into one, and sides divided by powers of two. The errors are within 3 %
# of lambda/121.2, /60.6, /30.3 ... /1.9, whose integer parts are the labels 121, 60, 30, 15, 7, 3
# and 1 of the thesis.
ERRORS = {121: (3, 64), 60: (3, 32), 30: (3, 16), 15: (3, 8), 7: (3, 4), 3: (3, 2), 1: (6, 2)}
# Errors that halve from 30.3, which the thesis states for QR = 2 and QI = 4, by powers of two.
HALVINGS = {121: (2, 16), 60: (2, 8), 30: (2, 4), 15: (2, 2), 7: (4, 2), 3: (8, 2), 1: (16, 2)}
TOLERANCES_DB = (-20, -40)
TAPS = (4, 6, 8)  # in range and along the aperture, at -40 dB
DYNAMIC_RANGE_DB = 40  # as in the pictures of the thesis
PANEL = 256  # dots along each side of a picture
FINE = 8  # points per pixel of the azimuth response of figure 34
FIGURE_34 = {
    "image": "thesis, λ/3",
    "QR x QI": "",
    "eq. 45": "",
    "azimuth mm": "100.88",
    "PGLR left dB": "6.6",
    "PGLR right dB": "6.2",
    "ISLR dB": "24.7",
    "peak dB": "",
}  # as printed in the figure, whose response has its peak at 0 dB
SIMILAR_TO_34 = (
    "nearest, λ/7", "nearest, λ/3", "nearest, λ/1", "nearest, thesis's λ/3?",
    "nearest, thesis's λ/1?",
)  # fmt: skip


def coarse(amplitude: np.ndarray) -> np.ndarray:
    """Return the maximum of the pixels in each dot."""
    for axis in (0, 1):
        count = amplitude.shape[axis]
        first = np.linspace(0, count, min(count, PANEL), endpoint=False).astype(int)
        amplitude = np.maximum.reduceat(amplitude, first, axis)
    return amplitude


def azimuth_response(image: clsas.Image) -> np.ndarray:
    """Return the azimuth response of figure 34, the maximum over range, with finer pixels."""
    # Without the phase of the range from the middle of the aperture, the band does not wrap.
    range_m = np.linalg.norm(image.grid.positions_m(), axis=-1)
    pixels = image.pixels * np.exp(-4j * math.pi / chapter5.WAVELENGTH_M * range_m)
    return np.abs(signal.resample(pixels, FINE * pixels.shape[1], axis=1)).max(axis=0)


def as_figure_34(image: clsas.Image, exact: clsas.Image) -> dict[str, str]:
    """Return what figure 34 prints about the azimuth response.

    Ratios are of the main lobe to the highest side lobe on each side, and to the nearest ten on
    both sides in energy, positive as in the thesis.
    """
    response = azimuth_response(image)
    top = int(response.argmax())
    cut = measure_cut(image.grid.sides[0], response, top, response[top], None)
    return {
        "azimuth mm": f"{1e3 * cut.resolution_m / FINE:.2f}",
        "PGLR left dB": f"{-cut.pslr_db[0]:.1f}",
        "PGLR right dB": f"{-cut.pslr_db[1]:.1f}",
        "ISLR dB": f"{-cut.islr_db:.1f}",
        "peak dB": f"{decibels(response[top], azimuth_response(exact).max()):.1f}",
    }


def main() -> None:
    given, scene = chapter5.arguments(__doc__)
    images = {"backprojection": scene.exact}
    described = {"image": "backprojection", "QR x QI": "", "eq. 45": ""}
    figure_34 = [FIGURE_34, described | as_figure_34(scene.exact, scene.exact)]
    rows = [
        {
            "image": "backprojection", "QR x QI": "", "eq. 45": "", "measured": "",
            **scene.exact_quality.cells(), "scene error dB": "", "usable": "yes",
        }
    ]  # fmt: skip

    def add(title: str, kept: bool = True, **request: object) -> None:
        plan, stages = scene.plan(**request), request.get("stages")
        image = scene.form(plan)
        quality = scene.measure(image)
        rows.append(
            {
                "image": title,
                "QR x QI": chapter5.name(stages) if stages else "",
                "eq. 45": chapter5.fraction(scene.error_m(stages)) if stages else "",
                "measured": chapter5.fraction(scene.largest_error_m(plan)) if stages else "",
                **quality.cells(),
                "scene error dB": f"{scene.scattered.error_db(**request):.1f}",
                "usable": "yes" if quality.usable(scene.exact_quality) else "no",
            }
        )
        if title in SIMILAR_TO_34:
            described = {column: rows[-1][column] for column in ("image", "QR x QI", "eq. 45")}
            figure_34.append(described | as_figure_34(image, scene.exact))
        if kept:
            images[title] = image

    for label, pair in ERRORS.items():
        add(f"nearest, λ/{label}", stages=[pair])
    for db in TOLERANCES_DB:
        add(f"interpolated, {db} dB", tolerance_db=db)
    for taps in TAPS:
        add(f"interpolated, {taps} taps", kept=False, tolerance_db=-40, taps=(taps, taps))
    for label, pair in HALVINGS.items():
        add(f"nearest, thesis's λ/{label}?", kept=False, stages=[pair])
    chapter5.report(given.out, "figures_21_36", rows)
    chapter5.report(given.out, "figure_34", figure_34)

    x_m, y_m = scene.grid.axes_m
    half = (x_m[1] - x_m[0]) / 2
    extent = (x_m[0] - half, x_m[-1] + half, y_m[0] - half, y_m[-1] + half)
    pictures, responses = chapter5.figure(13, 5.6), chapter5.figure(13, 5.6)
    panels = pictures.subplots(2, 5, sharex=True, sharey=True).ravel()
    curves = responses.subplots(2, 5, sharex=True, sharey=True).ravel()
    for (title, image), panel, curve in zip(images.items(), panels, curves, strict=True):
        amplitude = np.abs(image.pixels)
        level = decibels(coarse(amplitude), amplitude.max())
        drawn = panel.imshow(
            level, origin="lower", extent=extent, cmap="gray", vmin=-DYNAMIC_RANGE_DB, vmax=0
        )
        panel.set(title=title, aspect="equal")
        response = chapter5.profile(image)
        # The thesis normalises each response by its own peak; the exact peak reveals the loss.
        curve.plot(x_m, decibels(response, chapter5.profile(scene.exact).max()), linewidth=0.8)
        curve.set(title=title, ylim=(-80, 3))
        curve.grid(alpha=0.3)
    for below, left in ((panels[5:], panels[::5]), (curves[5:], curves[::5])):
        for axes in below:
            axes.set_xlabel("Along-track (m)")
        for axes in left:
            axes.set_ylabel(
                "Across-track (m)" if axes in panels else "Amplitude (dB re exact peak)"
            )
    pictures.colorbar(drawn, ax=list(panels), label="Amplitude (dB re max)", shrink=0.8)
    chapter5.save(pictures, given.out, "figures_21_36_images", dpi=90)
    chapter5.save(responses, given.out, "figures_21_36", dpi=90)


if __name__ == "__main__":
    main()
