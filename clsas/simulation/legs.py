"""Paths from a transmitter to points and back to a receiver, straight or along bent rays."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Bend(NamedTuple):
    """How rays leave an antenna, compared with straight paths, float64 [points] each.

    Attributes
    ----------
    level_1_m : ndarray
        Factor by which the offset of a point, along any axis, becomes the component of the ray's
        direction: 1 over the distance in homogeneous water.
    lift : ndarray
        Added to this component, times the component of the axis that points up.
    spreading_m : ndarray
        Length whose inverse is the amplitude; see `clsas.engine.water.rays.Rays`.
    speed_m_s : float
        Sound speed at the antenna.
    focused : bool
        True if the amplitude was limited near a caustic.
    """

    level_1_m: NDArray[np.float64]
    lift: NDArray[np.float64]
    spreading_m: NDArray[np.float64]
    speed_m_s: float
    focused: bool = False

    def at(self, kept: NDArray[np.bool_]) -> Bend:
        """Return the rays to some of the points."""
        return self._replace(
            level_1_m=self.level_1_m[kept],
            lift=self.lift[kept],
            spreading_m=self.spreading_m[kept],
        )


class Legs(NamedTuple):
    """Paths from a transmitter to points and back to a receiver, float64 [points] each.

    Attributes
    ----------
    delay_s : ndarray
        Two-way delays.
    out_m, back_m : ndarray
        Lengths of straight paths; `back_m` ends at the receiver's position when the echo arrives.
    bends : (Bend, Bend) or None
        How rays leave transmitter and receiver; None if they are straight.
    """

    delay_s: NDArray[np.float64]
    out_m: NDArray[np.float64]
    back_m: NDArray[np.float64]
    bends: tuple[Bend, Bend] | None = None

    @property
    def spreading_m2(self) -> NDArray[np.float64]:
        """Product of the lengths by which amplitudes fall on both ways."""
        if self.bends is None:
            return self.out_m * self.back_m
        return self.bends[0].spreading_m * self.bends[1].spreading_m

    @property
    def focused(self) -> bool:
        """True if an amplitude was limited near a caustic."""
        return self.bends is not None and any(bend.focused for bend in self.bends)

    def at(self, kept: NDArray[np.bool_]) -> Legs:
        """Return the paths of some of the points."""
        bends = self.bends and (self.bends[0].at(kept), self.bends[1].at(kept))
        return Legs(self.delay_s[kept], self.out_m[kept], self.back_m[kept], bends)
