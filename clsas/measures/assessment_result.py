"""Results of `clsas.assess`: effects with their errors and times, as a table."""

from __future__ import annotations

from dataclasses import dataclass

from clsas.core import reprs
from clsas.core.tables import Report, Table
from clsas.measures.effects import ENDS, KEYS

NONE_DB = -250.0
"""Errors below this level, dB, count as none."""


@dataclass(frozen=True)
class Effect:
    """An effect, and the error and the time that an image has without it.

    Attributes
    ----------
    name : str
    modelled : bool
        True if the image as given models the effect.
    error_db : float or None
        Relative rms error of the image without it, dB; -300 if it has no influence, None if the
        inputs do not tell.
    range_wavelengths, most_wavelengths : float or None
        Errors of ranges without it, rms and at most, wavelengths; None for effects on amplitudes.
    needed : bool or None
        True if the power of its error is more than `clsas.sonar.simplify.SHARE` of the power that
        the tolerance allows; None if the error is not known.
    left_out : bool
        True if `clsas.plan` and `clsas.backproject` leave it out by themselves; they move antennas
        to make up for it.
    seconds : float or None
        Time that the image takes longer because of it; negative if it saves time.
    key : str
        Key of a scene file that leaves it out; "" if there is none.
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
    """Effects of an image, with errors and times; made by `assess`.

    Attributes
    ----------
    tolerance_db : float
        Relative rms error allowed.
    wavelength_m : float
        Wavelength at the middle of the band.
    channels : int
    pixels : tuple of int
        Shape of the grid.
    device : str
        Device that forms the image.
    measured : bool
        True if times were measured, False if the cost model predicts them.
    seconds, simple_seconds : float
        Time of the image with all modelled effects, and as it is formed: without those that are
        left out.
    effects : tuple of Effect
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
        """Return the tolerance, and which effects are missing and which could be left out."""
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
        """Return the effect of a name."""
        return {effect.name: effect for effect in self.effects}[name]

    @property
    def spare(self) -> tuple[str, ...]:
        """Effects that are modelled and not needed."""
        return tuple(
            e.name for e in self.effects if e.modelled and e.needed is False and e.name != ENDS
        )

    @property
    def missing(self) -> tuple[str, ...]:
        """Effects that are needed and not modelled."""
        return tuple(e.name for e in self.effects if e.needed and not e.modelled)

    def describe(self) -> str:
        """Return a table of the effects."""
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
