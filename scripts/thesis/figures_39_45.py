#!/usr/bin/env python3
"""THESIS figures 39 to 45: a wreck by backprojection, mosaics and the wavenumber algorithm."""

import statistics
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import chapter5
import chapter6
import numpy as np

import clsas
from clsas.selftest import wreck

THESIS = {
    "42": (8, "λ/13"),
    "43": (4, "λ/6"),
    "44": (1, "λ/1"),
}  # patches along each side, largest error
TOLERANCES_DB = (-20, -30, -40, -50)
ALL = "all channels"  # without a beam
STRIPS = (1, 4, 16)  # of a wavenumber image, each with its own middle range
TIMED_STRIPS = 4
DYNAMIC_RANGE_DB = 40
BRIGHTEST = 99.5  # percentile of the exact image's power that is 0 dB in the pictures
PANEL = 256  # approximate number of dots along each side of a picture
STEPS = 16  # of the grey scale
DPI = {1: 180, 2: 110}  # by pictures along each side, for files of less than 200 kB

Picture = tuple[str, clsas.Image, float]  # title, image, power of its 0 dB


@dataclass(frozen=True, eq=False)
class Method:
    """A method to form an image: figure, part of the scene, lines, name, and function."""

    figure: str
    extent: str
    scene: chapter6.Scene
    name: str
    form: Callable[[clsas.Grid], clsas.Image | tuple[clsas.Image, list[clsas.Patch]]]

    @property
    def grid(self) -> clsas.Grid:
        """Grid of the image."""
        return getattr(self.scene, self.extent)

    def __call__(self) -> tuple[clsas.Image, list[clsas.Patch]]:
        """Return the image and its patches, and print the first warning."""
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", clsas.ClsasWarning)
            formed = self.form(self.grid)
        for each in caught[:1]:
            print(f"{self.name}, {self.extent}: {each.message}")
        return formed if isinstance(formed, tuple) else (formed, [])


def patched(side: int) -> str:
    """Return the name of a mosaic of the thesis."""
    return f"nearest, {side * side} patches" if side > 1 else "nearest, 1 patch"


def methods(full: chapter6.Scene) -> list[Method]:
    """Return all methods; the first for each part of the scene is exact."""

    def exact(figure: str, extent: str, name: str, scene=full, **options) -> Method:
        return Method(figure, extent, scene, name, partial(scene.backproject, **options))

    def mosaic(
        figure: str, extent: str, name: str, side: int | None, scene=full, **request
    ) -> Method:
        patches = side and (side, side)
        return Method(
            figure, extent, scene, name, partial(scene.mosaic, patches=patches, **request)
        )

    found = [
        exact("40", "whole", "exact"),
        exact("", "whole", "exact, −40 dB", accuracy_db=-40),
        exact("", "whole", f"exact, −40 dB, {ALL}", accuracy_db=-40, beam=None),
        mosaic("", "whole", "tolerance −40 dB", None, tolerance_db=-40),
        Method("", "whole", full, "wavenumber", full.wavenumber),
        exact("41", "part", "exact"),
        exact("", "part", "exact, −40 dB", accuracy_db=-40),
        exact("", "part", "exact, heading fixed", beam=chapter6.FIXED_BEAM),
        exact("", "part", f"exact, −40 dB, {ALL}", accuracy_db=-40, beam=None),
    ]
    for scene in dict.fromkeys((full.thinned, full)):
        if scene is not full:
            found.append(exact("", "part", "exact", scene))
        for figure, (side, _) in THESIS.items():
            request = {"scene": scene, "stages": chapter6.STAGES}
            found.append(mosaic(figure, "part", patched(side), side, **request))
    for db in TOLERANCES_DB:
        found.append(mosaic("", "part", f"tolerance −{-db} dB", None, tolerance_db=db))
    for side in (4, 8):
        name = f"tolerance −40 dB, {side * side} patches"
        found.append(mosaic("", "part", name, side, tolerance_db=-40))
    found += [
        Method("45", "part", full, "wavenumber", full.wavenumber),
        Method(
            "",
            "part",
            full,
            f"wavenumber, {TIMED_STRIPS} strips",
            partial(full.wavenumber, strips=TIMED_STRIPS),
        ),
        exact("", "fine", "exact"),
        exact("", "fine", "exact, −40 dB", accuracy_db=-40),
        exact("", "fine", f"exact, −40 dB, {ALL}", accuracy_db=-40, beam=None),
    ]
    for db in TOLERANCES_DB:
        found.append(mosaic("", "fine", f"tolerance −{-db} dB", None, tolerance_db=db))
    return found


def main() -> None:
    given, full = chapter6.arguments(__doc__, repeats=3)
    shadow = wreck.Shadow(wreck.scene())
    thin, todo = full.thinned, methods(full)
    exact, images, rows = {}, {}, {}
    for method in todo:
        image, patches = method()
        reference = exact.setdefault((method.scene, method.extent), image)
        rows[method] = row(method, image, patches, reference, shadow)
        if method.extent != "fine":
            images[method.scene, method.extent, method.name] = image
    for method, seconds in in_turn(todo, given.repeats).items():
        rows[method]["seconds"] = f"{seconds:.3f}"
    chapter5.report(given.out, "figures_39_45", list(rows.values()))
    references = [images[full, "part", name] for name in ("exact", "exact, heading fixed")]
    chapter5.report(given.out, "figure_45", strip_rows(full, *references))

    def picture(title: str, name: str, extent: str = "part", scene=full) -> Picture:
        reference = images[scene, "part", name if ALL in name else "exact"]
        power = np.abs(reference.pixels) ** 2
        return title, images[scene, extent, name], np.percentile(power, BRIGHTEST)

    draw_track(full, given.out)
    draw([picture("40: exact, whole scene", "exact", "whole")], given.out, "figure_40")
    others = [
        picture("41: exact", "exact"),
        picture("by tolerance, −40 dB", "tolerance −40 dB"),
        picture("45: wavenumber", "wavenumber"),
        picture("exact, all channels, by its own brightest", f"exact, −40 dB, {ALL}"),
    ]
    draw(others, given.out, "figures_41_45")
    patches = [(figure, patched(side)) for figure, (side, _) in THESIS.items()]
    mosaics = [picture(f"{figure}: {name}", name, scene=thin) for figure, name in patches]
    mosaics.append(picture(f"{patches[-1][1]}, every line", patches[-1][1]))
    draw(mosaics, given.out, "figures_42_44")


def strip_rows(
    scene: chapter6.Scene, exact: clsas.Image, fixed: clsas.Image
) -> list[dict[str, object]]:
    """Return errors of wavenumber images in strips, for the true heading and for a fixed one."""
    rows = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", clsas.ClsasWarning)
        for strips in STRIPS:
            image = scene.wavenumber(scene.part, strips)
            of_exact, of_fixed = (clsas.relative_error_db(image, each) for each in (exact, fixed))
            errors = {"error dB": f"{of_exact:.1f}", "with a fixed heading dB": f"{of_fixed:.1f}"}
            rows.append({"strips": strips, **errors})
    return rows


def in_turn(todo: list[Method], repeats: int) -> dict[Method, float]:
    """Return the median seconds of every method, run in turns; all have been run before."""
    taken: dict[Method, list[float]] = {method: [] for method in todo}
    for _ in range(repeats):
        for method in todo:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", clsas.ClsasWarning)
                start = time.perf_counter()
                method.form(method.grid)
                taken[method].append(time.perf_counter() - start)
    return {method: statistics.median(each) for method, each in taken.items()}


def row(
    method: Method,
    image: clsas.Image,
    patches: list[clsas.Patch],
    exact: clsas.Image,
    shadow: wreck.Shadow,
) -> dict[str, object]:
    """Return the row of an image in the table, without its seconds."""
    scene, worst = method.scene, {"thesis": "", "eq. 45": "", "measured": ""}
    if method.figure in THESIS:
        worst = {
            "thesis": THESIS[method.figure][1],
            "eq. 45": chapter6.fraction(max(map(scene.formula_m, patches))),
            "measured": chapter6.fraction(max(map(scene.measured_m, patches))),
        }
    plans = [patch.record.plan for patch in patches]
    stages = [1 + len(plan["method"]["sides"]) if plan else 1 for plan in plans]
    other = image is exact or ALL in method.name  # images that are not compared
    error_db = None if other else clsas.relative_error_db(image, exact)
    mast_db = chapter6.mast_db(image)
    return {
        "figure": method.figure,
        "pixels": " x ".join(map(str, image.grid.shape)),
        "lines": scene.lines.channels,
        "image": method.name,
        "stages": max(stages, default=""),
        **worst,
        "seconds": "",
        "error dB": "" if error_db is None else f"{error_db:.1f}",
        "shadow dB": f"{shadow.contrast_db(image):.1f}",
        "mast dB": f"{mast_db:.1f}",
        "mast": "yes" if mast_db < chapter6.VISIBLE_DB else "no",
    }


def draw_track(scene: chapter6.Scene, out: Path) -> None:
    """Draw the positions of the transmitter."""
    tx_m = np.unique(scene.lines.tx_m, axis=0)
    figure = chapter5.figure(8, 2.8)
    axes = figure.subplots()
    axes.plot(tx_m[:, 0], tx_m[:, 1], ".-", markersize=3, linewidth=0.5)
    axes.set(xlabel="Along-track (m)", ylabel="Sway (m)")
    axes.set_title(f"39: {len(tx_m)} pings")
    axes.grid(alpha=0.3)
    chapter5.save(figure, out, "figure_39")


def draw(pictures: list[Picture], out: Path, stem: str) -> None:
    """Draw one or four images, in dB over a reference power."""
    from matplotlib import colormaps

    side = 1 if len(pictures) == 1 else 2
    figure = chapter5.figure(*((7.5, 6.2) if side == 1 else (10.5, 8.6)))
    figure.set_layout_engine("compressed")
    panels = figure.subplots(side, side, sharex=True, sharey=True, squeeze=False).ravel()
    for (title, image, reference), axes in zip(pictures, panels, strict=True):
        drawn = axes.imshow(
            chapter6.levels(image, max(image.grid.shape[0] // PANEL, 1), reference),
            origin="lower",
            extent=chapter6.extent_m(image.grid),
            cmap=colormaps["gray"].resampled(STEPS),
            vmin=-DYNAMIC_RANGE_DB,
            vmax=0,
            interpolation="nearest",  # no shades in between
        )
        axes.set(title=title, aspect="equal")
    for axes in panels[-side:]:
        axes.set_xlabel("Along-track (m)")
    for axes in panels[::side]:
        axes.set_ylabel("Across-track (m)")
    figure.colorbar(drawn, ax=list(panels), label=f"Power (dB re {BRIGHTEST:g}th percentile)")
    chapter5.save(figure, out, stem, dpi=DPI[side])


if __name__ == "__main__":
    main()
