"""Level of the dark parts of an image, such as shadows, where errors show first."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from clsas.engine.data import validate
from clsas.engine.data.image import Image
from clsas.engine.data.image_error import darkest_pixels

DARKEST = 0.1
"""Default share of the pixels that count as dark."""


def dark_level_db(image: Image | ArrayLike, *, darkest: float = DARKEST) -> float:
    """Return the rms of the darkest pixels of an image relative to the whole image, in dB.

    Parameters
    ----------
    image : Image or array_like
        Complex pixels, not all of them zero. Pixels that are zero do not count.
    darkest : float
        Share of the pixels that count as dark, above 0 and up to 1; see
        `clsas.engine.data.image_error.darkest_pixels`.

    Returns
    -------
    float
        Level in dB; 0 or less.

    Raises
    ------
    TypeError, ValueError
        If `darkest` is out of bounds, a pixel is not finite, or the image is zero everywhere.

    Examples
    --------
    >>> from clsas.measures.shadows import dark_level_db
    >>> round(dark_level_db([1, 10, 10, 10j], darkest=0.25), 1)
    -18.8
    """
    values = np.asanyarray(image.pixels if isinstance(image, Image) else image)
    values = validate.array("image", values, np.complex128, (None,) * max(values.ndim, 1))
    chosen = darkest_pixels(values, darkest)
    amplitude = np.abs(values) / np.abs(values).max()  # whose squares neither overflow nor vanish
    mean, dark = (np.mean(each**2) for each in (amplitude[values != 0], amplitude[chosen]))
    return float(10 * np.log10(dark / mean))
