"""What is out there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsas import validate


@dataclass(frozen=True, eq=False)
class PointTargets:
    """Point reflectors under the Born approximation: each scatters alone (THESIS [8]).

    Parameters
    ----------
    positions_m : array_like, [points, 3]
        World positions.
    amplitudes : array_like, [points] or scalar
        Real or complex amplitudes; 1 unless given.

    Raises
    ------
    TypeError, ValueError
        If an array has the wrong kind or shape, is empty or not finite.
    """

    positions_m: NDArray[np.float64]
    amplitudes: NDArray[np.complex128] = 1.0  # type: ignore[assignment]

    def __post_init__(self) -> None:
        """Check every field and convert it."""
        positions = validate.array("positions_m", self.positions_m, np.float64, (None, 3))
        given = np.asarray(self.amplitudes)
        # A real amplitude is a complex one without phase; only numbers are widened.
        given = given.astype(np.complex128) if given.dtype.kind in "iuf" else given
        amplitudes = validate.array(
            "amplitudes", given, np.complex128, (len(positions),), broadcast=True
        )
        object.__setattr__(self, "positions_m", positions)
        object.__setattr__(self, "amplitudes", amplitudes)

    @property
    def points(self) -> int:
        """Number of points."""
        return len(self.positions_m)
