"""Autofocus in the time domain: correct a track with the brightest responses of an image.

An image is formed, and its brightest local maxima are taken as responses. The contribution of each
ping to each response is read from the lines along the current track. Errors of the track are
estimated from coarse to fine: from the drift of responses between subapertures, from their phase
steps between pings, and from their sharpness as a function of each ping (`responses.py` has these
estimates). Each estimate is a *position* of the sonar, not a phase, so that the beam may be wide
and the grid and track may have any shape. A correction is kept only if it makes the image sharper.

Two things would be mistaken for errors of the track, and are detected: pings that the platform
recorded standing still, and a wrong sound speed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import reprs, validate
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.contrast import contrast
from clsas.engine.data.declared import Names, check_declared
from clsas.engine.data.georeference import placed
from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Image
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.validate import ArgumentError
from clsas.engine.device.device import Device, open_device
from clsas.engine.forming import form, scene_of_plan
from clsas.engine.imaging import plan
from clsas.engine.signal.interpolation import Readout
from clsas.engine.water.refraction import homogeneous
from clsas.navigation.checks import (
    check_navigation,
    first_bank,
    mean_wavelength_m,
    range_cell_m,
)
from clsas.navigation.responses import (
    READ_DB,
    Contributions,
    Passage,
    brightest,
    contributions,
    disagreement_m,
    drift_m,
    phase_gradient_m,
    sharpest_m,
)

UNKNOWNS = ("sway", "heave", "surge")

IMAGE_TOLERANCE_DB = -30.0
"""Tolerance of the images formed on the way. Their errors are far below the responses."""
MOST_DISAGREEMENT = 1 / 40
"""Wavelengths of range by which halves of the responses may disagree about single pings. Over 400
pings, responses of speckle disagree by at least 0.044, and bright ones by 0.011 to 0.016."""

_DRIFTS = 3  # most estimates of drift
_NEIGHBOURHOODS = (3.0, 2.0, 1.0)  # lengths along the track around responses, Fresnel lengths
_SWEEPS = 2  # most estimates from single pings
# Most responses that are used, and those that are used first, to check the geometry.
_RESPONSES, _FIRST_RESPONSES = 200, 40
# Mean number of responses that a ping receives among those from which drift is estimated. With too
# few, a stretch of a long track may stay off by half a wavelength. With too many, some responses
# are side lobes, not echoes.
_RECEIVED_FOR_DRIFT = 18
_OFFSETS = np.arange(-4.0, 5.0)  # offsets in range of the images that drift compares, samples
_LEAST_RESPONSES = 8  # responses that are needed to compare two halves
_LEAST_GRADIENT = 0.05  # smallest rms change in range per displacement
_MOST_CONDITION = 1e3  # largest condition number at which unknowns are distinguishable
_APART = 4.0  # least distance between responses, range resolution cells
# A step is repeated if it increases the sharpness by this factor and also moves the track by this
# many wavelengths rms. Finer steps find smaller errors.
_GAIN, _LARGE_CHANGE = 1.02, 1 / 8
# Wavelengths rms by which a step must move the track for an image to be formed. Smaller steps
# change the sharpness by 0.2 % at most.
_LEAST_CHANGE = 1 / 400
_NO_RESPONSES = "the scene has no bright responses to focus on"

# Halts: pings that a platform recorded standing still while its navigation moved.
# Length of a stretch in Fresnel lengths. Over it, an echo from broadside has 1/16 of its power in
# common, and other echoes less. Over half of it, the share would be 1/5.
_STRETCH = 4.0
_LEAST_PINGS = 8  # pings in a stretch
_READ_PINGS, _READ_RECEIVERS = 32, 4  # most pings and receivers of a stretch that are compared
# Largest share of the power that pings of a passage have in common. Passages over points and
# speckle reach 0.03. Halts have 0.56 if noise is as strong as the echoes.
_MOST_COMMON = 0.3
# Largest share predicted by the navigation for which halts and passages differ. Straight tracks
# have up to 0.07, and a circle about the only response has 1.
_MOST_EXPECTED = 0.2

# A wrong sound speed.
# Share of the variance of a correction that a parabola must explain before a wrong sound speed is
# suspected. It is 0.997 for speeds that are off by 1 %, and one smooth random sway in twenty also
# reaches 0.95.
_LEAST_PARABOLA = 0.95
_MOST_SPEED_ERROR = 0.05  # of the sound speed; water has 1400 to 1600 m/s
_LEAST_BEND = 1 / 50  # rms bend in wavelengths below which an image does not change
_LEAST_FITTED = 4  # pings that determine a parabola


def autofocus(
    lines: RangeLines,
    grid: Grid,
    *,
    beam: BeamWindow | None = None,
    unknowns: Annotated[
        Sequence[str], Names(UNKNOWNS, help="Displacements of the track to solve for.")
    ] = ("sway",),
    device: Device | str | int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Autofocus:
    """Return lines whose track is corrected by the bright responses of an image.

    Parameters
    ----------
    lines : RangeLines
        At least ten pings, monostatic, bistatic, or of an array. Of several receiver banks, the
        first one is focused, and all of them are corrected.
    grid : Grid
        Pixels among which responses are searched. Part of the scene is enough if it has a dozen or
        so bright responses.
    beam : BeamWindow, optional
        Weights of the channels.
    unknowns : sequence of {"sway", "heave", "surge"}
        Displacements to solve for: across the track, up, and along it. To solve for several, the
        responses must see the sonar from different directions.
    device : Device, str or int, optional
        See `clsas.engine.device.device.choose`.
    progress : callable, optional
        Called as progress(steps done, steps).

    Returns
    -------
    Autofocus

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type, there are too few pings, or the unknowns cannot be
        distinguished in this geometry.
    DeviceError
        If there is no such device.

    Warns
    -----
    ClsasWarning
        If the scene has no responses, or pings receive the same echoes although the navigation
        moves; the lines are then returned unchanged. If a wrong sound speed explains the
        correction. If pings repeat a position; they are corrected as one ping. If the track turns
        back, so that pings may be out of order.

    See Also
    --------
    micronavigate : Corrects the track of an array from overlapping phase centres.
    calibrate_track : Corrects timing, sound speed and lever arm from known reflectors.

    Notes
    -----
    Each of the following steps displaces the pings. It is kept if the image becomes sharper.

    1. Images of short subapertures are compared. The drift of responses between them shows errors
       beyond the range resolution, as in map drift [1]_.
    2. The phase steps of responses from ping to ping are made linear, as in phase-gradient
       autofocus [2]_, within smaller and smaller neighbourhoods of the responses.
    3. The sharpness of the responses is maximised over the position of every single ping, as in
       closed-form backprojection autofocus [3]_.

    References
    ----------
    .. [1] Carrara, Goodman, Majewski, "Spotlight synthetic aperture radar: signal processing
       algorithms", Artech House, 1995, chapter 6.
    .. [2] Wahl, Eichel, Ghiglia, Jakowatz, "Phase gradient autofocus - a robust tool for high
       resolution SAR phase correction", IEEE Transactions on Aerospace and Electronic Systems 30,
       1994.
    .. [3] Ash, "An autofocus method for backprojection imagery in synthetic aperture radar", IEEE
       Geoscience and Remote Sensing Letters 9, 2012.

    Examples
    --------
    A sonar passes some points and sways by millimetres, and its navigation does not contain the
    sway:

    >>> from dataclasses import replace
    >>> import numpy as np
    >>> from scipy.signal import detrend
    >>> import clsas
    >>> pulse = clsas.Pulse(carrier_hz=100e3, bandwidth_hz=30e3, duration_s=1e-3)
    >>> sonar = clsas.Sonar(pulse, [[0, 0, 0]], tx_length_m=0.06, rx_length_m=0.06)
    >>> xyz_m = np.random.default_rng(0).uniform([0.6, 9.5, 0], [2.4, 11, 0], (30, 3))
    >>> points = clsas.PointTargets(xyz_m, np.ones(30))
    >>> course = (0, 0, 0), (0.02, 0, 0), 150, 1.0
    >>> sway_m = 3e-3 * np.sin(np.arange(150) / 20)
    >>> true = clsas.Track.straight(*course, sway_m=sway_m)
    >>> lines = clsas.compress(clsas.simulate(sonar, true, points, range_m=(9, 12)))
    >>> navigated = clsas.channels(sonar, clsas.Track.straight(*course))
    >>> lines = replace(lines, tx_m=navigated.tx_m, rx_m=navigated.rx_m)
    >>> grid = clsas.Grid.plane(x=(0.4, 2.6, 100), y=(9.3, 11.2, 120))
    >>> found = clsas.autofocus(lines, grid)
    >>> found.focused, found.sharpness_after > 2 * found.sharpness_before
    (True, True)
    >>> bool(np.std(detrend(found.correction_m[:, 1] - sway_m)) < 1e-4)
    True
    """
    validate.instance("lines", lines, RangeLines)
    validate.instance("grid", grid, Grid)
    placed(lines, grid)  # raises if the georeferences differ
    if beam is not None:
        validate.instance("beam", beam, BeamWindow)
    validate.progress(progress)
    names = check_declared(autofocus, {"unknowns": unknowns})["unknowns"]
    check_navigation(lines, 10, "autofocus", may_stand=True)
    bank = first_bank(lines)
    # Antennas move alike in the water of a profile and in the homogeneous water that replaces it.
    water = homogeneous(bank, grid, beam, IMAGE_TOLERANCE_DB, corrected=False)
    straight = water.lines(bank)

    # Samples are scaled to about 1, so that squared intensities stay within float32. Scaling by a
    # power of two leaves their digits unchanged.
    scaled, largest = straight, float(np.abs(straight.samples).max())
    if largest:
        scale = np.float32(2.0 ** -np.clip(math.frexp(largest)[1], -126, 126))
        scaled = replace(straight, samples=straight.samples * scale)
    readout = Readout.of(scaled, READ_DB)
    passage = Passage.of(straight, names, mean_wavelength_m(readout))
    focus = _Focus(readout, water.grid, passage, water.beam, open_device(device))
    focus.check_geometry(names)
    obstacle = focus.improve(progress)
    if obstacle:
        validate.warn(f"{obstacle}. The lines are left as they were")
        moved_m, deviation_m = np.zeros_like(focus.moved_m), np.full(passage.pings, np.inf)
    else:
        moved_m, deviation_m = focus.moved_m, focus.deviation_m
        _check_speed(passage, focus.responses, moved_m)

    # The correction applies to the channels of all banks.
    ping = lines.ping_numbers
    vectors_m = passage.vectors_m(moved_m)[straight.ping_starts[ping]]
    return Autofocus(
        lines=replace(lines, tx_m=lines.tx_m + vectors_m, rx_m=lines.rx_m + vectors_m),
        correction_m=vectors_m,
        correction_sd_m=deviation_m[ping],
        sharpness_before=focus.before,
        sharpness_after=focus.before if obstacle else focus.sharpness,
        sharpness=tuple(focus.steps),
        focused=not obstacle,
    )


class _Focus:
    """Lines, their image, and the correction found so far."""

    def __init__(
        self,
        readout: Readout,
        grid: Grid,
        passage: Passage,
        beam: BeamWindow | None,
        device: Device,
    ) -> None:
        self.readout, self.grid, self.passage, self.beam = readout, grid, passage, beam
        self.device = device
        self.deviation_m = np.full(passage.pings, np.inf)
        self.steps: list[tuple[str, float]] = []
        # The track changes little between images, so that one plan serves all of them.
        self.plan = plan(
            readout.lines, grid, tolerance_db=IMAGE_TOLERANCE_DB, beam=beam, device=device
        )
        moved_m = np.zeros((len(passage.axes), passage.pings))
        image = self._form(moved_m)
        self.before = _sharpness(image)
        self._keep(moved_m, image, self.before)

    def check_geometry(self, names: tuple[str, ...]) -> None:
        """Refuse unknowns that the responses do not determine.

        Also choose how many responses are needed to estimate drift.
        """
        found = self._contributions(self.points_m[:_FIRST_RESPONSES], self.moved_m)
        # A response is received by the share (sum p)^2/(n sum p^2) of n channels, for the powers p.
        # Channels with equal power thus count fully, and weaker ones count less.
        power = np.square(np.abs(found.values[..., 0]), dtype=np.float64)
        squares = np.maximum(len(power) * np.sum(power**2, axis=0), 1e-300)
        share = float(np.median(power.sum(axis=0) ** 2 / squares))
        self.for_drift = math.ceil(_RECEIVED_FOR_DRIFT / min(max(share, 1 / len(power)), 1.0))
        weights = np.abs(found.values[..., 0]) ** 2
        total = max(float(weights.sum()), 1e-300)
        for name, gradient in zip(names, found.gradient, strict=True):
            change = math.sqrt(float(np.sum(weights * gradient**2)) / total)
            if weights.any() and change < _LEAST_GRADIENT:
                raise ArgumentError(
                    "unknowns",
                    "change the range to the responses by at least "
                    f"{_LEAST_GRADIENT:g} m rms per metre",
                    f"{name}, which changes it by {change:.2g} m",
                )
        if len(names) == 1:
            return
        normal = np.einsum("ucp,vcp,cp->uv", found.gradient, found.gradient, weights)
        scale = np.sqrt(np.diag(normal))
        correlation = normal / np.maximum(np.outer(scale, scale), 1e-300)
        condition = float(np.linalg.cond(correlation))
        if not condition < _MOST_CONDITION:
            raise ArgumentError(
                "unknowns",
                "be distinguishable",
                names,
                "all responses see the sonar from nearly the same direction (condition number "
                f"{condition:.3g}, at most {_MOST_CONDITION:g})",
            )

    def improve(self, progress: Callable[[int, int], None] | None) -> str:
        """Estimate the track from coarse to fine; return what makes that impossible, or ""."""
        responses = len(self.points_m) if self.before else 0
        if responses < _LEAST_RESPONSES:
            return (
                f"{_NO_RESPONSES}: the grid has {responses} responses, and at least "
                f"{_LEAST_RESPONSES} are needed"
            )
        stood = halt(self.passage, self.readout, self.responses)
        if stood is not None:
            return (
                f"pings {stood[0]} to {stood[1]} receive the same echoes, although the navigation "
                "moves: the platform stood still, or the scene is the same all along the track (a "
                "wall, a pipe, or a background that all pings share)"
            )
        stages: list[tuple[str, Callable[[], NDArray[np.float64] | None]]] = [
            *[("drift between subapertures", self._drift)] * _DRIFTS,
            ("phase gradients", self._phase_gradients),
            *[("sharpness of single pings", self._single_pings)] * _SWEEPS,
        ]
        dropped = ""
        for number, (name, estimate) in enumerate(stages, start=1):
            # A step that gained little would gain little again.
            if name != dropped and not self._try(name, estimate()):
                dropped = name
            if progress is not None:
                progress(number, len(stages))
        apart = disagreement_m(self.passage, self.responses) / self.passage.wavelength_m
        if apart > MOST_DISAGREEMENT:
            return (
                f"{_NO_RESPONSES}: two halves of the responses give displacements of single pings "
                f"that differ by {apart:.2g} wavelengths rms, and at most {MOST_DISAGREEMENT:g} is "
                "expected"
            )
        return ""

    def _drift(self) -> NDArray[np.float64] | None:
        """Return displacements from the drift between subapertures, if there are enough of them."""
        offsets_m = self.readout.lines.range_step_m * _OFFSETS
        found = self._contributions(self.points_m[: self.for_drift], self.moved_m, offsets_m)
        return drift_m(self.passage, found)

    def _phase_gradients(self) -> NDArray[np.float64]:
        """Return displacements from the phase steps between pings."""
        found, total_m = self.responses, np.zeros_like(self.moved_m)
        for neighbourhood in _NEIGHBOURHOODS:
            if total_m.any():
                found = self._contributions(self.points_m, self.moved_m + total_m)
            length_m = neighbourhood * self.passage.fresnel_length_m(found)
            total_m = total_m + phase_gradient_m(self.passage, found, length_m)
        return total_m

    def _single_pings(self) -> NDArray[np.float64]:
        """Return displacements that maximise the sharpness ping by ping."""
        found_m, self.deviation_m = sharpest_m(self.passage, self.responses)
        return found_m

    def _try(self, name: str, found_m: NDArray[np.float64] | None) -> bool:
        """Keep a correction if it makes the image sharper; return whether to repeat the step."""
        if found_m is None:
            return False
        # The mean and the linear trend of a track cannot be observed.
        moved_m, along_m = self.moved_m + found_m, self.passage.along_m
        design = np.stack([np.ones_like(along_m), along_m - along_m.mean()], axis=1)
        moved_m = moved_m - (design @ np.linalg.lstsq(design, moved_m.T, rcond=None)[0]).T
        change_m = math.sqrt(float(np.mean(np.sum((moved_m - self.moved_m) ** 2, axis=0))))
        change = change_m / self.passage.wavelength_m
        if change <= _LEAST_CHANGE:
            return False
        image = self._form(moved_m)
        reached, before = _sharpness(image), self.sharpness
        self.steps.append((name, reached))
        if reached > before:
            self._keep(moved_m, image, reached)
        return reached > _GAIN * before and change > _LARGE_CHANGE

    def _keep(self, moved_m: NDArray[np.float64], image: Image, reached: float) -> None:
        """Set the current track, and find the brightest responses of its image."""
        self.moved_m, self.sharpness = moved_m, reached
        self.points_m = brightest(image, _RESPONSES, _APART * range_cell_m(self.readout))
        if not len(self.points_m):
            self.points_m = self.grid.positions_m().reshape(-1, 3)[:1]
        self.found: Contributions | None = None

    @property
    def responses(self) -> Contributions:
        """Contributions to the brightest responses of the current image."""
        if self.found is None:
            self.found = self._contributions(self.points_m, self.moved_m)
        return self.found

    def _contributions(
        self,
        points_m: NDArray[np.float64],
        moved_m: NDArray[np.float64],
        offsets_m: NDArray[np.float64] | None = None,
    ) -> Contributions:
        """Return the contributions of displaced pings to points."""
        lines = self._lines(moved_m)
        return contributions(self.passage, self.readout, lines, points_m, self.beam, offsets_m)

    def _form(self, moved_m: NDArray[np.float64]) -> Image:
        """Return the image of displaced pings."""
        scene = scene_of_plan(self._lines(moved_m), self.grid, self.plan)
        return form(scene, self.plan, self.device)

    def _lines(self, moved_m: NDArray[np.float64]) -> RangeLines:
        """Return the lines of displaced pings."""
        vectors_m, lines = self.passage.vectors_m(moved_m), self.readout.lines
        return replace(lines, tx_m=lines.tx_m + vectors_m, rx_m=lines.rx_m + vectors_m)


def _sharpness(image: Image) -> float:
    """Return the mean squared intensity of an image over its squared mean intensity."""
    return 1 + contrast(image) ** 2 if image.pixels.any() else 0.0


def halt(passage: Passage, readout: Readout, found: Contributions) -> tuple[int, int] | None:
    """Return the first and last ping of the longest halt that the navigation does not contain.

    All pings of a halt receive the same echoes. If a platform moves, pings of a stretch of several
    Fresnel lengths have little in common, because the phase of every echo turns by cycles. The
    navigation predicts how much they should have in common. A wall or a pipe along the track also
    gives the same echoes everywhere, and a halt cannot then be distinguished from a passage.

    Parameters
    ----------
    passage : Passage
        Passage according to the navigation.
    readout : Readout
        The lines.
    found : Contributions
        Contributions to the brightest responses along the navigated track. Pings are compared at
        the ranges of these responses.

    Returns
    -------
    (first, last) or None
        None if pings have little in common, or as much as the navigation predicts.
    """
    # The track is divided into stretches of about the same length, each with enough pings.
    along_m = passage.along_m
    length_m = _STRETCH * passage.fresnel_length_m(found)
    count = max(int((along_m[-1] - along_m[0]) / length_m), 1)
    starts_m = along_m[0] + (along_m[-1] - along_m[0]) * np.arange(1, count) / count
    edges = [0]
    for edge in [*np.searchsorted(along_m, starts_m).tolist(), passage.pings]:
        if edge - edges[-1] >= _LEAST_PINGS:
            edges.append(edge)
    if len(edges) > 1:
        edges[-1] = passage.pings

    halts: list[tuple[int, int]] = []
    for first, stop in pairwise(edges):
        if _expected_share(passage, found, first, stop) > _MOST_EXPECTED:
            continue
        if _common_share(passage, readout, found, first, stop) <= _MOST_COMMON:
            continue
        if halts and halts[-1][1] >= first - 1:
            halts[-1] = halts[-1][0], stop - 1
        else:
            halts.append((first, stop - 1))
    return max(halts, key=lambda each: each[1] - each[0], default=None)


def _expected_share(passage: Passage, found: Contributions, first: int, stop: int) -> float:
    """Return the share of the power that pings have in common if the navigation is correct."""
    some = np.flatnonzero((passage.ping >= first) & (passage.ping < stop))
    if not len(some):
        return 1.0
    turns = 2 * found.range_m[some] / passage.wavelength_m
    common = np.abs(np.mean(np.exp(2j * np.pi * turns), axis=0)) ** 2
    brightness = np.abs(np.sum(found.values[some, :, 0], axis=0, dtype=np.complex128)) ** 2
    total = float(brightness.sum())
    return float(brightness @ common) / total if total else 1.0


def _common_share(
    passage: Passage, readout: Readout, found: Contributions, first: int, stop: int
) -> float:
    """Return the share of the power that all pings of a stretch have in common.

    Its expectation is 0 for independent pings. All pings count equally, whatever their level.
    """
    lines = passage.lines
    starts = lines.ping_starts
    counts = np.diff(np.append(starts, lines.channels))[first:stop]
    pings = first + _evenly_spaced(stop - first, _READ_PINGS)
    shares = []
    for receiver in _evenly_spaced(int(counts.min()), _READ_RECEIVERS).tolist():
        # All pings are read at the ranges of the responses that they share.
        channels = starts[pings] + receiver
        range_m, nearest_m = found.range_m[channels], lines.first_range_m[channels]
        least_m = max(float(range_m.min()), float(nearest_m.max()))
        most_m = min(float(range_m.max()), float(lines.last_range_m[channels].min()))
        at_m = np.arange(least_m, most_m + lines.range_step_m, lines.range_step_m)
        at_m = np.broadcast_to(at_m, (len(channels), len(at_m)))
        values = readout.read(channels, at_m).astype(np.complex128)

        power = np.sum(np.abs(values) ** 2, axis=1)
        received = power > 0
        number = int(received.sum())
        if number < _LEAST_PINGS:
            continue
        unit = values[received] / np.sqrt(power[received])[:, None]
        mean = float(np.sum(np.abs(unit.mean(axis=0)) ** 2))
        shares.append((number * mean - 1) / (number - 1))
    return sum(shares) / len(shares) if shares else 0.0


def _evenly_spaced(count: int, most: int) -> NDArray[np.int64]:
    """Return up to `most` of `count` numbers."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.int64))


def _check_speed(passage: Passage, found: Contributions, moved_m: NDArray[np.float64]) -> None:
    """Warn if a wrong sound speed explains a correction, [unknowns, pings].

    The range to a response, as a function of the position along a straight track, has the curvature
    1/R. Suppose that ranges are too large by a share e, so that a response appears at (1 + e) R.
    Its ranges are then curved too strongly, by 2 e/R. A track that bends away from the scene by e
    x^2/R compensates this for every response along the track. Only responses at very different
    ranges would reveal the difference.
    """
    power = passage.by_ping(np.abs(found.values[..., 0]).astype(np.float64) ** 2)
    total = power.sum(axis=1)
    received = np.flatnonzero(total > 0)
    if len(received) < _LEAST_FITTED:
        return

    # Is the correction a parabola that is large enough to matter?
    gradient = np.stack([passage.mean_by_ping(each) for each in found.gradient])
    each_m = np.einsum("upk,up->pk", gradient, moved_m)
    longer_m = np.sum(power * each_m, axis=1)[received] / total[received]
    at_m = passage.along_m[received] - passage.along_m[received].mean()
    longer_m = longer_m - np.polyval(np.polyfit(at_m, longer_m, 1), at_m)
    parabola = np.polyfit(at_m, longer_m, 2)
    bend_m = np.polyval(parabola, at_m)
    if bend_m.std() < _LEAST_BEND * passage.wavelength_m:
        return
    if bend_m.var() < _LEAST_PARABOLA * longer_m.var():
        return

    # A curved track changes the curvature of ranges, so that it is measured, response by response.
    range_m = passage.mean_by_ping(found.range_m)
    bends = []
    for response in np.flatnonzero(power.any(axis=0)).tolist():
        some = power[:, response] > 0
        if some.sum() < _LEAST_FITTED:
            continue
        weights = np.sqrt(power[some, response])
        at_m = passage.along_m[some] - passage.along_m[some].mean()
        bends.append(np.polyfit(at_m, range_m[some, response], 2, w=weights)[0])
    mean_m = float(np.sum(power * range_m) / np.sum(power))
    error = float(parabola[0] / (float(np.median(bends)) + 1 / (2 * mean_m)))
    if abs(error) > _MOST_SPEED_ERROR:
        return
    given_m_s = passage.lines.sound_speed_m_s
    side = "lower" if error > 0 else "higher"
    validate.warn(
        "the correction found is a parabola along the track, and a wrong sound speed may be the "
        f"cause: {given_m_s / (1 + error):.5g} m/s, {100 * abs(error):.2g} % {side} than the "
        f"{given_m_s:.5g} m/s of the lines, explains it without any bend of the track. Check the "
        "sound speed, for instance with `clsas.calibrate_track`"
    )


@dataclass(frozen=True, eq=False)
class Autofocus:
    """Result of autofocus.

    Attributes
    ----------
    lines : RangeLines
        The given lines with corrected positions.
    correction_m : float64 [channels, 3]
        Displacement that was added to transmitters and receivers.
    correction_sd_m : float64 [channels]
        Standard deviation of the change of the correction from ping to ping. A shift and a linear
        trend of the track cannot be observed, and remain as they were.
    sharpness_before, sharpness_after : float
        Mean squared intensity of the image over its squared mean intensity. It is 2 for speckle,
        and larger for sharper images.
    sharpness : tuple of (step, float)
        Sharpness after each step that was tried.
    focused : bool
        False if the scene has no responses to focus on, or if the platform stood still. The lines
        are then unchanged.

    See Also
    --------
    autofocus : Function that returns this result.
    """

    lines: RangeLines
    correction_m: NDArray[np.float64]
    correction_sd_m: NDArray[np.float64]
    sharpness_before: float
    sharpness_after: float
    sharpness: tuple[tuple[str, float], ...]
    focused: bool

    @property
    def figures(self) -> dict[str, Any]:
        """Size and uncertainty of the correction and the gain in sharpness, as numbers."""
        return {
            "focused": self.focused,
            "correction_rms_m": float(np.sqrt(np.mean(np.sum(self.correction_m**2, axis=1)))),
            "correction_sd_m": float(np.median(self.correction_sd_m)) if self.focused else None,
            "sharpness_before": self.sharpness_before,
            "sharpness_after": self.sharpness_after,
        }

    def __repr__(self) -> str:
        """Return the rms correction and the sharpness before and after."""
        return reprs.summary(
            self,
            f"correction {reprs.quantity(self.figures['correction_rms_m'], 'm')} rms",
            f"sharpness {self.sharpness_before:.3g} to {self.sharpness_after:.3g}",
            None if self.focused else "not focused",
        )
