"""The scene of an image: lines, grid and beam, made ready once for planning and for forming."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import validate
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.coverage import reaches, warn_unreached
from clsas.engine.data.georeference import placed
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines, fastest, wavelength_m
from clsas.engine.data.simplify import leave_out, simplify
from clsas.engine.data.surface import Surface, surface_of
from clsas.engine.data.validate import ArgumentError
from clsas.engine.signal.ambiguity import Ambiguity, ambiguity
from clsas.engine.signal.doubts import warn_before_imaging
from clsas.engine.signal.spectrum import Spectrum, line_energy, measure_spectrum
from clsas.engine.water.refraction import Homogeneous, homogeneous

_SMALLEST_STEP_M = 1e-9
_LARGEST_SUM = 1e37
_NUMBERS_AT_ONCE = 1 << 18  # numbers that stay in a core's cache between two passes over them
# Largest speed of a receiver, in sound speeds. The third-order terms of cl/expand_tiles.cl neglect
# motion.
_FASTEST = 0.05


@dataclass(frozen=True, eq=False)
class Scene:
    """Lines, grid and beam of an image, as they are imaged, and what every method needs to know.

    Effects whose error lies far below the allowed one are left out, and homogeneous water takes the
    place of a sound-speed profile. Properties are computed when they are first needed, and kept.

    Attributes
    ----------
    given_lines, given_grid, given_beam
        What the user gave; the grid with the georeference of the lines.
    lines, grid, beam
        What is imaged.
    allowed_db : float or None
        Allowed relative rms error, dB; None if nothing may be left out.
    water : Homogeneous
        Homogeneous water in which `lines` lie.
    left_out : tuple of str
        Effects that are left out; see `clsas.engine.data.simplify`.
    left_out_error : float
        Upper bound of the relative error power that this adds.
    largest_sample : float
        Largest magnitude of a real or imaginary part of the samples.
    """

    given_lines: RangeLines
    given_grid: Grid
    given_beam: BeamWindow | None
    lines: RangeLines
    grid: Grid
    beam: BeamWindow | None
    allowed_db: float | None
    water: Homogeneous
    left_out: tuple[str, ...]
    left_out_error: float
    largest_sample: float

    @classmethod
    def of(
        cls,
        lines: RangeLines,
        grid: Grid,
        beam: BeamWindow | None,
        allowed_db: float | None,
        *,
        left_out: tuple[str, ...] | None = None,
    ) -> Scene:
        """Return the scene of lines, grid and beam.

        Parameters
        ----------
        lines, grid, beam
            Of the right types.
        allowed_db : float or None
            Allowed relative rms error, dB. With None every effect is modelled.
        left_out : tuple of str, optional
            Effects to leave out, instead of those whose error is small enough.

        Raises
        ------
        ValueError
            If lines and grid have different georeferences, numbers are too large or too small (see
            `check_numbers`), or the sound-speed profile does not reach the grid or the antennas.
        """
        given_grid, largest = placed(lines, grid), check_numbers(lines, beam)
        water = homogeneous(lines, given_grid, beam, allowed_db)
        in_water = water.lines(lines), water.grid, water.beam
        if left_out is None:
            corrected = water.corrections is not None
            simplified = simplify(*in_water, allowed_db, keeps_points=corrected)
        else:
            simplified = leave_out(*in_water, left_out)
        if simplified.lines.samples is not lines.samples:  # interpolated along changed range axes
            largest = check_numbers(simplified.lines, simplified.beam)
        return cls(
            given_lines=lines,
            given_grid=given_grid,
            given_beam=beam,
            lines=simplified.lines,
            grid=simplified.grid,
            beam=simplified.beam,
            allowed_db=allowed_db,
            water=water,
            left_out=simplified.left_out,
            left_out_error=simplified.error + water.error,
            largest_sample=largest,
        )

    def with_samples(self, lines: RangeLines) -> RangeLines:
        """Return lines of the same geometry as they are imaged, with samples of their own."""
        return replace(self.lines, samples=self.water.lines(lines).samples)

    @cached_property
    def along(self) -> NDArray[np.float64] | None:
        """Unit directions of the track at the channels, [channels, 3]; None without a beam."""
        return None if self.beam is None else self.beam.directions(self.lines)

    @cached_property
    def line_energy(self) -> NDArray[np.float64]:
        """Energy of each line, [channels]."""
        return line_energy(self.lines.samples)

    @cached_property
    def spectrum(self) -> Spectrum:
        """Spectrum of the lines, with the weight that frequencies have in the image."""
        return measure_spectrum(self.lines, self.grid, self.line_energy)

    @cached_property
    def ambiguity(self) -> Ambiguity:
        """Errors that the lines themselves cause, whatever the method."""
        return ambiguity(
            self.lines, self.grid, self.spectrum, self.line_energy, self.beam, self.along
        )

    @cached_property
    def surface(self) -> Surface:
        """Surface on which the pixels lie."""
        return surface_of(self.grid)

    @cached_property
    def is_reached(self) -> bool:
        """False if certainly no line adds anything to any pixel."""
        return reaches(self.lines, self.grid, self.beam, self.along)

    def warn(self, argument: str, requested_db: float | None, *, doubts: bool = True) -> None:
        """Warn of whatever may spoil an image of the scene.

        Parameters
        ----------
        argument : str
            Name of the argument by which an error was requested.
        requested_db : float or None
            That error, dB; None if none was requested.
        doubts : bool
            Whether to warn of input that cannot be right, too.
        """
        if doubts:
            warn_before_imaging(self.given_lines, self.given_grid, self.given_beam)
        if requested_db is not None:
            self.ambiguity.warn(argument, requested_db)

    def warn_unreached(self, lines: RangeLines | None = None) -> None:
        """Warn that no line adds anything to the image, unless all samples are zero.

        `lines` are lines of the scene with other samples.
        """
        warn_unreached(lines or self.lines, self.given_grid, self.beam, self.along)


def check_numbers(lines: RangeLines, beam: BeamWindow | None) -> float:
    """Raise ValueError for lines that would overflow float32 sums or lose the phase in float64.

    Returns
    -------
    float
        Largest magnitude of a real or imaginary part of the samples.
    """
    heaviest = 1.0
    if beam is not None:
        if beam.shape == "inverse" and not lines.carrier_hz:
            raise ArgumentError("carrier_hz", "be above 0 for a beam with `shape='inverse'`")
        heaviest = max(float(beam.table(wavelength_m(lines)).max()), 1.0)
    validate.number(
        "range_step_m", lines.range_step_m, "m", least=_SMALLEST_STEP_M, most=validate.FARTHEST_M
    )
    farthest_m = np.abs([lines.first_range_m, lines.last_range_m]).max()
    validate.phase(lines.carrier_hz, lines.sound_speed_m_s, float(farthest_m))
    parts = lines.samples.reshape(-1).view(np.float32)  # samples of RangeLines are contiguous
    spans = [parts[i : i + _NUMBERS_AT_ONCE] for i in range(0, parts.size, _NUMBERS_AT_ONCE)]
    largest = float(max(max(span.max(), -span.min()) for span in spans))
    most = _LARGEST_SUM / heaviest / lines.channels
    if largest > most:
        allowed = f"be at most {most:.3g} for {lines.channels} channels, to add up within float32"
        raise ArgumentError("samples", allowed, f"{largest:.3g}")
    speed_m_s = fastest(lines) * lines.sound_speed_m_s
    most_m_s = _FASTEST * lines.sound_speed_m_s
    validate.number("the speed of `rx_velocity_m_s`", speed_m_s, "m/s", most=most_m_s * (1 + 1e-9))
    return largest
