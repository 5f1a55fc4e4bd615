"""Multi-look images: power averaged over windows of pixels, and over images of several looks."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from clsas.engine.data import validate
from clsas.engine.data.grid import check_one_grid
from clsas.engine.data.image import Image
from clsas.engine.data.validate import ArgumentError


def multilook(images: Image | Sequence[Image], *, window_m: float | None = None) -> Image:
    """Return an image whose power is the mean over several looks, over a window, or over both.

    Means are those of the pixels that received something, whose amplitude is not 0.

    Speckle has as much variation as its mean. The mean of N independent looks varies by 1/sqrt(N)
    of it, at the price of resolution: each look uses a part of the band or of the beam, or the
    pixels of a look are those of a window. The looks of one survey are images of its sub-bands
    (`sub_bands`), of parts of its beam (`BeamWindow.divided`), or both.

    Parameters
    ----------
    images : Image or sequence of Image
        One image, or several looks at one grid.
    window_m : float, optional
        Side of a square window, metres, which contains the pixels up to half a side before and
        after its middle along rows and columns. Near the edges of the image these are fewer. None
        averages only over the looks.

    Returns
    -------
    Image
        The root of the mean power. Its pixels are real: phases differ between looks.

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type, there is nothing to average, the images have different
        grids, or the grid consists of points and a window is given.

    See Also
    --------
    sub_bands : Range lines of parts of the band.
    contrast : 1/sqrt(N) for speckle of N looks.

    Notes
    -----
    Multi-look mode of the HUGIN sonars is described in section 6.2 of Ødegaard (2004): the looks
    reduce speckle, or are compared, since shadows differ between aspects.

    Examples
    --------
    >>> import clsas
    >>> import numpy as np
    >>> grid = clsas.Grid.plane((0, 5, 200), (40, 45, 200))
    >>> random = np.random.default_rng(0)
    >>> speckle = clsas.Image(random.standard_normal((200, 200, 2)) @ [1, 1j], grid)
    >>> smooth = clsas.multilook(speckle, window_m=0.12)
    >>> f"{clsas.contrast(speckle):.2f}, of 25 looks {clsas.contrast(smooth):.2f}"
    '1.01, of 25 looks 0.20'
    """
    if isinstance(images, Image):
        images = [images]
    looks: list[Image] = validate.entries("images", images, "an Image, or a sequence of them")
    if not looks:
        raise ArgumentError("images", "have at least one image", "none")
    for look in looks:
        validate.instance("every entry of images", look, Image)
    if len(looks) == 1 and window_m is None:
        allowed = "be given for a single image, or `images` be several looks"
        raise ArgumentError("window_m", allowed)

    grid = looks[0].grid
    for look in looks[1:]:
        grid = check_one_grid("images", grid, look.grid)
    size = []  # rows and columns of the window, both odd
    if window_m is not None:
        if grid.points_m is not None:
            hint = "the images have points, not rows and columns"
            raise ArgumentError("window_m", "be left out", hint=hint)
        window_m = validate.positive("window_m", window_m, "m")
        for step_m, count in zip(grid.vectors_m[1:], grid.shape, strict=True):
            step = float(np.linalg.norm(step_m))
            if window_m > count * step:
                allowed = f"be at most the extent of the grid, {count * step:.4g} m"
                raise ArgumentError("window_m", allowed, f"{window_m:g} m")
            size.append(2 * math.floor(window_m / step / 2) + 1)

    validate.memory("images", 32 * grid.size)
    largest = max(float(np.abs(look.pixels).max()) for look in looks) or 1.0
    power, received = np.zeros(grid.shape), np.zeros(grid.shape)
    for look in looks:
        # Squares of large and of small pixels stay within floating point.
        power += np.abs(look.pixels / np.float32(largest)).astype(np.float64) ** 2
        received += look.pixels != 0
    if size:
        power, received = _windowed(power, size), np.rint(_windowed(received, size))
    power = np.divide(power, received, out=np.zeros(grid.shape), where=received > 0)
    return Image((largest * np.sqrt(power)).astype(np.complex64), grid)


def _windowed(values: NDArray[np.float64], size: list[int]) -> NDArray[np.float64]:
    """Return the sum over the pixels of a window around each pixel that lie in the image."""
    # Running sums leave rounding errors behind large values, which must not become negative.
    return math.prod(size) * np.maximum(uniform_filter(values, size, mode="constant"), 0.0)
