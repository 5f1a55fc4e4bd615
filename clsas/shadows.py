"""Dark places of an image: its shadows, where an error spread over the image shows first."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsas import validate
from clsas.image import Image

DARKEST = 0.1
"""Share of an image that counts as dark unless told otherwise."""
# Pixels along either side over which levels are averaged. A single pixel of speckle is dark by
# chance: the darkest tenth would be its nulls, 13 dB below the mean. Over 81 pixels, some 20 of
# them independent, the mean varies by 1 dB.
_AROUND = 9


def dark_level_db(image: Image | ArrayLike, *, darkest: float = DARKEST) -> float:
    """Return the rms of the darkest part of an image over that of the whole image, dB.

    Parameters
    ----------
    image : Image or array_like
        Complex, not zero everywhere.
    darkest : float
        Share of the pixels, above 0 to 1, see `darkest_pixels`.

    Returns
    -------
    float
        0 or less.

    Raises
    ------
    TypeError, ValueError
        If `darkest` is not allowed, a value is not finite, or the image is zero everywhere.
    """
    values = np.asanyarray(image.pixels if isinstance(image, Image) else image)
    values = validate.array("image", values, np.complex128, (None,) * max(values.ndim, 1))
    chosen = darkest_pixels(values, darkest)
    amplitude = np.abs(values) / np.abs(values).max()  # no square overflows or vanishes
    mean, dark = (np.mean(each**2) for each in (amplitude[values != 0], amplitude[chosen]))
    return float(10 * np.log10(dark / mean))


def darkest_pixels(image: NDArray[np.complexfloating], darkest: float) -> NDArray[np.bool_]:
    """Return which pixels are the darkest ones.

    A pixel is as dark as the mean intensity of the 9 x 9 pixels around it, so that shadows count
    and nulls of speckle do not; pixels with one axis, which may lie anywhere, count one by one.
    Pixels of exactly zero were not imaged: they do not count.

    Parameters
    ----------
    image : complex array
    darkest : float
        Share of the pixels, above 0 to 1.

    Raises
    ------
    TypeError, ValueError
        If `darkest` is not allowed, or the image is zero everywhere.
    """
    darkest = validate.number("darkest", darkest, above=0.0, most=1.0)
    imaged = image != 0
    if not imaged.any():
        raise ValueError("the image must not be zero everywhere: it has no darkest part")
    level = levels(image)
    count = max(round(darkest * np.count_nonzero(imaged)), 1)
    order = np.argsort(np.where(imaged, level, np.inf), axis=None, kind="stable")
    chosen = np.zeros(image.size, bool)
    chosen[order[:count]] = True
    return chosen.reshape(image.shape)


def levels(image: NDArray[np.complexfloating]) -> NDArray[np.float64]:
    """Return the mean intensity around every pixel, over that of the brightest pixel.

    The image must not be zero everywhere.
    """
    from scipy import ndimage  # takes a while to import, and few need it

    amplitude = np.abs(image)
    intensity = (amplitude / amplitude.max()) ** 2
    if intensity.ndim == 1:
        return intensity
    return ndimage.uniform_filter(intensity, _AROUND, mode="nearest")
