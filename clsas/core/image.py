"""A complex image and where its pixels lie."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from clsas.core import validate
from clsas.core.grid import Grid

_AT_ONCE = 1 << 16  # pixels that are looked at


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
