"""Results of `clsas.assess`: effects, with the errors and times they cause, as a table."""

from __future__ import annotations

from dataclasses import dataclass

from clsas.engine.data import reprs
from clsas.engine.data.reprs import Report, Table
from clsas.measures.effects import ENDS, KEYS

NONE_DB = -250.0
"""Errors below this level, in dB, are shown as "none"."""


@dataclass(frozen=True)
class Effect:
    """An effect that an image may model, with the error without it and the time it costs.

    Attributes
    ----------
    name : str
    modelled : bool
        True if the image as given models the effect.
    error_db : float or None
        Relative rms error of the image without the effect, in dB: -300 if it has no influence, None
        if the inputs are not sufficient to know.
    range_wavelengths, most_wavelengths : float or None
        Rms and largest error of the ranges without the effect, in wavelengths; None for effects on
        amplitudes.
    needed : bool or None
        True if the error power is more than `simplify.SHARE` of the power that the
        tolerance allows; None if the error is not known.
    left_out : bool
        True if `clsas.plan` and `clsas.backproject` leave the effect out of their own accord. They
        move antennas to compensate for it.
    seconds : float or None
        Time by which the effect makes the image slower; negative if it makes it faster. None if
        there is no image without it.
    key : str
        Key of a scene file that leaves the effect out; "" if there is none.

    See Also
    --------
    assess : Function that returns it, with an example.
    """

    name: str
    modelled: bool
    error_db: float | None
    range_wavelengths: float | None
    most_wavelengths: float | None
    needed: bool | None
    left_out: bool
    seconds: float | None
    key: str

    __repr__ = reprs.of_fields


@dataclass(frozen=True)
class Assessment:
    """Effects of an image, with errors and times, as returned by `assess`.

    Attributes
    ----------
    tolerance_db : float
        Relative rms error that is allowed, in dB.
    wavelength_m : float
        Wavelength at the middle of the band, in metres.
    channels : int
        Number of range lines.
    pixels : tuple of int
        Shape of the grid.
    device : str
        Device that forms the image.
    measured : bool
        True if times were measured, False if the cost model predicts them.
    seconds, simple_seconds : float
        Time of the image with all modelled effects, and of the image as it is formed, without
        those that are left out.
    effects : tuple of Effect
        All effects; ``assessment[name]`` is the one with a name.

    See Also
    --------
    assess : Function that returns it, with an example.
    """

    tolerance_db: float
    wavelength_m: float
    channels: int
    pixels: tuple[int, ...]
    device: str
    measured: bool
    seconds: float
    simple_seconds: float
    effects: tuple[Effect, ...]

    def __repr__(self) -> str:
        """Return a summary: the tolerance, and which effects are missing or not needed."""
        return reprs.summary(
            self,
            f"tolerance {reprs.quantity(self.tolerance_db, 'dB')}",
            f"{len(self.effects)} effects",
            f"needed and not modelled: {', '.join(self.missing) or 'none'}",
            f"modelled and not needed: {', '.join(self.spare) or 'none'}",
            self.device,
        )

    def _repr_html_(self) -> str:
        return self._report().html()

    def __getitem__(self, name: str) -> Effect:
        """Return the effect with a name; raise KeyError if there is none."""
        return {effect.name: effect for effect in self.effects}[name]

    @property
    def spare(self) -> tuple[str, ...]:
        """Names of the effects that are modelled but not needed."""
        return tuple(
            e.name for e in self.effects if e.modelled and e.needed is False and e.name != ENDS
        )

    @property
    def missing(self) -> tuple[str, ...]:
        """Names of the effects that are needed but not modelled."""
        return tuple(e.name for e in self.effects if e.needed and not e.modelled)

    def describe(self) -> str:
        """Return a table of the effects as text."""
        return self._report().text()

    def _report(self) -> Report:
        names = ("effect", "modelled", "error", "wavelengths", "needed", "costs", "left out")
        rows = []
        for e in self.effects:
            rows.append(
                (
                    e.name,
                    "yes" if e.modelled else "no",
                    _decibels(e.error_db),
                    _wavelengths(e),
                    {True: "yes", False: "no", None: "-"}[e.needed],
                    "-" if e.seconds is None else f"{1e3 * e.seconds:+.0f} ms",
                    "yes" if e.left_out else "-",
                )
            )
        how = "measured" if self.measured else "predicted"
        before = [
            f"{' x '.join(map(str, self.pixels))} pixels from {self.channels} channels, tolerance "
            f"{self.tolerance_db:.4g} dB, wavelength {1e3 * self.wavelength_m:.4g} mm; "
            f"{1e3 * self.seconds:.0f} ms with all effects modelled, "
            f"{1e3 * self.simple_seconds:.0f} ms as it is formed ({how}, {self.device})",
        ]
        after = []
        for name in self.missing:
            after.append(f"Needed and not modelled: {name}")
        for name in self.spare:
            how = f": {KEYS[name]}" if KEYS[name] else ""
            after.append(f"Modelled and not needed: {name}{how}")
        return Report([*before, Table(names, rows, align="left"), *after])


def _decibels(error_db: float | None) -> str:
    if error_db is None:
        return "-"
    return "none" if error_db < NONE_DB else f"{error_db:.1f} dB"


def _wavelengths(effect: Effect) -> str:
    if effect.range_wavelengths is None or effect.most_wavelengths is None:
        return "-"
    if not effect.most_wavelengths:
        return "none"
    return f"{effect.range_wavelengths:.2g}, at most {effect.most_wavelengths:.2g}"
