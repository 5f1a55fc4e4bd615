"""Autofocus in the time domain: correct a track with the brightest responses of an image.

An image is formed, and its brightest local maxima are taken as responses. The contribution of each
ping to each response is read from the lines along the current track. Errors of the track are
estimated from coarse to fine: from the drift of responses between subapertures
(`clsas.navigation.drift`), from their phase steps between pings, and from their sharpness as a
function of each ping (`clsas.navigation.gradient`). Each estimate is a *position* of the sonar, not
a phase, so that the beam may be wide and the grid and track may have any shape. A correction is
kept only if it makes the image sharper.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import validate
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
from clsas.navigation.autofocus_result import Autofocus
from clsas.navigation.checks import (
    check_navigation,
    first_bank,
    mean_wavelength_m,
    range_cell_m,
)
from clsas.navigation.drift import drift_m
from clsas.navigation.gradient import disagreement_m, phase_gradient_m, sharpest_m
from clsas.navigation.halts import halt
from clsas.navigation.responses import (
    READ_DB,
    Contributions,
    Passage,
    brightest,
    contributions,
    received_share,
)
from clsas.navigation.speed_check import check_speed

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
        Pixels among which responses are searched. Part of the scene is enough if it has a few dozen
        bright responses.
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
    readout = Readout.of(_of_unit_level(straight), READ_DB)
    passage = Passage.of(straight, names, mean_wavelength_m(readout))
    focus = _Focus(readout, water.grid, passage, water.beam, open_device(device), progress)
    focus.check_geometry(names)
    return _of_given(focus.result(), straight, lines)


def _of_given(found: Autofocus, focused: RangeLines, lines: RangeLines) -> Autofocus:
    """Return a result for the lines `focused`, applied to all channels of the same pings."""
    one_of_ping = focused.ping_starts[lines.ping_numbers]
    moved_m = found.correction_m[one_of_ping]
    return replace(
        found,
        lines=replace(lines, tx_m=lines.tx_m + moved_m, rx_m=lines.rx_m + moved_m),
        correction_m=moved_m,
        correction_sd_m=found.correction_sd_m[one_of_ping],
    )


def _of_unit_level(lines: RangeLines) -> RangeLines:
    """Return lines scaled to about 1, so that squared intensities stay within float32."""
    largest = float(np.abs(lines.samples).max())
    if not largest:
        return lines
    # Scaling by a power of two leaves the digits of all samples unchanged.
    scale = np.float32(2.0 ** -np.clip(math.frexp(largest)[1], -126, 126))
    return replace(lines, samples=lines.samples * scale)


class _Focus:
    """Lines, their image, and the correction found so far."""

    def __init__(
        self,
        readout: Readout,
        grid: Grid,
        passage: Passage,
        beam: BeamWindow | None,
        device: Device,
        progress: Callable[[int, int], None] | None,
    ) -> None:
        self.readout, lines = readout, readout.lines
        self.given, self.grid, self.passage, self.beam = lines, grid, passage, beam
        self.device, self.progress = device, progress
        self.moved_m = np.zeros((len(passage.axes), passage.pings))
        self.deviation_m = np.full(passage.pings, np.inf)
        self.for_drift = _FIRST_RESPONSES
        self.cell_m = range_cell_m(readout)
        self.steps: list[tuple[str, float]] = []
        # The track changes little between images, so that one plan serves all of them.
        self.plan = plan(lines, grid, tolerance_db=IMAGE_TOLERANCE_DB, beam=beam, device=device)
        image = self._form(self.moved_m)
        self.found: Contributions | None
        self.before = sharpness(image)
        self._keep(self.moved_m, image, self.before)

    def check_geometry(self, names: tuple[str, ...]) -> None:
        """Refuse unknowns that the responses do not determine.

        Also choose how many responses are needed to estimate drift.
        """
        found = self._contributions(self.points_m[:_FIRST_RESPONSES])
        self.for_drift = math.ceil(_RECEIVED_FOR_DRIFT / received_share(found))
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

    def result(self) -> Autofocus:
        """Estimate the track from coarse to fine, and return the result."""
        responses = len(self.points_m) if self.before else 0
        if responses < _LEAST_RESPONSES:
            return self._unfocused(
                f"{_NO_RESPONSES}: the grid has {responses} responses, and at least "
                f"{_LEAST_RESPONSES} are needed"
            )
        stood = halt(self.passage, self.readout, self._responses)
        if stood is not None:
            return self._unfocused(
                f"pings {stood[0]} to {stood[1]} receive the same echoes, although the navigation "
                "moves: the platform stood still, or the scene is the same all along the track (a "
                "wall, a pipe, or a background that all pings share)"
            )
        stages, dropped = list(self._stages()), ""
        for number, (name, find) in enumerate(stages, start=1):
            # A step that gained little would gain little again.
            if name != dropped and not self._try(name, find):
                dropped = name
            if self.progress is not None:
                self.progress(number, len(stages))
        apart = disagreement_m(self.passage, self._responses) / self.passage.wavelength_m
        if apart > MOST_DISAGREEMENT:
            return self._unfocused(
                f"{_NO_RESPONSES}: two halves of the responses give displacements of single pings "
                f"that differ by {apart:.2g} wavelengths rms, and at most {MOST_DISAGREEMENT:g} is "
                "expected"
            )
        check_speed(self.passage, self._responses, self.moved_m)
        return self._outcome(focused=True)

    def _unfocused(self, why: str) -> Autofocus:
        """Warn that the track cannot be estimated, and why, and return the lines unchanged."""
        validate.warn(f"{why}. The lines are left as they were")
        self.moved_m = np.zeros_like(self.moved_m)
        self.deviation_m = np.full_like(self.deviation_m, np.inf)
        return self._outcome(focused=False)

    def _outcome(self, *, focused: bool) -> Autofocus:
        """Return the result for the current correction."""
        vectors_m = self.passage.vectors_m(self.moved_m)
        return Autofocus(
            lines=self._lines(self.moved_m),
            correction_m=vectors_m,
            correction_sd_m=self.deviation_m[self.passage.ping],
            sharpness_before=self.before,
            sharpness_after=self.sharpness if focused else self.before,
            sharpness=tuple(self.steps),
            focused=focused,
        )

    def _stages(self) -> Iterator[tuple[str, Callable[[], NDArray[np.float64] | None]]]:
        """Yield the names of the steps and the functions that estimate displacements."""
        for _ in range(_DRIFTS):
            yield "drift between subapertures", self._drift
        yield "phase gradients", self._gradients
        for _ in range(_SWEEPS):
            yield "sharpness of single pings", self._pings

    def _drift(self) -> NDArray[np.float64] | None:
        """Return displacements from the drift between subapertures, if there are enough of them."""
        offsets_m = self.given.range_step_m * _OFFSETS
        found = self._contributions(self.points_m[: self.for_drift], offsets_m)
        return drift_m(self.passage, found)

    def _gradients(self) -> NDArray[np.float64]:
        """Return displacements from the phase steps between pings."""
        found, total_m = self._responses, np.zeros_like(self.moved_m)
        for neighbourhood in _NEIGHBOURHOODS:
            if total_m.any():
                found = self._contributions(self.points_m, moved_m=self.moved_m + total_m)
            length_m = neighbourhood * self.passage.fresnel_length_m(found)
            total_m = total_m + phase_gradient_m(self.passage, found, length_m)
        return total_m

    def _pings(self) -> NDArray[np.float64]:
        """Return displacements that maximise the sharpness ping by ping."""
        found_m, self.deviation_m = sharpest_m(self.passage, self._responses)
        return found_m

    @property
    def _responses(self) -> Contributions:
        """Contributions to the brightest responses of the current image."""
        if self.found is None:
            self.found = self._contributions(self.points_m)
        return self.found

    def _contributions(
        self,
        points_m: NDArray[np.float64],
        offsets_m: NDArray[np.float64] | None = None,
        moved_m: NDArray[np.float64] | None = None,
    ) -> Contributions:
        """Return contributions to points for the current track, or for displacements `moved_m`."""
        lines = self._lines(self.moved_m if moved_m is None else moved_m)
        return contributions(self.passage, self.readout, lines, points_m, self.beam, offsets_m)

    def _try(self, name: str, find: Callable[[], NDArray[np.float64] | None]) -> bool:
        """Keep a correction if it makes the image sharper; return whether to repeat the step."""
        found_m = find()
        if found_m is None:
            return False
        moved_m = _detrended(self.moved_m + found_m, self.passage.along_m)
        change_m = math.sqrt(float(np.mean(np.sum((moved_m - self.moved_m) ** 2, axis=0))))
        change = change_m / self.passage.wavelength_m
        if change <= _LEAST_CHANGE:
            return False
        image = self._form(moved_m)
        reached = sharpness(image)
        self.steps.append((name, reached))
        before = self.sharpness
        if reached > before:
            self._keep(moved_m, image, reached)
        return reached > _GAIN * before and change > _LARGE_CHANGE

    def _keep(self, moved_m: NDArray[np.float64], image: Image, reached: float) -> None:
        """Set the current track, and find the brightest responses of its image."""
        self.moved_m, self.sharpness, self.found = moved_m, reached, None
        self.points_m = brightest(image, _RESPONSES, _APART * self.cell_m)
        if not len(self.points_m):
            self.points_m = self.grid.positions_m().reshape(-1, 3)[:1]

    def _form(self, moved_m: NDArray[np.float64]) -> Image:
        lines = self._lines(moved_m)
        return form(scene_of_plan(lines, self.grid, self.plan), self.plan, self.device)

    def _lines(self, moved_m: NDArray[np.float64]) -> RangeLines:
        vectors_m = self.passage.vectors_m(moved_m)
        given = self.given
        return replace(given, tx_m=given.tx_m + vectors_m, rx_m=given.rx_m + vectors_m)


def sharpness(image: Image) -> float:
    """Return the mean squared intensity of an image over its squared mean intensity."""
    return 1 + contrast(image) ** 2 if image.pixels.any() else 0.0


def _detrended(moved_m: NDArray[np.float64], along_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return displacements without their mean and linear trend along the track."""
    design = np.stack([np.ones_like(along_m), along_m - along_m.mean()], axis=1)
    fitted = np.linalg.lstsq(design, moved_m.T, rcond=None)[0]
    return moved_m - (design @ fitted).T
