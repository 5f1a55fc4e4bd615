"""A complex image and where its pixels lie."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from clsas.core import reprs, validate
from clsas.core.decibels import level_db
from clsas.core.grid import Grid

if TYPE_CHECKING:
    import xarray
    from matplotlib.axes import Axes

_AT_ONCE = 1 << 16  # pixels that are checked together


@dataclass(frozen=True, eq=False)
class Image:
    """Complex pixels on a grid.

    Parameters
    ----------
    pixels : array_like of complex, shape `grid.shape`
        Kept as complex64. The phase is that of the scene: the carrier's phase at each pixel's
        range has been restored.
    grid : Grid
        Where the pixels lie.

    Raises
    ------
    TypeError
        If the pixels are not complex or `grid` is not a Grid.
    ValueError
        If the pixels do not have the grid's shape, or a pixel is NaN or infinite. Also if
        wider pixels are all so small or large that complex64 loses their digits.

    Notes
    -----
    Pixels that need no conversion are not copied: do not write into them afterwards.
    """

    pixels: NDArray[np.complex64]
    grid: Grid

    if TYPE_CHECKING:  # arrays are converted: the constructor takes what holds numbers

        def __init__(
            self,
            pixels: ArrayLike,
            grid: Grid,
        ) -> None: ...

    def __post_init__(self) -> None:
        """Check every field and convert it."""
        validate.instance("grid", self.grid, Grid)
        pixels = validate.array("pixels", self.pixels, np.complex64, self.grid.shape)
        object.__setattr__(self, "pixels", pixels)

    def __repr__(self) -> str:
        """Return the shape and the extents of the grid, metres."""
        pixels = f"{reprs.by(self.shape)} complex pixels"
        return reprs.summary(self, pixels, reprs.extents(*self.grid.bounds_m))

    def _repr_html_(self) -> str:
        import clsas  # the public face, which imports the room of pictures when it is used

        return clsas.plot.image_html(self)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the pixels: (rows, columns), or that of the grid's points."""
        return self.grid.shape

    def db(self, *, reference: float | None = None) -> NDArray[np.float32]:
        """Return the pixels' amplitude in dB.

        Parameters
        ----------
        reference : float, optional
            Amplitude of 0 dB; the image's largest unless given.

        Returns
        -------
        ndarray of float32, shape `grid.shape`
            20 log10(amplitude / reference); minus infinity where a pixel is 0.

        Raises
        ------
        TypeError, ValueError
            If `reference` is not a positive number.
        """
        return level_db(self.pixels, reference)

    def plot(self, axes: Axes | None = None, **options: Any) -> Axes:
        """Draw the image in dB over metres; the same as `clsas.plot.image`.

        Parameters
        ----------
        axes : matplotlib.axes.Axes, optional
            Where to draw; those of a new pyplot figure unless given, so that notebooks and
            `pyplot.show` show it.
        **options
            Further arguments of `clsas.plot.image`, such as `dynamic_range_db`.

        Returns
        -------
        matplotlib.axes.Axes

        Raises
        ------
        ImportError
            If matplotlib is not installed.
        TypeError, ValueError
            As `clsas.plot.image` does.
        """
        import clsas

        return clsas.plot.image(self, axes, **options)

    def to_xarray(self) -> xarray.DataArray:
        """Return the image as xarray's: the level in dB with coordinates, names and units.

        The same as `clsas.to_xarray`, which says what it holds.

        Raises
        ------
        ImportError
            If xarray is not installed.
        """
        import clsas

        return clsas.to_xarray(self)

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> NDArray:
        """Return the pixels, so that NumPy's functions take an image.

        Parameters
        ----------
        dtype : dtype, optional
            complex64 unless given. Real ones are refused: they would lose the phase.
        copy : bool, optional
            True copies, False raises ValueError where a copy is needed, None copies only then.
        """
        wanted = np.dtype(np.complex64 if dtype is None else dtype)
        if wanted.kind != "c":
            raise TypeError(f"dtype must be complex, as pixels are, got {wanted}: take np.abs")
        if copy is False and wanted != self.pixels.dtype:
            raise ValueError(f"copy must not be False where complex64 becomes {wanted}")
        return self.pixels.astype(wanted, copy=bool(copy))


def holds_any(pixels: NDArray[np.complex64]) -> bool:
    """Return whether any pixel is not 0, as soon as one is found."""
    flat = pixels.reshape(-1)
    return any(flat[first : first + _AT_ONCE].any() for first in range(0, flat.size, _AT_ONCE))
