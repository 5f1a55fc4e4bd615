"""The decision how to form an exact image, from which its time and memory are also predicted."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsas.core import validate
from clsas.core.decibels import in_db, power
from clsas.core.grid import Grid
from clsas.core.lines import RangeLines, fastest, some_channels
from clsas.core.wavelengths import cycles_per_m_at, wavelength_m
from clsas.exact.groups import Groups, GroupsEstimate
from clsas.exact.layout import GEOMETRY_ERROR, Conditions, allowed, estimate_layout, lay_out
from clsas.exact.lookup import lookup_cost
from clsas.exact.tiles import Tiles
from clsas.opencl import phases
from clsas.opencl.device import Device
from clsas.scene import Scene
from clsas.signal import interpolation
from clsas.signal.ambiguity import BEST_DB
from clsas.signal.interpolation import Interpolator, Resampling
from clsas.signal.spectrum import Spectrum
from clsas.sonar.beam import BeamWindow
from clsas.sonar.visibility import sines

ACCURACY_DB = -60.0
"""Accuracy of exact images by default."""
BEST_ACCURACY_DB = BEST_DB
"""Best accuracy that may be requested; float32 does not allow a better one."""

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

    def error_db(self, scene: Scene) -> float:
        """Return the relative rms error of the image, of the lines and of what is left out, dB."""
        of_passed = power(self.interpolator.error_db) / scene.ambiguity.least_brightness
        return in_db(of_passed + scene.ambiguity.error_power + scene.left_out_error)


def decide(
    scene: Scene,
    device: Device,
    accuracy_db: float,
    *,
    taps: int | None = None,
    upsampling: float | None = None,
    estimate: bool = False,
    windows: int = 1,
) -> Decision:
    """Decide how to form the exact image of a scene.

    Parameters
    ----------
    scene : Scene
    device : Device
    accuracy_db : float
        Allowed relative rms error, dB. With both `taps` and `upsampling` it has no effect.
    taps, upsampling
        As for `clsas.backproject`.
    estimate : bool
        If True, groups are estimated instead of gathered, which would take longest, and
        `accuracy_db` is what the effects left out leave of the allowed error.
    windows : int
        Number of windows of estimated groups; see `Groups.windows`.
    """
    lines, beam, spectrum, ambiguity = scene.lines, scene.beam, scene.spectrum, scene.ambiguity
    grid = scene.grid
    if not scene.is_reached and not estimate:
        # Nothing is formed, but to lay out distant pixels would take long.
        grid = Grid.points(grid.spread(1))
    fixed = taps is not None and upsampling is not None
    accuracy_db = ambiguity.of_passed_db(accuracy_db)
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
        fullness=fullness_of(lines, grid, beam, scene.along),
    )
    layout: Tiles | Groups | GroupsEstimate
    if estimate:
        layout = estimate_layout(grid, conditions, lines.length * lines.range_step_m, windows)
    else:
        layout = lay_out(grid, conditions)
    interpolator = interpolation.choose(
        spectrum,
        ambiguity.rest_db(accuracy_db, 0.0 if estimate else scene.left_out_error),
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


def check_distances(antennas_m: NDArray[np.float64], layout: Tiles | Groups) -> None:
    """Raise ValueError for distances so large that their squares overflow float32."""
    points_m = np.concatenate([antennas_m, layout.centres_m(slice(None))])
    extent_m = float(np.ptp(points_m, axis=0).max())
    if extent_m > validate.FARTHEST_M:
        raise ValueError(
            f"lines and grid must lie within {validate.FARTHEST_M:g} m of each other, "
            f"got {extent_m:g} m"
        )


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
