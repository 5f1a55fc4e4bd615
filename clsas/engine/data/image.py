"""Complex images on grids, and how they were formed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from clsas.engine.data import reprs, validate
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.certificate import Certificate
from clsas.engine.data.decibels import level_db
from clsas.engine.data.georeference import Georeference
from clsas.engine.data.grid import Grid
from clsas.engine.data.validate import ArgumentError, ArgumentTypeError

if TYPE_CHECKING:
    import xarray
    from matplotlib.axes import Axes

_AT_ONCE = 1 << 16  # pixels that are tested together
_METHODS = ("exact", "factorized", "wavenumber", "mosaic")


@dataclass(frozen=True, eq=False)
class Formed:
    """How an image was formed: `Image.formed`.

    Parameters
    ----------
    method : {"exact", "factorized", "wavenumber", "mosaic"}
        Method; "mosaic" for several blocks of patches, each formed by a plan of its own.
    tolerance_db : float or None
        Requested relative rms error, dB; None if none was requested.
    plan : str
        How the method formed the image, in words.
    predicted_error_db : float or None
        Predicted relative rms error, dB: of a factorized image against the exact one, of an exact
        image against the ideal sum, of a mosaic that of its worst patch. None if it is unknown, or
        the image is zero.
    beam : BeamWindow or None
        Weights of the channels; None without weights.
    left_out : sequence of str
        Effects that the image neglects, because their error is far below the tolerance.
    device : str
        Device and driver that formed the image.
    version : str
        Version of clsas.
    lines_digest : str
        Digest of the range lines: of all positions and ranges, and of up to 4096 samples, which are
        spread over all lines. Images of the same lines have the same digest. That of a mosaic
        depends on its patches, too.
    certificate : Certificate, optional
        Measured error of the image; None if it was not measured.
    misses : sequence of str
        Predicted and measured errors of earlier images of the same lines, which missed the
        tolerance, so that this one was formed.
    """

    method: str
    tolerance_db: float | None
    plan: str
    predicted_error_db: float | None
    beam: BeamWindow | None
    left_out: tuple[str, ...]
    device: str
    version: str
    lines_digest: str
    certificate: Certificate | None = None
    misses: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Check every field and convert it."""
        validate.one_of("method", self.method, _METHODS)
        for name in ("tolerance_db", "predicted_error_db"):
            if (value := getattr(self, name)) is not None:
                object.__setattr__(self, name, validate.number(name, value, "dB"))
        validate.instance("beam", self.beam, BeamWindow, type(None))
        for name, what in (("left_out", "names of effects"), ("misses", "texts")):
            texts = validate.entries(name, getattr(self, name), what)
            texts = [validate.text(f"every entry of {name}", each) for each in texts]
            object.__setattr__(self, name, tuple(texts))
        validate.instance("certificate", self.certificate, Certificate, type(None))
        for name in ("plan", "device", "version", "lines_digest"):
            validate.text(name, getattr(self, name))

    def describe(self) -> str:
        """Return everything but the digest as one line of text."""
        parts = [self.method]
        if self.tolerance_db is not None:
            parts.append(f"tolerance {reprs.quantity(self.tolerance_db, 'dB')}")
        if self.predicted_error_db is not None:
            parts.append(prediction(self.predicted_error_db))
        parts += [self.certificate.describe()] if self.certificate is not None else []
        parts += [self.plan] if self.plan else []
        if self.beam is not None:
            parts.append(repr(self.beam))
        if self.left_out:
            parts.append(f"without {' and '.join(self.left_out)}")
        return f"{', '.join(parts)}; on {self.device}, clsas {self.version}"

    def __repr__(self) -> str:
        """Return the description."""
        return f"Formed({self.describe()})"


@dataclass(frozen=True, eq=False)
class Image:
    """Complex image: pixels on a grid.

    NumPy's functions accept an `Image` in place of its pixels.

    Parameters
    ----------
    pixels : array_like of complex, shape `grid.shape`
        Pixels, stored as complex64. Their phase is that of the scene: the phase of the carrier at
        each pixel's range has been restored.
    grid : Grid
        Positions of the pixels.
    formed : Formed, optional
        How the image was formed. Imagers state it, and windows and files of an image keep it. It is
        None for sums of images, for pixels that were changed, and for images from elsewhere.

    Raises
    ------
    TypeError
        If the pixels are not complex, `grid` is not a Grid or `formed` is not a Formed.
    ValueError
        If the pixels do not have the grid's shape, a pixel is NaN or infinite, or the largest
        complex128 pixel is too large or too small for complex64.

    Notes
    -----
    Pixels that need no conversion are not copied, so do not write into them afterwards.

    Examples
    --------
    >>> import clsas
    >>> import numpy as np
    >>> grid = clsas.Grid.plane(x=(0, 1, 2), y=(40, 41, 2))
    >>> image = clsas.Image(np.array([[1, 0.1j], [0, 0.01]]), grid)
    >>> image
    Image(2 x 2 complex pixels, x 0 to 1 m, y 40 to 41 m, z 0 m)
    >>> image.db().round(2)
    array([[  0., -20.],
           [-inf, -40.]], dtype=float32)
    """

    pixels: NDArray[np.complex64]
    grid: Grid
    formed: Formed | None = None

    if TYPE_CHECKING:  # the constructor converts array_like arguments

        def __init__(
            self,
            pixels: ArrayLike,
            grid: Grid,
            formed: Formed | None = None,
        ) -> None: ...

    def __post_init__(self) -> None:
        """Check every field and convert it."""
        validate.instance("grid", self.grid, Grid)
        validate.instance("formed", self.formed, Formed, type(None))
        pixels = validate.array("pixels", self.pixels, np.complex64, self.grid.shape)
        object.__setattr__(self, "pixels", pixels)

    def __repr__(self) -> str:
        """Return the shape and the extents of the grid, metres."""
        pixels = f"{reprs.by(self.shape)} complex pixels"
        return reprs.summary(self, pixels, reprs.extents(*self.grid.bounds_m))

    def _repr_html_(self) -> str:
        import clsas  # imports clsas.plot only when it is used

        return clsas.plot.image_html(self)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the pixels: (rows, columns), or that of the grid's points."""
        return self.grid.shape

    @property
    def georeference(self) -> Georeference | None:
        """Georeference of the grid; None if unknown."""
        return self.grid.georeference

    def db(self, *, reference: float | None = None) -> NDArray[np.float32]:
        """Return the amplitude of the pixels in dB.

        Parameters
        ----------
        reference : float, optional
            Amplitude of 0 dB. The default is the largest amplitude of the image.

        Returns
        -------
        ndarray of float32, shape `grid.shape`
            20 log10(amplitude / reference), minus infinity where a pixel is 0.

        Raises
        ------
        TypeError, ValueError
            If `reference` is not a positive number.
        """
        return level_db(self.pixels, reference)

    def plot(self, axes: Axes | None = None, **options: Any) -> Axes:
        """Draw the image in dB over metres, as `clsas.plot.image` does.

        Parameters
        ----------
        axes : matplotlib.axes.Axes, optional
            Axes to draw on. By default a new pyplot figure is created, which notebooks and
            `pyplot.show` display.
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
            As for `clsas.plot.image`.
        """
        import clsas

        return clsas.plot.image(self, axes, **options)

    def to_xarray(self) -> xarray.DataArray:
        """Return the image as an xarray.DataArray: the level in dB with coordinates and units.

        This is the same as `clsas.to_xarray`, which describes the result.

        Raises
        ------
        ImportError
            If xarray is not installed.
        """
        import clsas

        return clsas.to_xarray(self)

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> NDArray:
        """Return the pixels, so that NumPy's functions accept an image.

        Parameters
        ----------
        dtype : dtype, optional
            A complex type, by default complex64. Real types are refused, because they would lose
            the phase.
        copy : bool, optional
            True copies. False raises ValueError if a copy is needed. None copies only if needed.
        """
        wanted = np.dtype(np.complex64 if dtype is None else dtype)
        if wanted.kind != "c":
            hint = "use `np.abs` for amplitudes"
            raise ArgumentTypeError("dtype", "be complex, as pixels are", str(wanted), hint)
        if copy is False and wanted != self.pixels.dtype:
            raise ArgumentError("copy", f"not be False if complex64 is to become {wanted}")
        return self.pixels.astype(wanted, copy=bool(copy))


def prediction(error_db: float | None) -> str:
    """Return a predicted error in words."""
    return "no predicted error" if error_db is None else f"predicted error {error_db:.1f} dB"


def holds_any(pixels: NDArray[np.complex64]) -> bool:
    """Return whether any pixel is not 0, without looking past the first one found."""
    flat = pixels.reshape(-1)
    return any(flat[first : first + _AT_ONCE].any() for first in range(0, flat.size, _AT_ONCE))
