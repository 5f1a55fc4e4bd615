"""The decision how to form an exact image, from which its time and memory are also predicted."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsas.core.grid import Grid
from clsas.core.lines import RangeLines, fastest, some_channels
from clsas.core.wavelengths import cycles_per_m_at, wavelength_m
from clsas.exact.checks import check_distances
from clsas.exact.groups import Groups, GroupsEstimate
from clsas.exact.layout import GEOMETRY_ERROR, Conditions, allowed, estimate_layout, lay_out
from clsas.exact.lookup import lookup_cost
from clsas.exact.tiles import Tiles
from clsas.opencl import phases
from clsas.opencl.device import Device
from clsas.signal import interpolation
from clsas.signal.ambiguity import Ambiguity
from clsas.signal.interpolation import Interpolator, Resampling
from clsas.signal.spectrum import Spectrum
from clsas.sonar.beam import BeamWindow
from clsas.sonar.visibility import sines

# Channels, and pixels along either side of the grid, for which the beam's fullness is evaluated.
_SAMPLED_CHANNELS = 256
_SAMPLED_PIXELS = 16
_BAND_RMS = 0.3  # rms frequency of lines within their band, cycles per sample


@dataclass(frozen=True, eq=False)
class Decision:
    """Choices with which an exact image is formed.

    Attributes
    ----------
    layout : Tiles, Groups or GroupsEstimate
        Parts into which the grid is divided.
    interpolator, resampling : Interpolator, Resampling
        Interpolation of range lines, and the upsampling before it.
    phase_terms : int
        Number of terms of the polynomials for sine and cosine.
    one_cubic : bool
        Whether one cubic of the beam's weights is used for all pixels of a work-item (tiles) or of
        a block (groups).
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
    windows: int = 1,
) -> Decision:
    """Decide how to form an exact image.

    Parameters
    ----------
    lines, grid, device, accuracy_db, beam, taps, upsampling
        As for `clsas.backproject`. With both `taps` and `upsampling`, `accuracy_db` has no effect.
    spectrum, left_open : Spectrum, Ambiguity
        Spectrum and ambiguity measured from the lines.
    along : float64 [channels, 3], optional
        Unit directions of the track, for a beam.
    left_out_error : float
        Error power of the effects that the model leaves out.
    estimate : bool
        If True, groups are estimated instead of gathered, which would take longest.
    windows : int
        Number of windows of estimated groups; see `Groups.windows`.
    """
    fixed = taps is not None and upsampling is not None
    accuracy_db = left_open.of_passed_db(accuracy_db)
    geometry_error = GEOMETRY_ERROR if fixed else allowed(accuracy_db)
    phase_terms = phases.TERMS[-1]
    if not fixed:
        phase_terms = phases.terms_within(accuracy_db, phases.EXACT_SHARE)
    conditions = Conditions(
        antennas_of(lines, beam),
        cycles_per_m_of(lines, spectrum),
        device.info.width,
        error=geometry_error,
        speed_ratio=fastest(lines),
        beam=beam,
        fullness=fullness_of(lines, grid, beam, along),
    )
    layout: Tiles | Groups | GroupsEstimate
    if estimate:
        layout = estimate_layout(grid, conditions, lines.length * lines.range_step_m, windows)
    else:
        layout = lay_out(grid, conditions)
    interpolator = interpolation.choose(
        spectrum,
        left_open.rest_db(accuracy_db, left_out_error),
        taps=taps,
        upsampling=upsampling,
        other_error=math.hypot(geometry_error, phases.error(phase_terms)),
        pixels_per_sample=grid.size / lines.length,
        lookup_cost=lookup_cost(device, layout, lines),
    )
    resampling = interpolation.resampling(lines.length, interpolator, spectrum)
    one_cubic = False
    if not isinstance(layout, GroupsEstimate):
        check_distances(conditions.antennas_m, layout)
        one_cubic = _one_cubic_serves(lines, layout, conditions)
    return Decision(layout, interpolator, resampling, phase_terms, one_cubic)


def antennas_of(lines: RangeLines, beam: BeamWindow | None) -> NDArray[np.float64]:
    """Return all positions from which ranges or aspect angles are measured, [n, 3]."""
    antennas_m = lines.tx_m
    if not np.array_equal(lines.tx_m, lines.rx_m):
        antennas_m = np.unique(np.concatenate([lines.tx_m, lines.rx_m]), axis=0)
    if beam is not None:
        antennas_m = np.concatenate([antennas_m, lines.phase_centres_m])
    return antennas_m


def cycles_per_m_of(lines: RangeLines, spectrum: Spectrum) -> float:
    """Return the rms error due to rounding a range, cycles per metre.

    A rounded range shifts the phase as well as the position at which the line is interpolated.
    """
    of_phase = cycles_per_m_at(lines, spectrum.centre)
    return math.hypot(of_phase, _BAND_RMS / lines.range_step_m)


def fullness_of(
    lines: RangeLines, grid: Grid, beam: BeamWindow | None, along: NDArray[np.float64] | None
) -> float:
    """Return `BeamWindow.fullness` for sampled channels and pixels of a grid; 1 without a beam."""
    if beam is None or along is None:
        return 1.0
    some = some_channels(lines.channels, _SAMPLED_CHANNELS)
    sine = sines(grid.spread(_SAMPLED_PIXELS), lines.phase_centres_m[some], along[some])
    return beam.fullness(sine, wavelength_m(lines), len(some) / lines.channels)


def _one_cubic_serves(lines: RangeLines, layout: Tiles | Groups, conditions: Conditions) -> bool:
    """Return whether one cubic of the beam's weights is accurate enough; False without a beam."""
    beam = conditions.beam
    if beam is None:
        return False
    nearest_m = max(layout.nearest_m(lines.phase_centres_m) - layout.radius_m, 1e-30)
    error = layout.one_cubic_error(beam, nearest_m, wavelength_m(lines))
    return error <= conditions.error * conditions.fullness
