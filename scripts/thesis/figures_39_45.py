#!/usr/bin/env python3
"""THESIS figures 39 to 45: a wreck by backprojection, mosaics and the wavenumber algorithm."""

import math
import warnings
from functools import partial

import chapter5
import chapter6
import numpy as np

import clsas
from clsas import wreck

THESIS = {"42": (8, "λ/13"), "43": (4, "λ/6"), "44": (1, "λ/1")}  # patches a side, worst error
TOLERANCES_DB = (-20, -30, -40, -50)
STRIPS = 8  # of a wavenumber image, each with its own middle range
DYNAMIC_RANGE_DB = 40
BRIGHTEST = 99.5  # percentile of the power that is the pictures' 0 dB
PANEL = 300  # dots along a picture's side, about
STEPS = 20  # of the grey scale


def main() -> None:
    given, scene = chapter6.arguments(__doc__, repeats=3)
    shadows = chapter6.Shadows(wreck.scene())
    whole, part = scene.whole, scene.part

    def mosaic(grid: clsas.Grid, side: int | None, **wish: object) -> clsas.Image:
        return scene.mosaic(grid, patches=side and (side, side), **wish)[0]

    work = {
        ("whole", "40", "exact"): partial(scene.backproject, whole),
        ("whole", "", "exact, -40 dB"): partial(scene.backproject, whole, -40.0),
        ("whole", "", "exact, every channel"): partial(scene.backproject, whole, beam=None),
        ("whole", "", "-40 dB"): partial(mosaic, whole, None, tolerance_db=-40),
        ("whole", "", "wavenumber"): partial(scene.wavenumber, whole),
        ("part", "41", "exact"): partial(scene.backproject, part),
        ("part", "", "exact, -40 dB"): partial(scene.backproject, part, -40.0),
        ("part", "", "exact, every channel"): partial(scene.backproject, part, beam=None),
    }
    for number, (side, _) in THESIS.items():
        key = "part", number, f"nearest, {side * side} patches"
        work[key] = partial(mosaic, part, side, stages=chapter6.STAGES)
    for db in TOLERANCES_DB:
        work["part", "", f"{db} dB"] = partial(mosaic, part, None, tolerance_db=db)
    for side in (4, 8):
        key = "part", "", f"-40 dB, {side * side} patches"
        work[key] = partial(mosaic, part, side, tolerance_db=-40)
    work["part", "45", "wavenumber"] = partial(scene.wavenumber, part)
    strips = "part", "", f"wavenumber, {STRIPS} strips"
    work[strips] = partial(scene.wavenumber, part, STRIPS)

    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always", clsas.ClsasWarning)
        images = {key: form() for key, form in work.items()}
        seconds = chapter5.in_turn(work, given.repeats)
    for message in dict.fromkeys(str(each.message) for each in told):
        print("warning:", message)

    rows = []
    for key, image in images.items():
        grid, number, how = key
        exact = images[grid, "40" if grid == "whole" else "41", "exact"]
        worst, formula_m, measured_m = ("", math.nan, math.nan)
        if number in THESIS:
            side, worst = THESIS[number]
            _, patches = scene.mosaic(part, patches=(side, side), stages=chapter6.STAGES)
            formula_m = max(map(scene.formula_m, patches))
            measured_m = max(map(scene.measured_m, patches))
        mast_db = shadows.mast_db(image)
        error_db = "" if "every channel" in how else clsas.relative_error_db(image, exact)
        rows.append(
            {
                "figure": number,
                "grid": f"{grid}, {image.grid.shape[0]} x {image.grid.shape[1]}",
                "image": how,
                "thesis": worst,
                "[45]": chapter6.fraction(formula_m) if number in THESIS else "",
                "measured": chapter6.fraction(measured_m) if number in THESIS else "",
                "seconds": f"{seconds[key]:.3f}",
                "error dB": "" if image is exact or error_db == "" else f"{error_db:.1f}",
                "shadow dB": f"{shadows.wreck.contrast_db(image):.1f}",
                "mast dB": f"{mast_db:.1f}",
                "mast": "yes" if mast_db < chapter6.VISIBLE_DB else "no",
            }
        )
    chapter5.report(given.out, "figures_39_45", rows)

    draw_track(scene, given.out)
    exact = images["part", "41", "exact"]
    reference = np.percentile(np.abs(exact.pixels) ** 2, BRIGHTEST)
    figure = chapter5.figure(7.5, 6.2)
    axes = figure.subplots()
    draw(axes, images["whole", "40", "exact"], "40: exact, whole scene", reference, figure)
    chapter5.plot.save_png(figure, given.out / "figure_40.png", dpi=72)

    titles = {
        ("part", "41", "exact"): "41: exact",
        ("part", "42", "nearest, 64 patches"): "42: nearest, 64 patches",
        ("part", "43", "nearest, 16 patches"): "43: nearest, 16 patches",
        ("part", "44", "nearest, 1 patches"): "44: nearest, one patch",
        ("part", "45", "wavenumber"): "45: wavenumber",
        ("part", "", "-40 dB"): "by tolerance, −40 dB",
    }
    figure = chapter5.figure(13, 8)
    panels = figure.subplots(2, 3, sharex=True, sharey=True).ravel()
    for (key, title), panel in zip(titles.items(), panels, strict=True):
        draw(panel, images[key], title, reference)
    figure.colorbar(
        panels[0].images[0], ax=list(panels), label="power over the exact image's brightest (dB)"
    )
    chapter5.save(figure, given.out, "figures_39_45", dpi=72)


def draw_track(scene: chapter6.Scene, out) -> None:
    """Draw the platform as pings see it: where transmitters are."""
    tx_m = np.unique(scene.lines.tx_m, axis=0)
    figure = chapter5.figure(8, 2.8)
    axes = figure.subplots()
    axes.plot(tx_m[:, 0], tx_m[:, 1], ".-", markersize=3, linewidth=0.5)
    axes.set(xlabel="along the track, x (m)", ylabel="sway, y (m)")
    axes.set_title(f"39: {len(tx_m)} pings; y is drawn 80 times as large")
    axes.grid(alpha=0.3)
    chapter5.plot.save_png(figure, out / "figure_39.png", dpi=72)


def draw(axes, image: clsas.Image, title: str, reference: float, figure=None) -> None:
    """Draw an image in dB over a reference power."""
    from matplotlib import colormaps

    together = max(image.grid.shape[0] // PANEL, 1)
    drawn = axes.imshow(
        chapter6.levels(image, together, reference),
        origin="lower",
        extent=chapter6.extent_m(image.grid),
        cmap=colormaps["gray"].resampled(STEPS),
        vmin=-DYNAMIC_RANGE_DB,
        vmax=0,
    )
    axes.set(title=title, aspect="equal", xlabel="x (m)", ylabel="y (m)")
    if figure is not None:
        figure.colorbar(drawn, ax=axes, label="power over the exact image's brightest (dB)")


if __name__ == "__main__":
    main()
