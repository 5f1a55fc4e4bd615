"""Measures of the sharpness of images: entropy and contrast of the intensity."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsas.engine.data.image import Image
from clsas.engine.data.image_error import complex_values
from clsas.engine.data.validate import ArgumentError


def entropy(image: Image | ArrayLike) -> float:
    """Return the entropy of the intensity of an image, which is lowest at best focus.

    Parameters
    ----------
    image : Image or array_like
        Real or complex pixels.

    Returns
    -------
    float
        Entropy, nats: 0 for a single bright pixel, ln(size) for a flat image.

    Raises
    ------
    ValueError
        If the image is zero everywhere, or a value is not finite.

    See Also
    --------
    contrast : A measure that grows with sharpness.

    Notes
    -----
    The entropy is -sum p ln p, where p = |I|^2 / sum |I|^2.

    Examples
    --------
    >>> import clsas
    >>> f"{clsas.entropy([[1, 1], [1, 1]]):.3f}"
    '1.386'
    >>> f"{clsas.entropy([[1, 0.1], [0.1, 0.1]]):.3f}"
    '0.164'
    """
    share = _intensity(image)
    share = share[share > 0] / share.sum()
    return float(-(share * np.log(share)).sum())


def contrast(image: Image | ArrayLike) -> float:
    """Return the contrast of an image: standard deviation over mean of the intensity |I|^2.

    The contrast is 0 for a flat image and 1 for fully developed speckle. It grows with sharpness.

    Parameters
    ----------
    image : Image or array_like
        Real or complex pixels.

    Returns
    -------
    float
        Contrast, a ratio.

    Raises
    ------
    ValueError
        If the image is zero everywhere, or a value is not finite.

    See Also
    --------
    entropy : A measure that falls with sharpness and weighs weak pixels more.

    Examples
    --------
    >>> import clsas
    >>> clsas.contrast([[1, 1], [1, 1]])
    0.0
    >>> f"{clsas.contrast([[0, 0], [0, 1]]):.3f}"
    '1.732'
    """
    intensity = _intensity(image)
    return float(intensity.std() / intensity.mean())


def _intensity(image: Image | ArrayLike) -> NDArray[np.float64]:
    amplitude = np.abs(complex_values("image", image))
    if not amplitude.any():
        raise ArgumentError("image", "not be zero everywhere")
    return (amplitude / amplitude.max()) ** 2
