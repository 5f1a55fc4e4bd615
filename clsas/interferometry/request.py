"""Settings of a measurement of heights, checked before any image is formed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

from numpy.typing import ArrayLike

from clsas.engine.data import validate
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.grid import Grid
from clsas.engine.factorized.planner import TOLERANCE
from clsas.interferometry.checks import COHERENCE, SEARCH, WINDOW
from clsas.interferometry.interferogram import window_within


@dataclass(frozen=True, eq=False)
class Request:
    """A request for heights; see `clsas.heights`.

    Attributes
    ----------
    search_m : (lowest, highest)
    window_m : float or None
        Side of the windows; None for the default.
    tolerance_db, least_coherence : float
    beam : BeamWindow or None
    """

    search_m: tuple[float, float]
    window_m: float | None
    tolerance_db: float
    least_coherence: float
    beam: BeamWindow | None

    @classmethod
    def checked(
        cls,
        grid: Grid,
        search_m: ArrayLike,
        window_m: float | None,
        tolerance_db: float,
        least_coherence: float,
        beam: BeamWindow | None,
    ) -> Self:
        """Return the request; raise TypeError or ValueError unless it is valid for a grid."""
        search = SEARCH.check("search_m", search_m)
        tolerance_db = TOLERANCE.check("tolerance_db", tolerance_db)
        least_coherence = COHERENCE.check("least_coherence", least_coherence)
        validate.instance("beam", beam, BeamWindow, type(None))
        if window_m is not None:
            window_m = WINDOW.check("window_m", window_m)
            window_within(grid, window_m)
        return cls(search, window_m, tolerance_db, least_coherence, beam)
