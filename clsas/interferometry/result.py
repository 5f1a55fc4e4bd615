"""Heights of a seabed, with their deviations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import reprs, validate
from clsas.engine.data.certificate import Certificate
from clsas.engine.data.georeference import Georeference
from clsas.engine.data.image import Image
from clsas.engine.data.validate import ArgumentTypeError


@dataclass(frozen=True, eq=False)
class Heights:
    """Heights of a seabed above a plane, pixel by pixel, with their standard deviations.

    Attributes
    ----------
    height_m : float64 [rows, columns]
        Height above the plane of the grid, metres along z. NaN outside the mask.
    sd_m : float64 [rows, columns]
        Standard deviation of the height, metres. NaN outside the mask. It contains the noise of
        the phase and the curvature of the seabed within windows, but not errors that all pixels
        have in common, such as those of the positions of the banks; see `m_per_rad`.
    coherence : float64 [rows, columns]
        Magnitude of the coherence of both banks on the relief, 0 to 1, without bias.
    mask : bool [rows, columns]
        True where the height is valid. False in shadow, in layover, where the images are not
        coherent, and where they mostly show side lobes of brighter places. Nothing is filled in
        there.
    looks : float64 [rows, columns]
        Effective number of independent samples behind each height.
    m_per_rad : float64 [rows, columns]
        Change of the height per radian of phase between the banks, metres. A constant error of the
        phase displaces all heights by that much.
    image : Image
        Image of the first bank on the relief. Its grid has the heights of the last pass but one,
        which differ from `height_m` by less than its deviation, and the nearest valid height
        outside the mask, because a pixel must lie somewhere.
    window_m : float
        Side of the windows, metres.
    certificate : Certificate, optional
        Measured error of the images on the relief, of that bank which errs more; None if it was not
        measured, and in the store of a mosaic, whose records have those of the patches.

    See Also
    --------
    heights : Function that returns this result.
    pair_errors : Errors that the heights of all pixels have in common.
    """

    height_m: NDArray[np.float64]
    sd_m: NDArray[np.float64]
    coherence: NDArray[np.float64]
    mask: NDArray[np.bool_]
    looks: NDArray[np.float64]
    m_per_rad: NDArray[np.float64]
    image: Image
    window_m: float
    certificate: Certificate | None = None

    def __post_init__(self) -> None:
        """Check every field and convert it."""

        def put(name: str, value: object) -> None:
            object.__setattr__(self, name, value)

        validate.instance("image", self.image, Image)
        validate.instance("certificate", self.certificate, Certificate, type(None))
        put("window_m", validate.positive("window_m", self.window_m, "m"))
        shape = self.image.shape
        mask = _as_array(self.mask)
        if mask is None or not _is_plain(mask, "b", shape):
            raise ArgumentTypeError("mask", f"be bools of shape {shape}", validate.shown(self.mask))
        put("mask", _read_only(mask))
        for name in ("coherence", "looks", "m_per_rad"):
            put(name, validate.array(name, getattr(self, name), np.float64, shape))
        for name in ("height_m", "sd_m"):
            values: Any = getattr(self, name)
            if isinstance(values, np.ndarray) and _is_plain(
                values, "f", shape
            ):  # NaN is allowed outside the mask
                validate.array(f"{name} within the mask", values[mask], np.float64, None)
            else:
                values = validate.array(name, values, np.float64, shape)
            put(name, _read_only(np.where(mask, values, np.nan).astype(np.float64)))
        _check_limits("sd_m within the mask", self.sd_m[mask], "m")
        _check_limits("coherence", self.coherence, most=1.0)
        _check_limits("looks", self.looks)

    @property
    def figures(self) -> dict[str, Any]:
        """Valid share, span of heights, median deviation and what limits them, as numbers.

        Span and deviation are None if no height is valid.
        """
        known_m = self.height_m[self.mask]
        is_any = known_m.size > 0
        return {
            "pixels": self.mask.size,
            "valid": float(self.mask.mean()),
            "height_m": [float(known_m.min()), float(known_m.max())] if is_any else None,
            "median_sd_m": float(np.median(self.sd_m[self.mask])) if is_any else None,
            "window_m": self.window_m,
            "looks": float(np.median(self.looks)),
            "coherence": float(np.median(self.coherence)),
            "ambiguity_m": 2 * np.pi * float(np.median(np.abs(self.m_per_rad))),
        }

    def __repr__(self) -> str:
        """Return the shape, the valid share, the span of heights and the median deviation."""
        valid = f"{100 * self.mask.mean():.3g} % valid"
        parts: tuple[str, ...] = ()
        if self.mask.any():
            known_m = self.height_m[self.mask]
            low_m, high_m = round(float(known_m.min()), 4), round(float(known_m.max()), 4)
            parts = (
                f"height {reprs.span(low_m, high_m, 'm')}",
                f"median deviation {reprs.quantity(float(np.median(self.sd_m[self.mask])), 'm')}",
            )
        if self.certificate is not None:
            parts += (f"images: {self.certificate.describe()}",)
        return reprs.summary(self, f"{reprs.by(self.mask.shape)} pixels", valid, *parts)

    @property
    def georeference(self) -> Georeference | None:
        """Georeference of the grid; None if unknown."""
        return self.image.georeference


def _check_limits(
    name: str, values: NDArray[np.float64], unit: str = "", most: float | None = None
) -> None:
    """Raise ValueError if a value is negative, or above a limit."""
    for value in (values.min(initial=0.0), values.max(initial=0.0)):
        validate.number(name, float(value), unit, least=0.0, most=most)


def _as_array(values: object) -> NDArray | None:
    """Return values as an array, or None if they are not regular."""
    try:
        return np.asanyarray(values)
    except ValueError:
        return None


def _is_plain(values: NDArray | None, kind: str, shape: tuple[int, ...]) -> bool:
    """Return whether values are an array without masked values, of a kind and a shape."""
    if values is None or np.ma.isMaskedArray(values):
        return False
    return values.dtype.kind == kind and values.shape == shape


def _read_only(values: NDArray) -> NDArray:
    view = np.ascontiguousarray(values).view()
    view.flags.writeable = False
    return view
