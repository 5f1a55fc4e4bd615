"""How an exact image is formed: in tiles or groups, with which interpolation and phase terms.

`decide` makes all these choices for a scene and an accuracy. The image is formed by them, and its
time and memory are predicted from them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import validate
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.decibels import amplitude, in_db, power
from clsas.engine.data.declared import Number
from clsas.engine.data.geometry import SAME_PLACE_M
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import cycles_per_m_at, fastest, some_channels, wavelength_m
from clsas.engine.data.validate import ArgumentError
from clsas.engine.data.visibility import sine_width, sines
from clsas.engine.device import kernels
from clsas.engine.device.device import Device
from clsas.engine.exact.layout import (
    Groups,
    GroupsEstimate,
    Tiles,
    gather,
    item_pixels,
    lookup_costs,
    lookup_options,
)
from clsas.engine.scene import Scene
from clsas.engine.signal import interpolation
from clsas.engine.signal.ambiguity import BEST_DB
from clsas.engine.signal.cropping import Crop
from clsas.engine.signal.interpolation import Interpolator, Resampling

ACCURACY_DB = -60.0
"""Accuracy of exact images by default."""
BEST_ACCURACY_DB = BEST_DB
"""Best accuracy that may be requested; float32 does not allow a better one."""
ACCURACY = Number(
    "dB",
    least=BEST_ACCURACY_DB,
    below=0.0,
    help="Relative rms error of the exact image.",
    default=f"{ACCURACY_DB:g}",
)
"""Declares accuracies of exact images."""

GEOMETRY_ERROR = 3.2e-5
"""Relative rms error that rounding and expanding the geometry may always add: -90 dB."""

ROUNDING = 2.2e-7
"""Rms error of a phase, radians, per cycle over the radius of a part. Measured with many
channels."""

_ROUNDED = 2.0**-24 / math.sqrt(12)  # rms error of a float32 from 0.5 to 1, samples
_GEOMETRY_SHARE_DB = -12.0  # error power that the geometry may add, over that of the image: 6 %

_SAMPLED_CHANNELS = 256  # for which the beam's fullness is evaluated
_BAND_RMS = 0.3  # rms frequency of lines within their band, cycles per sample

_ONE_CHANNEL = 5.0  # largest relative excess of the error power with a single channel
_FEW_CHANNELS = 32  # with more channels, errors average to within a decibel of the mean

_SIDES = (64, 32, 16)  # sides of tiles, pixels
_FOURTH_ORDER = 0.15 / 8  # rms remainder of an expanded range, over r^4/R^3
_MOTION = 0.2  # rms remainder of the range to a moving receiver, over v/c r^3/R^2
_SINE_REMAINDER = 0.1  # remainder of a sine that is expanded to third order, over (r/R)^4
_SINE_ERROR = 1e-6  # error of a sine that is always allowed, as a share of the beam's width
_SINE_ROUNDING = 1e-7  # rounding error of a sine in float32


@dataclass(frozen=True, eq=False)
class Decision:
    """Choices with which an exact image is formed.

    Attributes
    ----------
    layout : Tiles, Groups or GroupsEstimate
        Parts into which the grid is divided.
    crop : Crop
        Samples of the lines that are needed.
    interpolator, resampling : Interpolator, Resampling
        Interpolation of these, and the upsampling before it.
    phase_terms : int
        Number of terms of the polynomials for sine and cosine.
    one_cubic : bool
        Whether one cubic of the beam's weights is used for all pixels of a work-item (tiles) or of
        a block (groups).
    """

    layout: Tiles | Groups | GroupsEstimate
    crop: Crop
    interpolator: Interpolator
    resampling: Resampling
    phase_terms: int
    one_cubic: bool

    def describe(self) -> str:
        """Return the interpolation in words."""
        taps, ratio = self.interpolator.taps, self.resampling.ratio
        return f"{taps} taps on lines upsampled {ratio:.3g} times"

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
    lines, grid, beam, spectrum = scene.lines, scene.grid, scene.beam, scene.spectrum
    width = device.info.width
    if not scene.is_reached and not estimate:
        # Nothing is formed, but to lay out distant pixels would take long.
        grid = Grid.points(grid.spread(1))

    # Share the allowed error out: the geometry and the phases may add a little to it.
    accuracy_db = scene.ambiguity.of_passed_db(accuracy_db)
    if taps is not None and upsampling is not None:
        geometry_error, phase_terms = GEOMETRY_ERROR, kernels.PHASE_TERMS[-1]
    else:
        geometry_error = max(GEOMETRY_ERROR, amplitude(accuracy_db + _GEOMETRY_SHARE_DB))
        phase_terms = kernels.phase_terms_within(accuracy_db, kernels.EXACT_PHASE_SHARE)

    # All positions from which ranges or aspect angles are measured.
    antennas_m = lines.tx_m
    if not lines.is_monostatic:
        antennas_m = np.unique(np.concatenate([lines.tx_m, lines.rx_m]), axis=0)
    if beam is not None:
        antennas_m = np.concatenate([antennas_m, lines.phase_centres_m])
    # An error of a range shifts the phase as well as the position at which a line is interpolated.
    cycles_per_m = math.hypot(
        cycles_per_m_at(lines, spectrum.centre), _BAND_RMS / lines.range_step_m
    )
    fullness = 1.0  # relative errors of a beam's weights grow by the inverse
    if beam is not None and scene.along is not None:
        some = some_channels(lines.channels, _SAMPLED_CHANNELS)
        sine = sines(grid.spread(), lines.phase_centres_m[some], scene.along[some])
        fullness = beam.fullness(sine, wavelength_m(lines), len(some) / lines.channels)

    # Divide the grid into tiles if their errors are small enough, else into groups.
    layout: Tiles | Groups | GroupsEstimate
    tiles = fitting_tiles(
        grid,
        width,
        antennas_m,
        cycles_per_m,
        error=geometry_error,
        speed_ratio=fastest(lines),
        beam=beam,
        fullness=fullness,
    )
    radius_m = largest_radius_m(len(antennas_m), cycles_per_m)
    if tiles is not None:
        layout = tiles
    elif estimate:  # groups are assumed to be no wider than the lines are long
        radius_m = min(radius_m, lines.length * lines.range_step_m)
        layout = GroupsEstimate(grid, item_pixels(width), radius_m, windows)
    else:
        layout = gather(grid, radius_m, width)

    # Upsample only what pixels need. Corrections of ranges are not known here.
    crop = Crop.whole(lines)
    if scene.is_reached and scene.water.corrections is None:
        is_fixed = taps is not None and upsampling is not None
        error_db = BEST_ACCURACY_DB if is_fixed else accuracy_db
        crop = Crop.to_grid(lines, grid, spectrum, error_db)

    # Interpolate as fast as what is left of the allowed error permits.
    costs = lookup_costs(device)

    def lookup_cost(taps: int, upsampling: float) -> float:
        samples_per_m = upsampling / lines.range_step_m
        return costs[lookup_options(device, layout, lines, samples_per_m, taps)["PERMUTE"]]

    choose = partial(
        interpolation.choose,
        spectrum,
        scene.ambiguity.rest_db(accuracy_db, 0.0 if estimate else scene.left_out_error),
        taps=taps,
        other_error=math.hypot(geometry_error, kernels.phase_error(phase_terms)),
        pixels_per_sample=grid.size / crop.length,
        lookup_cost=lookup_cost,
    )
    interpolator = choose(upsampling=upsampling)
    # A wave is a small part of a sample if the band is narrow, and positions are rounded.
    rounding = 2 * np.pi * cycles_per_m * lines.range_step_m * _ROUNDED
    if upsampling is None and rounding > geometry_error * interpolator.upsampling:
        enough = min(rounding / geometry_error, interpolation.MOST_UPSAMPLING)
        interpolator = choose(upsampling=enough)
    resampling = interpolation.resampling(crop.length, interpolator, spectrum)
    if isinstance(layout, GroupsEstimate):
        return Decision(layout, crop, interpolator, resampling, phase_terms, one_cubic=False)

    _check_distances(antennas_m, layout)
    one_cubic = False
    if beam is not None:
        nearest_m = max(layout.nearest_m(lines.phase_centres_m) - layout.radius_m, SAME_PLACE_M)
        error = layout.one_cubic_error(beam, nearest_m, wavelength_m(lines))
        one_cubic = error <= geometry_error * fullness
    return Decision(layout, crop, interpolator, resampling, phase_terms, one_cubic)


def fitting_tiles(
    grid: Grid,
    width: int,
    antennas_m: NDArray[np.float64],
    cycles_per_m: float,
    *,
    error: float = GEOMETRY_ERROR,
    speed_ratio: float = 0.0,
    beam: BeamWindow | None = None,
    fullness: float = 1.0,
) -> Tiles | None:
    """Return the tiles with which an image is formed fastest; None if groups have to be used.

    These are the largest tiles with errors below -90 dB, if there are any, and otherwise the
    largest within the allowed error. Groups are used near the antennas, where even the smallest
    tile is too large, and for pixels off a plane.

    Parameters
    ----------
    grid : Grid
    width : int
        Float lanes per work-item.
    antennas_m : float64 [n, 3]
        All transmitter and receiver positions and, with a beam, the phase centres.
    cycles_per_m : float
        Phase per metre of range, cycles: two over the wavelength.
    error : float
        Relative rms error that the geometry may add.
    speed_ratio : float
        Speed of the fastest receiver over the sound speed.
    beam : BeamWindow, optional
        Weights of the channels.
    fullness : float
        `BeamWindow.fullness` over the grid. Allowed errors of the weights are multiplied by it.

    Notes
    -----
    Ranges of a tile are expanded to third order about its centre. The remainder is at most
    r^4/(8 R^3), where r is half the diagonal of the tile and R the distance of the nearest antenna.
    Its rms over pixels and directions is 0.15 of that. The third order neglects the motion of
    receivers, which adds 0.2 r^3/R^2 times the speed ratio. With a beam, the sine of the aspect
    angle is also expanded to third order. Its error may be a millionth of the beam's width, or the
    square of the allowed error if that is larger, but never less than the 1e-7 of float32. A block,
    over which one cubic represents the weights, must be small compared with the beam's edge.
    """
    if not grid.is_planar:
        return None
    candidates = []
    for side in _SIDES:
        tiles = Tiles(grid, side, width)
        radius_m, nearest_m = tiles.radius_m, max(tiles.nearest_m(antennas_m), SAME_PLACE_M)
        remainder_m = _FOURTH_ORDER * radius_m**4 / nearest_m**3
        remainder_m += _MOTION * speed_ratio * radius_m**3 / nearest_m**2
        rounding = rounding_error(len(antennas_m)) * cycles_per_m * radius_m * tiles.eccentricity
        of_pixels = math.hypot(2 * math.pi * cycles_per_m * remainder_m, rounding)
        if beam is not None:
            of_weights = beam.block_error(tiles.block_radius_m / nearest_m) / fullness
            of_pixels = max(of_pixels, of_weights)
        candidates.append((tiles, of_pixels, _SINE_REMAINDER * (radius_m / nearest_m) ** 4))
    # Tiles that are just fine enough for the allowed error are still much faster than groups.
    for most in (GEOMETRY_ERROR, error):
        most_of_sines = math.inf
        if beam is not None:
            of_width = max(_SINE_ERROR, (most * fullness) ** 2)
            most_of_sines = max(of_width * sine_width(beam.limits), _SINE_ROUNDING)
        for tiles, of_pixels, of_sines in candidates:
            if of_pixels <= most and of_sines <= most_of_sines:
                return replace(tiles, cosines=tiles.cosines_of(antennas_m))
    return None


def largest_radius_m(channels: int, cycles_per_m: float) -> float:
    """Return the largest distance of a pixel from the centre of its group, metres.

    Farther away, the rounding of phases in float32 would add more than `GEOMETRY_ERROR`.
    """
    with np.errstate(divide="ignore"):
        return float(GEOMETRY_ERROR / rounding_error(channels) / np.float64(cycles_per_m))


def rounding_error(channels: int) -> float:
    """Return the rms error of a phase, radians, per cycle over the radius of a part.

    Coefficients are rounded once per part and channel. The error of a single channel depends on its
    direction from the part. The errors of many channels average out.
    """
    excess = _ONE_CHANNEL / channels if channels <= _FEW_CHANNELS else 0.0
    return ROUNDING * math.sqrt(1 + excess)


def _check_distances(antennas_m: NDArray[np.float64], layout: Tiles | Groups) -> None:
    """Raise ValueError for distances so large that their squares overflow float32."""
    points_m = np.concatenate([antennas_m, layout.centres_m(slice(None))])
    extent_m = float(np.ptp(points_m, axis=0).max())
    if extent_m > validate.FARTHEST_M:
        allowed = f"lie within {validate.FARTHEST_M:g} m of the antennas"
        raise ArgumentError("grid", allowed, f"{extent_m:g} m")
