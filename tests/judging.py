"""Images of a scene of `families`, and whether they err by more than was asked and predicted.

The error of every image is measured by `clsas.certify` too, which has to agree.
"""

from __future__ import annotations

import dataclasses
import warnings
from dataclasses import dataclass

import numpy as np
from exactly import execute, prepare
from families import Scene

from clsas.engine.certificate import certify
from clsas.engine.data.certificate import Certificate
from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Image
from clsas.engine.data.image_error import relative_error_db
from clsas.engine.data.validate import ArgumentError
from clsas.engine.factorized.costs import Costs
from clsas.engine.imaging import factorize, plan

REFERENCE_DB = -85.0  # of the exact image with which others are compared everywhere
FLOOR_DB = -90.0  # below which sums of these large phases do not agree
APART_DB = 1.5  # by which measured errors may disagree beyond the bound of the certificate
# Errors that correlate with those of a reference 15 dB lower look up to 1.7 dB smaller against it.
# Closer to the reference than that, its own error decides.
REFERENCE_SLACK_DB = 15.0
SLACK_DB = 1.0  # by which an error may exceed a prediction, where that is above what was asked
_DEFAULT = Costs()
SLOW = dataclasses.replace(
    Costs(**{each.name: 1e3 * getattr(_DEFAULT, each.name) for each in dataclasses.fields(Costs)}),
    pixel_ns=1e6,
    point_ns=1e6,
    group_ns=1e6,
)
"""Costs with which small images are factorized: exact ones are predicted to be slow."""


@dataclass(frozen=True)
class Formed:
    """One image: what was asked, predicted and measured, dB, or the exception it raised.

    Below `floor_db` the measured error is not known. `refusal` says why there is no certificate.
    """

    kind: str
    asked_db: float
    predicted_db: float = 0.0
    measured_db: float = 0.0
    certificate: Certificate | None = None
    floor_db: float = FLOOR_DB
    refusal: str = ""
    warned: bool = False
    failure: str = ""

    @property
    def excess_db(self) -> float:
        """How far the error is above both what was asked and what was predicted."""
        return self.measured_db - max(self.asked_db, self.predicted_db)

    @property
    def missed(self) -> bool:
        """True if it errs by more than asked, and more than predicted; NaN is a miss."""
        bound_db = max(self.asked_db, self.predicted_db + SLACK_DB)
        return bool(self.failure) or not self.measured_db <= bound_db

    @property
    def disagrees(self) -> bool:
        """True if the certificate measures another error than the sums do."""
        if self.certificate is None or self.failure:
            return False
        found_db, upper_db = self.certificate.error_db, self.certificate.upper_db
        apart_db = abs(max(found_db, self.floor_db) - max(self.measured_db, self.floor_db))
        return not apart_db <= upper_db - found_db + APART_DB

    def __str__(self) -> str:
        if self.failure:
            return f"{self.kind}: asked {self.asked_db:g}: {self.failure}"
        return (
            f"{self.kind}: asked {self.asked_db:g} predicted {self.predicted_db:.1f} "
            f"measured {self.measured_db:.1f}{' (warned)' if self.warned else ''}"
            f"{f', by {self.certificate}' if self.disagrees else ''}"
            f"{f', no certificate: {self.refusal}' if self.refusal else ''}"
        )


def images_of(
    scene: Scene, accuracy_db: float, tolerances_db: list[float], device=None
) -> list[Formed]:
    """Form two exact images of a scene and one for every tolerance, unless its plan is exact."""
    formed, reference = _exactly(scene, REFERENCE_DB, None, device)
    found = [formed, _exactly(scene, accuracy_db, reference, device)[0]]
    found += [_factorized(scene, each, reference, device) for each in tolerances_db]
    return [each for each in found if each is not None]


def _exactly(
    scene: Scene, asked_db: float, reference: Image | None, device
) -> tuple[Formed, Image | None]:
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            prepared = prepare(
                scene.lines, scene.grid, accuracy_db=asked_db, beam=scene.beam, device=device
            )
            image = execute(prepared)
        measured = _measured(scene, image, reference, asked_db)
        warned = _says_an_error(caught)
        predicted_db = prepared.error_db
        return Formed("exact", asked_db, predicted_db, *measured, warned), image
    except Exception as error:  # which is a miss
        return Formed("exact", asked_db, failure=_described(error)), None


def _factorized(scene: Scene, asked_db: float, reference: Image | None, device) -> Formed | None:
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            chosen = plan(
                scene.lines, scene.grid, tolerance_db=asked_db, beam=scene.beam, device=device,
                costs=SLOW,
            )  # fmt: skip
            if chosen.is_exact:
                return None
            # Certified, it would be formed again where the plan is wrong.
            image = factorize(scene.lines, scene.grid, chosen, certificate=False, device=device)
        measured = _measured(scene, image, reference, asked_db)
        warned = _says_an_error(caught)
        return Formed("factorized", asked_db, chosen.predicted_error_db, *measured, warned)
    except Exception as error:  # which is a miss
        return Formed("factorized", asked_db, failure=_described(error))


def _measured(
    scene: Scene, image: Image, reference: Image | None, asked_db: float
) -> tuple[float, Certificate | None, float, str]:
    """Return the error of an image, a certificate of the same pixels, and the floor of the error.

    Where there can be no certificate, the last result says why.

    The sums judge the reference, and the reference judges other images at all pixels: at few of
    them one bright point may decide. The sums judge these too where the reference is no better.
    """
    if not np.isfinite(image.pixels).all():
        return np.nan, None, FLOOR_DB, ""
    if scene.is_dark:  # at all known pixels; elsewhere it may be anything
        return asked_db, None, FLOOR_DB, ""
    of_reference_db = np.inf if reference is None else scene.error_db(reference.pixels)
    if reference is not None and of_reference_db < asked_db - 10:
        floor_db = max(of_reference_db, REFERENCE_DB - 10.0) + REFERENCE_SLACK_DB
        measured_db, counts = relative_error_db(image, reference), (256, 4096)
    else:
        known = Grid.points(scene.grid.at(scene.pixels))
        floor_db, measured_db = FLOOR_DB, scene.error_db(image.pixels)
        image, counts = Image(image.pixels.ravel()[scene.pixels], known), (known.size,)
    certificate = None
    try:
        for pixels in counts:  # one bound in twenty is too low: measure again, more closely
            certificate = certify(image, scene.lines, beam=scene.beam, pixels=pixels, seed=0)
            if measured_db <= certificate.upper_db + APART_DB:
                break
    except ArgumentError as error:  # there are lines whose images have no errors
        return measured_db, None, floor_db, str(error)
    return measured_db, certificate, floor_db, ""


def _says_an_error(caught: list[warnings.WarningMessage]) -> bool:
    """Tell whether a warning says that an image may err by more than asked."""
    return any("error" in str(each.message) for each in caught)


def _described(error: Exception) -> str:
    return f"{type(error).__name__}: {str(error)[:200]}"
