"""Dark parts of an image, such as shadows: an error all over the image shows there first."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from clsas.core import validate
from clsas.core.image import Image
from clsas.core.image_error import darkest_pixels

DARKEST = 0.1
"""Default share of an image that counts as dark."""


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
