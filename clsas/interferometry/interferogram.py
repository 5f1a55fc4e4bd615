"""Interferograms: phase and coherence of two images of one scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import reprs, validate
from clsas.engine.data.grid import Grid, check_one_grid
from clsas.engine.data.image import Image
from clsas.engine.data.validate import ArgumentError
from clsas.interferometry.checks import check_looks, window_within
from clsas.interferometry.coherence import (
    Moments,
    Window,
    debiased,
    effective_looks,
    phase_sd_rad,
)

# Of a window's side in that of the images. Its looks are overestimated by 10 % there, and by 20 to
# 60 % if window and images are equally large (medians of simulated speckle, 6 to 64 looks).
_LARGEST_SHARE = 2 / 3


@dataclass(frozen=True, eq=False)
class Interferogram:
    """Phase and coherence of two images in windows around every pixel.

    Attributes
    ----------
    phase_rad : float32 [rows, columns]
        Phase of the first image relative to the second, arg sum a b*, radians from -pi to pi; 0
        where an image is 0.
    coherence : float32 [rows, columns]
        Magnitude of the coherence, 0 to 1, without the bias of finitely many looks.
    looks : float32 [rows, columns]
        Effective number of independent samples in the window around each pixel. It is smaller at
        the edges of the image.
    phase_sd_rad : float32 [rows, columns]
        Standard deviation of the phase, radians; at most pi/sqrt(3), that of a uniform phase.
    grid : Grid
        Positions of the pixels: a plane or a height map.
    window_m : float
        Side of the windows, metres.

    See Also
    --------
    interferogram : Function that returns this result.
    """

    phase_rad: NDArray[np.float32]
    coherence: NDArray[np.float32]
    looks: NDArray[np.float32]
    phase_sd_rad: NDArray[np.float32]
    grid: Grid
    window_m: float

    def __post_init__(self) -> None:
        """Check every field and convert it."""
        validate.instance("grid", self.grid, Grid)
        if self.grid.points_m is not None:
            raise ArgumentError("grid", "be a plane or a height map", "points")
        object.__setattr__(self, "window_m", validate.positive("window_m", self.window_m, "m"))
        for name in ("phase_rad", "coherence", "looks", "phase_sd_rad"):
            values = validate.array(name, getattr(self, name), np.float32, self.grid.shape)
            object.__setattr__(self, name, values)

    def __repr__(self) -> str:
        """Return the shape, the median coherence and the window."""
        return reprs.summary(
            self,
            f"{reprs.by(self.grid.shape)} pixels",
            f"median coherence {np.median(self.coherence):.2f}",
            f"windows of {reprs.quantity(self.window_m, 'm')}",
            f"{self.looks.max():.0f} looks",
        )


def interferogram(a: Image, b: Image, window_m: float) -> Interferogram:
    """Return the phase difference and the coherence of two images, window by window.

    Parameters
    ----------
    a, b : Image
        Images of the same scene on the same plane or height map, such as those of two receiver
        banks.
    window_m : float
        Side of the square windows, metres, rounded to an odd number of pixels. Windows must contain
        at least 4 independent samples.

    Returns
    -------
    Interferogram

    Raises
    ------
    TypeError
        If an image is not an Image, or `window_m` is not a number.
    ValueError
        If the images lie on different grids or consist of arbitrary points, or the window contains
        too few independent samples or is larger than the images.

    Warns
    -----
    ClsasWarning
        If a side of the window is more than two thirds of that of the images. Images that small do
        not show how their pixels are correlated, and the number of looks may be 1.6 times too
        large.

    See Also
    --------
    heights : Heights of the seabed from two banks.

    Notes
    -----
    The coherence in a window is ::

        g = sum a b* / sqrt(sum |a|^2 sum |b|^2)

    With L independent samples (looks), the squared magnitude of the sum is on average
    g^2 + (1 - g^2)^2/L. This bias is removed. The phase has the standard deviation [1]_ ::

        sigma = sqrt((1 - g^2) / (2 L g^2))

    The number of looks is measured: it is smaller than the number of pixels, since neighbouring
    pixels of speckle are correlated. On a height map whose heights err from pixel to pixel, the
    phases of neighbours err too, and samples seem independent that are not. There the number is too
    large, and the deviation too small; that of a smooth height map or a plane is right.

    Images that are formed in the time domain need no registration. On the relief that they show,
    the phase is zero on average; on a plane, it changes with the height of the seabed above the
    plane.

    References
    ----------
    .. [1] Rodriguez and Martin, "Theory and design of interferometric synthetic aperture radars",
       IEE Proceedings F 139(2), 1992.

    Examples
    --------
    Two images of speckle with a coherence of 0.9 and a phase difference of 1 rad:

    >>> import clsas
    >>> import numpy as np
    >>> random = np.random.default_rng(1)
    >>> speckle = random.standard_normal((3, 64, 64, 2)) @ [1, 1j]
    >>> grid = clsas.Grid.plane((0, 0.63, 64), (30, 30.63, 64))
    >>> first = clsas.Image(np.exp(1j) * (3 * speckle[0] + speckle[1]), grid)
    >>> second = clsas.Image(3 * speckle[0] + speckle[2], grid)
    >>> found = clsas.interferogram(first, second, window_m=0.15)
    >>> print(f"{np.median(found.phase_rad):.1f} rad, {np.median(found.coherence):.1f}")
    1.0 rad, 0.9
    """
    validate.instance("a", a, Image)
    validate.instance("b", b, Image)
    window_m = validate.positive("window_m", window_m, "m")
    if a.grid.points_m is not None or b.grid.points_m is not None:
        raise ArgumentError("a and b", "lie on a plane or a height map", "arbitrary points")
    grid = check_one_grid("a and b", a.grid, b.grid)
    window = window_within(grid, window_m)
    most = effective_looks((a.pixels, b.pixels), window)
    check_looks(window_m, most)
    _check_share(window, grid)
    looks = most * window.fullness(a.shape)
    found = Moments.of(a.pixels, b.pixels, window).coherence
    coherence = debiased(found, looks)
    deviation = phase_sd_rad(coherence, looks)
    parts = np.angle(found), coherence, looks, deviation
    phase, magnitude, independent, noise = (each.astype(np.float32) for each in parts)
    return Interferogram(phase, magnitude, independent, noise, grid, window_m)


def _check_share(window: Window, grid: Grid) -> None:
    """Warn if a window is so large that its number of looks cannot be measured well."""
    share = max(side / n for side, n in zip(window.sides, grid.shape, strict=True) if n > 1)
    if share > _LARGEST_SHARE:
        validate.warn(
            f"windows should be at most two thirds as long and wide as the images, got "
            f"{100 * share:.0f} %: looks may be 1.6 times too many, and `phase_sd_rad` 0.8 times "
            "its true value"
        )
