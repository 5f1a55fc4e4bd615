"""The promise of a tolerance: errors are measured, and images that miss it are formed again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Protocol

import pyopencl as cl

from clsas.engine.certificate import PIXELS, Measurement
from clsas.engine.data import validate
from clsas.engine.data.certificate import Certificate
from clsas.engine.data.declared import Choice, Flag
from clsas.engine.data.image import Formed, Image, holds_any, prediction
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.validate import ArgumentError
from clsas.engine.device.device import Device, DeviceError

LEAST_SECONDS = 0.1
"""Images that take less are certified only if that is requested."""

CERTIFICATE = Flag(
    "Measure the error of the image.",
    default=f"if it is formed to a tolerance in dB and takes {LEAST_SECONDS:g} s or more",
)
ON_MISS = Choice(
    ("refine", "warn", "raise"),
    help="What to do if the measured error exceeds the tolerance: form the image again, warn of "
    "it, or end with an error.",
)

FIRST, MOST = 64, 1024  # pixels that are drawn at first, and in all
_LEAST_MORE = 16  # pixels for which another round is worth its overhead
_SHARE, _LARGEST_SHARE = 0.03, 0.05  # of the time of an image

FormAgain = Callable[[float], Image]
"""Forms the image to another tolerance, dB."""


class Measured(Protocol):
    """A measured error, of an image or of a mosaic."""

    @property
    def error_db(self) -> float:
        """Estimate of the error, dB."""

    def verdict(self, tolerance_db: float) -> str:
        """Return "met", "missed" or "undecided"."""

    def describe(self, tolerance_db: float | None = None) -> str:
        """Return the error in words."""


class ToleranceError(RuntimeError):
    """The measured error of an image exceeds its tolerance.

    Attributes
    ----------
    certificate : Certificate or MosaicCertificate
    tolerance_db : float
    """

    def __init__(self, certificate: Measured, tolerance_db: float) -> None:
        super().__init__(certificate, tolerance_db)
        self.certificate, self.tolerance_db = certificate, tolerance_db

    def __str__(self) -> str:
        """Return the message."""
        return f"the image misses its tolerance: {self.certificate.describe(self.tolerance_db)}"


def is_wanted(certificate: bool | None, seconds: float, *, by_default: bool = True) -> bool:
    """Return whether an image that took some time is certified.

    Without a request, it is certified `by_default` if it took long enough.
    """
    return by_default and seconds >= LEAST_SECONDS if certificate is None else certificate


def certified(
    image: Image,
    lines: RangeLines,
    device: Device,
    seconds: float,
    on_miss: str,
    again: Sequence[FormAgain] = (),
) -> Image:
    """Return an image with the certificate of its error, formed again if it misses its tolerance.

    Parameters
    ----------
    image : Image
        Image that was just formed from `lines`.
    lines : RangeLines
    device : Device
    seconds : float
        Time that the image took.
    on_miss : {"refine", "warn", "raise"}
    again : sequence of callable
        Better and better ways to form the image, which are tried in turn with "refine". Each gets
        the tolerance, tightened by the miss.

    Raises
    ------
    ToleranceError
        If the image misses its tolerance, and `on_miss` is "raise".

    Warns
    -----
    ClsasWarning
        If the error cannot be measured, or the image misses its tolerance.
    """
    tolerance_db, how = _formed(image).tolerance_db, ""
    misses: list[str] = []
    ways = iter(again if on_miss == "refine" else ())
    while True:
        certificate = measured_if_possible(image, lines, device, seconds, tolerance_db)
        if certificate is None or tolerance_db is None:
            break
        form_again = next(ways, None) if certificate.verdict(tolerance_db) == "missed" else None
        if form_again is None:
            break
        misses.append(describe_miss(_formed(image).predicted_error_db, certificate))
        image = form_again(tightened_db(certificate, tolerance_db))
        how = _formed(image).plan
    formed = replace(_formed(image), certificate=certificate, misses=tuple(misses))
    if certificate is not None and tolerance_db is not None:
        report(certificate, tolerance_db, on_miss, misses, how)
    return Image(image.pixels, image.grid, formed)


def measured(
    image: Image, lines: RangeLines, device: Device, seconds: float, tolerance_db: float | None
) -> Certificate:
    """Return the error of an image, measured in a small part of the time that the image took.

    It is measured at 64 pixels in any case, and at up to 256 if these take no more than 3 % of
    the time. While it is undecided whether the image meets its tolerance, more are drawn, up to
    1024 in all: within 5 % of the time, or however long it takes if the image seems to miss.
    """
    measurement = Measurement(image, lines, _formed(image).beam, device, tolerance_db=tolerance_db)
    measurement.draw(FIRST)
    first_s = measurement.seconds / FIRST  # more than others take

    def affordable(share: float) -> float:
        return (share * seconds - measurement.seconds) / first_s

    while True:
        found = measurement.certificate()
        more = more_pixels(found, tolerance_db, affordable)
        if not more or measurement.is_complete:
            break
        measurement.draw(more)
    if tolerance_db is not None and found.verdict(tolerance_db) == "missed":
        # If an image is much darker than its lines, the error may be that of the filters.
        measurement.sharpen()
        found = measurement.certificate()
    return found


def more_pixels(
    found: Certificate, tolerance_db: float | None, affordable: Callable[[float], float]
) -> int:
    """Return how many more pixels to draw after those of a certificate, 0 if they are enough.

    `affordable` returns how many more a share of the image's time pays for.
    """
    more = min(affordable(_SHARE), PIXELS - found.pixels)
    if more < _LEAST_MORE:
        if tolerance_db is None or found.verdict(tolerance_db) != "undecided":
            return 0
        more = min(found.pixels, MOST - found.pixels)
        if found.error_db <= tolerance_db:
            more = min(more, affordable(_LARGEST_SHARE))
    return int(more) if more >= _LEAST_MORE else 0


def measured_if_possible(
    image: Image, lines: RangeLines, device: Device, seconds: float, tolerance_db: float | None
) -> Certificate | None:
    """Return the error of an image, or None with a warning if it cannot be measured."""
    certificate, reason = measured_or_reason(image, lines, device, seconds, tolerance_db)
    if reason:
        validate.warn(f"the error of the image is not known: {reason}")
    return certificate


def measured_or_reason(
    image: Image, lines: RangeLines, device: Device, seconds: float, tolerance_db: float | None
) -> tuple[Certificate | None, str]:
    """Return the error of an image, or None and the reason why it cannot be measured.

    The reason is "" for an image of zeros from lines without echoes there.
    """
    try:
        return measured(image, lines, device, seconds, tolerance_db), ""
    except (ArgumentError, DeviceError, cl.Error) as error:  # the image itself is not lost
        is_empty = isinstance(error, ArgumentError) and not holds_any(image.pixels)
        return None, "" if is_empty else str(error)


def describe_miss(predicted_error_db: float | None, certificate: Certificate) -> str:
    """Return what was predicted and measured of an image that missed its tolerance, in words."""
    return f"{prediction(predicted_error_db)}, {certificate.describe()}"


def tightened_db(certificate: Certificate, tolerance_db: float) -> float:
    """Return the tolerance, dB, to which an image is formed again: tighter by its miss."""
    return 2 * tolerance_db - certificate.error_db


def report(
    certificate: Measured,
    tolerance_db: float,
    on_miss: str,
    misses: Sequence[str] = (),
    how: str = "",
) -> None:
    """Raise an error or warn if an image misses its tolerance, or did before it was formed again.

    Parameters
    ----------
    certificate : Certificate or MosaicCertificate
    tolerance_db : float
    on_miss : {"refine", "warn", "raise"}
    misses : sequence of str
        What former images missed the tolerance by.
    how : str
        How the image was formed again, if it was.
    """
    verdict, now = certificate.verdict(tolerance_db), certificate.describe(tolerance_db)
    if verdict == "missed" and on_miss == "raise":
        raise ToleranceError(certificate, tolerance_db)
    if misses:
        result = {"met": "meets it", "missed": "still misses it", "undecided": "may meet it"}
        validate.warn(
            f"the image missed its tolerance ({'; then '.join(misses)}), was formed again ({how}), "
            f"and {result[verdict]}: {now}"
        )
    elif verdict == "missed":
        validate.warn(f"the image misses its tolerance: {now}")


def _formed(image: Image) -> Formed:
    """Return how an image was formed, which all imagers state."""
    assert image.formed is not None
    return image.formed
