"""Error of one image relative to another."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsas.engine.data import validate
from clsas.engine.data.grid import check_one_grid
from clsas.engine.data.image import Image
from clsas.engine.data.validate import ArgumentError

# Pixels along either side over which levels are averaged. Single pixels of speckle are dark by
# chance, so the darkest tenth of them would be nulls of the speckle, 13 dB below the mean. The mean
# over 81 pixels, about 20 of which are independent, varies by only 1 dB.
_AROUND = 9


def relative_error_db(
    image: Image | ArrayLike, reference: Image | ArrayLike, *, darkest: float | None = None
) -> float:
    """Return the relative rms error of an image against a reference, dB.

    Parameters
    ----------
    image, reference : Image or array_like
        Complex images of one shape. Two Images must also lie on one grid.
    darkest : float, optional
        Share of the pixels over which both norms are taken: the darkest pixels of the reference
        (0.1 is a tenth of them). The result is then the error in shadows, relative to their own
        level. The level of a pixel is the mean intensity of the 9 by 9 pixels around it.

    Returns
    -------
    float
        20 log10(||I - R|| / ||R||), -inf if the images are equal.

    Raises
    ------
    ValueError
        If the shapes or grids differ, a value is not finite, the reference is zero everywhere, or
        `darkest` is not above 0 and at most 1.

    Examples
    --------
    An error of 1 % in one of two equal pixels:

    >>> import clsas
    >>> f"{clsas.relative_error_db([1j, 1.01], [1j, 1]):.2f} dB"
    '-43.01 dB'
    """
    given, wanted = complex_values("image", image), complex_values("reference", reference)
    if given.shape != wanted.shape:
        allowed = f"have the shape of `reference`, {wanted.shape}"
        raise ArgumentError("image", allowed, str(given.shape))
    if isinstance(image, Image) and isinstance(reference, Image):
        check_one_grid("image and reference", image.grid, reference.grid)
    if not wanted.any():
        raise ArgumentError("reference", "not be zero everywhere")
    if darkest is not None:
        chosen = darkest_pixels(wanted, darkest)
        given, wanted = given[chosen], wanted[chosen]
    # Scaled by the largest real or imaginary part, so that no square overflows or underflows.
    parts, wanted_parts = given.view(np.float64), wanted.view(np.float64)
    scale = max(np.abs(parts).max(), np.abs(wanted_parts).max())
    error = parts / scale - wanted_parts / scale
    if not error.any():
        return -math.inf
    return _norm_db(error) + 20 * math.log10(scale) - _norm_db(wanted_parts)


def complex_values(name: str, image: Image | ArrayLike) -> NDArray[np.complex128]:
    """Return the values of an image, checked, in double precision."""
    values = np.asanyarray(image.pixels if isinstance(image, Image) else image)
    if values.dtype.kind in "iuf":
        values = values.astype(np.complex128)
    return validate.array(name, values, np.complex128, (None,) * max(values.ndim, 1))


def _norm_db(values: NDArray[np.float64]) -> float:
    greatest = np.abs(values).max()
    return 20 * (math.log10(greatest) + math.log10(np.linalg.norm(values / greatest)))


def darkest_pixels(image: NDArray[np.complexfloating], darkest: float) -> NDArray[np.bool_]:
    """Return a mask of the darkest pixels, bool with the image's shape.

    The level of a pixel is the mean intensity of the 9 x 9 pixels around it, so that shadows are
    found and nulls of speckle are not. For an image with one axis, whose pixels may lie anywhere,
    it is the intensity of the pixel itself. Pixels that are exactly zero were not imaged and are
    not counted.

    Parameters
    ----------
    image : complex array
    darkest : float
        Share of the pixels to find, above 0 and at most 1.

    Raises
    ------
    TypeError, ValueError
        If `darkest` is outside its limits, or the image is zero everywhere.
    """
    darkest = validate.number("darkest", darkest, above=0.0, most=1.0)
    imaged = image != 0
    if not imaged.any():
        raise ArgumentError("image", "not be zero everywhere", hint="it has no darkest part")
    level = levels(image)
    count = max(round(darkest * np.count_nonzero(imaged)), 1)
    order = np.argsort(np.where(imaged, level, np.inf), axis=None, kind="stable")
    chosen = np.zeros(image.size, bool)
    chosen[order[:count]] = True
    return chosen.reshape(image.shape)


def levels(image: NDArray[np.complexfloating]) -> NDArray[np.float64]:
    """Return the mean intensity around every pixel, relative to that of the brightest pixel.

    The image must not be zero everywhere.
    """
    from scipy import ndimage  # slow to import, and rarely needed

    amplitude = np.abs(image)
    intensity = (amplitude / amplitude.max()) ** 2
    if intensity.ndim == 1:
        return intensity
    return ndimage.uniform_filter(intensity, _AROUND, mode="nearest")
