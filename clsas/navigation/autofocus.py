"""Autofocus in the time domain: the track that brings an image's brightest responses into focus.

An image is formed, and its brightest local maxima are taken as responses. Every ping's contribution
to each is read from the lines along the present track. From these come errors of the track, from
coarse to fine: the drift of responses between subapertures (`clsas.navigation.drift`), their phase
steps from ping to ping, and the sharpness over each single ping (`clsas.navigation.gradient`). Each
is solved as a *position* of the sonar, so that the beam may be wide and the grid and track of any
kind. Each is kept only where the image gets sharper.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from clsas.core import reprs, validate
from clsas.core.contrast import contrast
from clsas.core.grid import Grid
from clsas.core.image import Image
from clsas.core.lines import RangeLines
from clsas.navigation.checks import check_navigation, mean_wavelength_m
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
from clsas.opencl.device import Device, open_device
from clsas.planning.former import former
from clsas.planning.planner import plan
from clsas.signal.readout import Readout
from clsas.sonar.beam import BeamWindow

UNKNOWNS = ("sway", "heave", "surge")

IMAGE_TOLERANCE_DB = -30.0
"""Tolerance of the images in between: errors far below responses."""
MOST_DISAGREEMENT = 1 / 40
"""Wavelengths of range that halves of the responses may disagree about single pings. Responses of
speckle disagree by 0.044 and more, bright ones by 0.011 to 0.016 (400 pings)."""

_DRIFTS = 3  # times that drift is measured at most
_NEIGHBOURHOODS = (3.0, 2.0, 1.0)  # Fresnel lengths around responses, along the track
_SWEEPS = 2  # times that single pings are moved at most
_RESPONSES, _FIRST_RESPONSES = 200, 40
# Responses that a ping receives, on average, of those that drift is measured by. On a long track
# too few leave a stretch off by half a wavelength; too many are no echoes, but side lobes.
_RECEIVED_FOR_DRIFT = 18
_OFFSETS = np.arange(-4.0, 5.0)  # samples in range, of which drift sees images
_LEAST_RESPONSES = 8  # halves of which can agree
_LEAST_GRADIENT = 0.05  # of range per displacement, rms
_APART = 4.0  # range resolution cells between responses
_GAIN = 1.02  # of sharpness, for which a step is repeated
_LARGE_CHANGE = 1 / 8  # wavelengths rms, likewise: finer steps find what smaller ones leave
# Wavelengths rms, for which an image is formed. Less changes the sharpness by 0.2 % at most.
_LEAST_CHANGE = 1 / 400
_NO_RESPONSES = "the scene has no bright responses to focus on"


@dataclass(frozen=True, eq=False)
class Autofocus:
    """Result of autofocus.

    Attributes
    ----------
    lines : RangeLines
        The lines given, with corrected positions.
    correction_m : float64 [channels, 3]
        By how much transmitters and receivers were moved.
    correction_sd_m : float64 [channels]
        Standard deviation of the correction's change from ping to ping. A shift and a linear trend
        of the track are not observable and stay as they were.
    sharpness_before, sharpness_after : float
        Mean squared intensity over the squared mean: 2 for speckle, the more the sharper.
    sharpness : tuple of (step, float)
        Sharpness after each step that was tried.
    focused : bool
        False where the scene has no responses to focus on, or the platform stood still. The lines
        are then as they were.
    """

    lines: RangeLines
    correction_m: NDArray[np.float64]
    correction_sd_m: NDArray[np.float64]
    sharpness_before: float
    sharpness_after: float
    sharpness: tuple[tuple[str, float], ...]
    focused: bool

    def __repr__(self) -> str:
        """Return the size of the correction and both sharpnesses."""
        rms_m = float(np.sqrt(np.mean(np.sum(self.correction_m**2, axis=1))))
        return reprs.summary(
            self,
            f"correction {reprs.quantity(rms_m, 'm')} rms",
            f"sharpness {self.sharpness_before:.3g} to {self.sharpness_after:.3g}",
            None if self.focused else "not focused",
        )


def autofocus(
    lines: RangeLines,
    grid: Grid,
    *,
    beam: BeamWindow | None = None,
    unknowns: Sequence[str] = ("sway",),
    device: Device | str | int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Autofocus:
    """Correct a track by the bright responses of an image.

    Parameters
    ----------
    lines : RangeLines
        At least ten pings, monostatic, bistatic or of an array.
    grid : Grid
        Where responses are looked for: a part of the scene with some dozen bright ones is enough.
    beam : BeamWindow, optional
        Weights of the channels.
    unknowns : sequence of {"sway", "heave", "surge"}
        Displacements to solve for, across the track, up and along it. Responses must see the sonar
        from different directions to tell several apart.
    device : Device, str or int, optional
        See `clsas.opencl.device.choose`.
    progress : callable, optional
        Called as progress(steps done, steps).

    Returns
    -------
    Autofocus

    Raises
    ------
    TypeError, ValueError
        If an argument is of the wrong kind, there are too few pings, or the geometry does not tell
        the unknowns apart.
    DeviceError
        If there is no such device.

    Warns
    -----
    ClsasWarning
        If the scene has no responses, or pings receive the same echoes although the navigation
        moves: the lines are then returned as they are. If the correction is one that a wrong sound
        speed explains. If pings repeat a position: they are corrected as one. If the track turns
        back, so that pings may be out of order.
    """
    validate.instance("lines", lines, RangeLines)
    validate.instance("grid", grid, Grid)
    if beam is not None:
        validate.instance("beam", beam, BeamWindow)
    validate.progress(progress)
    names = _checked_unknowns(unknowns)
    check_navigation(lines, 10, "autofocus", may_stand=True)
    readout = Readout.of(_of_unit_level(lines), READ_DB)
    passage = Passage.of(lines, names, mean_wavelength_m(readout))
    focus = _Focus(readout, grid, passage, beam, open_device(device), progress)
    focus.check_geometry(names)
    found = focus.result()
    return replace(found, lines=replace(found.lines, samples=lines.samples))


def _of_unit_level(lines: RangeLines) -> RangeLines:
    """Return lines whose largest sample is about 1: single precision holds squared intensities."""
    largest = float(np.abs(lines.samples).max())
    if not largest:
        return lines
    # A power of two changes no sample's digits.
    scale = np.float32(2.0 ** -np.clip(math.frexp(largest)[1], -126, 126))
    return replace(lines, samples=lines.samples * scale)


def _checked_unknowns(unknowns: Sequence[str]) -> tuple[str, ...]:
    names = validate.named("unknowns", unknowns, UNKNOWNS)
    if not names or len(set(names)) < len(names):
        raise ValueError(f"unknowns must be one or several of {UNKNOWNS}, got {names}")
    return names


class _Focus:
    """Lines on their way into focus."""

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
        oversampling = self.readout.spectrum.oversampling
        self.cell_m = lines.range_step_m * min(max(oversampling, 1.0), 64.0)
        self.steps: list[tuple[str, float]] = []
        # The track changes little between images, so that one plan does for all of them.
        self.plan = plan(lines, grid, tolerance_db=IMAGE_TOLERANCE_DB, beam=beam, device=device)
        image = self._form(self.moved_m)
        self.found: Contributions | None
        self.before = sharpness(image)
        self._keep(self.moved_m, image, self.before)

    def check_geometry(self, names: tuple[str, ...]) -> None:
        """Refuse unknowns that the responses do not tell apart; see how far along they are seen."""
        found = self._contributions(self.points_m[:_FIRST_RESPONSES])
        self.for_drift = math.ceil(_RECEIVED_FOR_DRIFT / received_share(found))
        weights = np.abs(found.values[..., 0]) ** 2
        total = max(float(weights.sum()), 1e-300)
        for name, gradient in zip(names, found.gradient, strict=True):
            seen = math.sqrt(float(np.sum(weights * gradient**2)) / total)
            if weights.any() and seen < _LEAST_GRADIENT:
                raise ValueError(
                    f"unknowns must change the range to the responses; {name} of 1 m changes it "
                    f"by {seen:.2g} m rms, at least {_LEAST_GRADIENT:g} m is needed"
                )
        if len(names) == 1:
            return
        normal = np.einsum("ucp,vcp,cp->uv", found.gradient, found.gradient, weights)
        scale = np.sqrt(np.diag(normal))
        likeness = normal / np.maximum(np.outer(scale, scale), 1e-300)
        condition = float(np.linalg.cond(likeness))
        if not condition < 1e3:
            raise ValueError(
                f"unknowns {', '.join(names)} cannot be told apart: all responses see them from "
                f"nearly one direction (condition number {condition:.3g}, at most 1000)"
            )

    def result(self) -> Autofocus:
        """Focus, and return what was found."""
        responses = len(self.points_m) if self.before else 0
        if responses < _LEAST_RESPONSES:
            return self._unfocused(
                f"{_NO_RESPONSES}: the grid shows {responses} responses, at least "
                f"{_LEAST_RESPONSES} are needed"
            )
        stood = halt(self.passage, self.readout, self._responses)
        if stood is not None:
            return self._unfocused(
                f"pings {stood[0]} to {stood[1]} receive the same echoes, although the navigation "
                "moves: the platform stood still, or the scene is the same all along the track (a "
                "wall, a pipe, a background of all pings)"
            )
        stages, dropped = list(self._stages()), ""
        for number, (name, find) in enumerate(stages, start=1):
            # Nothing is gained twice from the same image, and little where little was.
            if name != dropped and not self._try(name, find):
                dropped = name
            if self.progress is not None:
                self.progress(number, len(stages))
        apart = disagreement_m(self.passage, self._responses) / self.passage.wavelength_m
        if apart > MOST_DISAGREEMENT:
            return self._unfocused(
                f"{_NO_RESPONSES}: one half of the responses and the other want the pings moved by "
                f"displacements that differ by {apart:.2g} wavelengths rms, at most "
                f"{MOST_DISAGREEMENT:g}"
            )
        check_speed(self.passage, self._responses, self.moved_m)
        return self._outcome(focused=True)

    def _unfocused(self, why: str) -> Autofocus:
        """Warn that the track cannot be told, and why, and return the lines as they were."""
        validate.warn(f"{why}; the lines are left as they were")
        self.moved_m = np.zeros_like(self.moved_m)
        self.deviation_m = np.full_like(self.deviation_m, np.inf)
        return self._outcome(focused=False)

    def _outcome(self, *, focused: bool) -> Autofocus:
        """Return the lines as far as they were moved."""
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
        """Yield what is tried, from coarse to fine."""
        for _ in range(_DRIFTS):
            yield "drift between subapertures", self._drift
        yield "phase gradients", self._gradients
        for _ in range(_SWEEPS):
            yield "sharpness of single pings", self._pings

    def _drift(self) -> NDArray[np.float64] | None:
        offsets_m = self.given.range_step_m * _OFFSETS
        found = self._contributions(self.points_m[: self.for_drift], offsets_m)
        return drift_m(self.passage, found)

    def _gradients(self) -> NDArray[np.float64]:
        found, total_m = self._responses, np.zeros_like(self.moved_m)
        for neighbourhood in _NEIGHBOURHOODS:
            if total_m.any():
                found = self._contributions(self.points_m, moved_m=self.moved_m + total_m)
            length_m = neighbourhood * self.passage.fresnel_length_m(found)
            total_m = total_m + phase_gradient_m(self.passage, found, length_m)
        return total_m

    def _pings(self) -> NDArray[np.float64]:
        found_m, self.deviation_m = sharpest_m(self.passage, self._responses)
        return found_m

    @property
    def _responses(self) -> Contributions:
        """Contributions to the brightest responses of the present image."""
        if self.found is None:
            self.found = self._contributions(self.points_m)
        return self.found

    def _contributions(
        self,
        points_m: NDArray[np.float64],
        offsets_m: NDArray[np.float64] | None = None,
        moved_m: NDArray[np.float64] | None = None,
    ) -> Contributions:
        """Return contributions to points along the present track, or along another."""
        lines = self._lines(self.moved_m if moved_m is None else moved_m)
        return contributions(self.passage, self.readout, lines, points_m, self.beam, offsets_m)

    def _try(self, name: str, find: Callable[[], NDArray[np.float64] | None]) -> bool:
        """Keep a correction if it makes the image sharper; return whether it is worth another."""
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
        """Hold a track, its image and its brightest responses."""
        self.moved_m, self.sharpness, self.found = moved_m, reached, None
        self.points_m = brightest(image, _RESPONSES, _APART * self.cell_m)
        if not len(self.points_m):
            self.points_m = self.grid.positions_m().reshape(-1, 3)[:1]

    def _form(self, moved_m: NDArray[np.float64]) -> Image:
        lines = self._lines(moved_m)
        return former(lines, self.grid, self.plan, self.device).form(lines)

    def _lines(self, moved_m: NDArray[np.float64]) -> RangeLines:
        vectors_m = self.passage.vectors_m(moved_m)
        given = self.given
        return replace(given, tx_m=given.tx_m + vectors_m, rx_m=given.rx_m + vectors_m)


def sharpness(image: Image) -> float:
    """Return the mean squared intensity of an image over its squared mean intensity."""
    return 1 + contrast(image) ** 2 if image.pixels.any() else 0.0


def _detrended(moved_m: NDArray[np.float64], along_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return displacements without a shift and a linear trend along the track."""
    design = np.stack([np.ones_like(along_m), along_m - along_m.mean()], axis=1)
    fitted = np.linalg.lstsq(design, moved_m.T, rcond=None)[0]
    return moved_m - (design @ fitted).T
