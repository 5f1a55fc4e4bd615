"""The decision how to form an exact image; its prediction uses the same."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsas.core.grid import Grid
from clsas.core.lines import RangeLines, fastest, some_channels, wavelength_m
from clsas.exact.checks import check_distances
from clsas.exact.lookup import most_upsampling
from clsas.exact.tiles import GEOMETRY_ERROR, Groups, GroupsEstimate, Tiles, allowed, lay_out
from clsas.opencl import phases
from clsas.opencl.device import Device
from clsas.signal import interpolation
from clsas.signal.ambiguity import Ambiguity
from clsas.signal.interpolation import Interpolator, Resampling
from clsas.signal.spectrum import Spectrum, cycles_per_m_at
from clsas.sonar.beam import BeamWindow
from clsas.sonar.visibility import sines

_CHANNELS, _PLACES = 256, 16  # at which is looked how full of what is seen the beam is


@dataclass(frozen=True, eq=False)
class Decision:
    """The way an exact image is formed.

    Attributes
    ----------
    layout : Tiles, Groups or GroupsEstimate
        The parts that pixels form.
    interpolator, resampling : Interpolator, Resampling
        How lines are sampled.
    phase_terms : int
        Of the polynomials for sine and cosine.
    one_cubic : bool
        Whether one cubic of the beam's weights serves a work-item of a tile, a block of points.
    """

    layout: Tiles | Groups | GroupsEstimate
    interpolator: Interpolator
    resampling: Resampling
    phase_terms: int
    one_cubic: bool


def decide(
    lines: RangeLines,
    grid: Grid,
    *,
    device: Device,
    accuracy_db: float,
    spectrum: Spectrum,
    left_open: Ambiguity,
    beam: BeamWindow | None = None,
    along: NDArray[np.float64] | None = None,
    taps: int | None = None,
    upsampling: float | None = None,
    left_out_error: float = 0.0,
    estimate: bool = False,
) -> Decision:
    """Decide how an exact image is formed.

    Parameters
    ----------
    lines, grid, device, accuracy_db, beam, taps, upsampling
        As of `clsas.backproject`. With both `taps` and `upsampling`, `accuracy_db` plays no part.
    spectrum, left_open : Spectrum, Ambiguity
        Measured of the lines.
    along : float64 [channels, 3], optional
        The track's unit directions, for a beam.
    left_out_error : float
        Error power of effects that the model leaves out.
    estimate : bool
        Do not sort pixels off a plane into groups, which takes longest: their layout is then
        estimated, and the lookup of samples does not limit the upsampling.
    """
    fixed = taps is not None and upsampling is not None
    fullness = 1.0 if beam is None else fullness_of(lines, grid, beam, along)
    antennas_m, cycles_per_m = antennas_and_phase(lines, spectrum, beam)
    geometry_error = GEOMETRY_ERROR if fixed else allowed(accuracy_db)
    layout = lay_out(
        grid,
        antennas_m,
        cycles_per_m,
        device.info.width,
        error=geometry_error,
        speed_ratio=fastest(lines),
        beam=beam,
        fullness=fullness,
        longest_m=lines.length * lines.range_step_m if estimate else None,
    )
    terms = phases.TERMS[-1] if fixed else phases.terms_within(accuracy_db)
    interpolator = interpolation.choose(
        spectrum,
        left_open.rest_db(accuracy_db, left_out_error),
        taps=taps,
        upsampling=upsampling,
        other_error=math.hypot(geometry_error, phases.error(terms)),
        pixels_per_sample=grid.size / lines.length,
        most_upsampling=most_upsampling(device, lines, layout.lookup_radius_m),
    )
    resampling = interpolation.resampling(lines.length, interpolator, spectrum)
    one_cubic = False
    if not isinstance(layout, GroupsEstimate):
        check_distances(antennas_m, layout)
        if beam is not None:
            nearest_m = max(layout.nearest_m(lines.phase_centres_m) - layout.radius_m, 1e-30)
            error = layout.one_cubic_error(beam, nearest_m, wavelength_m(lines))
            one_cubic = error <= geometry_error * fullness
    return Decision(layout, interpolator, resampling, terms, one_cubic)


def antennas_and_phase(
    lines: RangeLines, spectrum: Spectrum, beam: BeamWindow | None
) -> tuple[NDArray[np.float64], float]:
    """Return all places that ranges and aspects are from, [n, 3], and cycles per metre of range.

    The latter are what rounding a range costs: phase, and place within the lines' band, 0.3 Nyquist
    rms.
    """
    antennas_m = lines.tx_m
    if not np.array_equal(lines.tx_m, lines.rx_m):
        antennas_m = np.unique(np.concatenate([lines.tx_m, lines.rx_m]), axis=0)
    if beam is not None:
        antennas_m = np.concatenate([antennas_m, lines.phase_centres_m])
    of_phase = cycles_per_m_at(lines, spectrum.centre)
    return antennas_m, math.hypot(of_phase, 0.3 / lines.range_step_m)


def fullness_of(
    lines: RangeLines, grid: Grid, beam: BeamWindow, along: NDArray[np.float64]
) -> float:
    """Return `BeamWindow.fullness` of some channels at points all over a grid, its edges too."""
    some = some_channels(lines.channels, _CHANNELS)
    sine = sines(grid.spread(_PLACES), lines.phase_centres_m[some], along[some])
    return beam.fullness(sine, wavelength_m(lines), len(some) / lines.channels)
