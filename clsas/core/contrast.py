"""Sharpness of images: entropy and contrast of the intensity."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsas.core.image import Image
from clsas.core.image_error import complex_values


def entropy(image: Image | ArrayLike) -> float:
    """Return the entropy of the intensity, nats: least when an image is best focused.

    -sum p ln p with p = |I|^2 / sum |I|^2: 0 for one bright pixel, ln(size) for a flat image.

    Raises
    ------
    ValueError
        If the image is zero everywhere, or a value is not finite.
    """
    share = _intensity(image)
    share = share[share > 0] / share.sum()
    return float(-(share * np.log(share)).sum())


def contrast(image: Image | ArrayLike) -> float:
    """Return the contrast of the intensity |I|^2, its standard deviation over its mean.

    0 for a flat image, 1 for fully developed speckle, and the more the sharper.

    Raises
    ------
    ValueError
        If the image is zero everywhere, or a value is not finite.
    """
    intensity = _intensity(image)
    return float(intensity.std() / intensity.mean())


def _intensity(image: Image | ArrayLike) -> NDArray[np.float64]:
    amplitude = np.abs(complex_values("image", image))
    if not amplitude.any():
        raise ValueError("image must not be zero everywhere")
    return (amplitude / amplitude.max()) ** 2
