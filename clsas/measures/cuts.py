"""Cuts through a point response, with their resolution and side lobes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsas.engine.data import reprs
from clsas.engine.data.grid import Axis
from clsas.engine.data.validate import ArgumentError

_LOBES = 10  # side lobes on each side that count in the ISLR
_UPSAMPLING = 32  # points of a cut per pixel


@dataclass(frozen=True, eq=False)
class Cut:
    """Cut through a point response along one axis, with its resolution and side lobes.

    The main lobe lies between the first minima on both sides. Side lobes follow outwards, each
    between two minima of the amplitude. The first value of a pair is for the side of smaller
    coordinates, the second for that of larger ones.

    Attributes
    ----------
    axis : str
        Direction of the cut: "x", "y" or "z", or "along columns" or "along rows" if it is parallel
        to none of them.
    offset_m : ndarray of float64, shape [points]
        Distance from the peak in metres.
    level_db : ndarray of float64, shape [points]
        Amplitude relative to the peak, in dB.
    resolution_m : float
        Width of the main lobe at half the power of the peak (-3.01 dB), in metres.
    pslr_nearest_db : (float, float)
        Peak of the first side lobe relative to that of the main lobe, in dB.
    pslr_db : (float, float)
        Peak of the highest side lobe within the cut, relative to that of the main lobe, in dB.
    islr_db : float
        Energy of the nearest side lobes on both sides relative to that of the main lobe, in dB.
    lobes : (int, int)
        Number of whole side lobes in the ISLR: 10, or fewer if the cut ends before.
    """

    axis: str
    offset_m: NDArray[np.float64]
    level_db: NDArray[np.float64]
    resolution_m: float
    pslr_nearest_db: tuple[float, float]
    pslr_db: tuple[float, float]
    islr_db: float
    lobes: tuple[int, int]

    __repr__ = reprs.of_fields


def measure_cut(
    axis: Axis,
    samples: NDArray,
    peak: float,
    amplitude: float,
    extent_m: float | None,
) -> Cut:
    """Return the cut of a line of pixels through a peak.

    Parameters
    ----------
    axis : Axis
        Axis along which the pixels lie.
    samples : complex128 [pixels]
    peak : float
        Index of the peak, between pixels.
    amplitude : float
        Amplitude of the peak.
    extent_m : float or None
        Distance from the peak at which the cut ends, in metres; None for that of the last pixel.
    """
    from scipy import signal  # slow to import

    step_m = axis.step_m
    fine = signal.resample(samples, _UPSAMPLING * len(samples))
    offset = (np.arange(len(fine)) / _UPSAMPLING - peak) * step_m
    # Beyond the last sample, the periodic interpolation returns to the first one.
    inside = np.arange(len(fine)) <= _UPSAMPLING * (len(samples) - 1)
    if extent_m is not None:
        inside &= np.abs(offset) <= extent_m
    power = np.abs(fine[inside] / amplitude) ** 2
    offset = offset[inside]
    if step_m < 0:
        offset, power = offset[::-1], power[::-1]

    top = int(np.abs(offset).argmin())
    before = _Flank.of(power[top::-1], f"smaller {axis.name}")
    after = _Flank.of(power[top:], f"larger {axis.name}")
    main = before.main + after.main - float(power[top])  # both flanks contain the peak
    return Cut(
        axis=axis.name,
        offset_m=offset,
        level_db=_decibels(power),
        resolution_m=(before.half_width + after.half_width) * abs(step_m) / _UPSAMPLING,
        pslr_nearest_db=(before.nearest_db, after.nearest_db),
        pslr_db=(before.highest_db, after.highest_db),
        islr_db=float(_decibels((before.side_lobes + after.side_lobes) / main)),
        lobes=(before.lobes, after.lobes),
    )


@dataclass(frozen=True)
class _Flank:
    """Half of a cut, from the peak outwards. Energies are sums of the power of its points.

    Attributes
    ----------
    half_width : float
        Points from the peak to half of its power.
    main, side_lobes : float
        Energy of the main lobe, and of the nearest side lobes.
    nearest_db, highest_db : float
        Peak of the first and of the highest side lobe, in dB.
    lobes : int
        Number of whole side lobes in `side_lobes`.
    """

    half_width: float
    main: float
    side_lobes: float
    nearest_db: float
    highest_db: float
    lobes: int

    @classmethod
    def of(cls, power: NDArray[np.float64], where: str) -> _Flank:
        """Measure a flank from its power relative to the peak; `where` names it in messages."""
        from scipy import signal  # slow to import

        minima = signal.argrelmin(power)[0]
        if len(minima) < 2 or power[: minima[0] + 1].min() > 0.5:
            raise ArgumentError(
                "image",
                f"contain a whole side lobe at {where} (within `extent_m`)",
                hint="choose a larger image or `extent_m`; the point is too close to the border, "
                "or the peak does not belong to a point",
            )
        first, second, last = minima[0], minima[1], minima[: _LOBES + 1][-1]
        below = int(np.argmax(power < 0.5))
        beyond = (0.5 - power[below]) / (power[below - 1] - power[below])
        return cls(
            half_width=float(below - beyond),
            main=float(power[:first].sum()),
            side_lobes=float(power[first:last].sum()),
            nearest_db=float(_decibels(power[first:second].max())),
            highest_db=float(_decibels(power[first:].max())),
            lobes=min(len(minima), _LOBES + 1) - 1,
        )


def _decibels(power: ArrayLike) -> NDArray:
    """Return 10 log10(power), not below -300 dB."""
    return 10 * np.log10(np.maximum(power, 1e-30))
