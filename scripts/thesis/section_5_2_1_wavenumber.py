#!/usr/bin/env python3
"""THESIS section 5.2.1, wavenumber imaging: speed against factorized images at equal error.

Hunter et al. (2003, quoted in the thesis) state that FFBP is faster than the wavenumber algorithm
only at errors that make images useless. Images of 300 points beside the straight track of chapter
5, in scenes of three sizes, are formed by both. `clsas.wavenumber` has one accuracy, so that its
interpolations are also given coarser ones here.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from functools import partial
from unittest import mock

import chapter5

import clsas
from clsas.engine.exact import wavenumber as imager
from clsas.measures.tradeoff import REFERENCE_DB

ACCURACIES_DB = (imager.ACCURACY_DB, -40.0)  # of interpolation: that of clsas, and a coarse one
SIZES = (0.5, 1, 2)  # over the given number of pixels
TOLERANCES_DB = (-20.0, -30.0, -40.0, -50.0, -60.0, -70.0)
NEAREST = (((8, 8), (2, 2)), ((8, 16),), ((2, 16),))
BEAM = clsas.BeamWindow(math.degrees(0.1), "hann")  # of elements of 15 mm at 1 MHz


def wavenumber(
    accuracy_db: float, lines: clsas.RangeLines, grid: clsas.Grid, beam: clsas.BeamWindow | None
) -> clsas.Image:
    """Return the wavenumber image with another accuracy of its interpolations."""
    with mock.patch.object(imager, "ACCURACY_DB", accuracy_db):
        return clsas.wavenumber(lines, grid, beam=beam)


def rows_of(scene: chapter5.Scene, beam: clsas.BeamWindow | None, repeats: int) -> list[dict]:
    """Return the rows of a scene: time and error of every method."""
    lines, grid, device = scene.scattered.lines, scene.grid, scene.device
    exactly = partial(clsas.backproject, lines, grid, beam=beam, device=device)
    work = {
        ("wavenumber", f"{db:g} dB"): partial(wavenumber, db, lines, grid, beam)
        for db in ACCURACIES_DB
    }
    work |= {("exact", f"{db:g} dB"): partial(exactly, accuracy_db=db) for db in (-40.0, -60.0)}
    requests = {("interpolated", f"{db:g} dB"): {"tolerance_db": db} for db in TOLERANCES_DB}
    requests |= {("nearest", chapter5.name(each)): {"stages": each} for each in NEAREST}
    for key, request in requests.items():
        plan = clsas.plan(lines, grid, **request, beam=beam, device=device)
        if not plan.is_exact:
            work[key] = partial(clsas.factorize, lines, grid, plan, device=device)
    reference = exactly(accuracy_db=REFERENCE_DB)
    error_db = {key: clsas.relative_error_db(form(), reference) for key, form in work.items()}
    seconds = chapter5.in_turn(work, repeats, min)
    ours = seconds["wavenumber", f"{ACCURACIES_DB[0]:g} dB"]
    return [
        {
            "pixels": f"{grid.shape[0]} x {grid.shape[1]}",
            "beam": "none" if beam is None else f"{beam.width_deg:.1f} deg, {beam.shape}",
            "method": " ".join(filter(None, key)),
            "seconds": f"{seconds[key]:.3f}",
            "error dB": f"{error_db[key]:.1f}",
            "wavenumber over it": f"{ours / seconds[key]:.2f}",
        }
        for key in work
    ]


def main() -> None:
    given, whole = chapter5.arguments(__doc__, repeats=5)
    rows = []
    for size in SIZES:
        scene = replace(whole, pixels=round(size * whole.pixels))
        for beam in (None, BEAM) if size <= 1 else (BEAM,):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", clsas.ClsasWarning)
                rows += rows_of(scene, beam, given.repeats)
    chapter5.report(given.out, "section_5_2_1_wavenumber", rows)


if __name__ == "__main__":
    main()
