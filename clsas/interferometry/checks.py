"""Checks of two banks, a grid and a range of heights, before anything is imaged."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsas.engine.data import validate
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.declared import Number, Span
from clsas.engine.data.geometry import pairwise_range_m
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines, antennas_of
from clsas.engine.data.validate import ArgumentError
from clsas.engine.factorized.planner import TOLERANCE
from clsas.interferometry.baseline import Baseline
from clsas.interferometry.coherence import LEAST_LOOKS, Window

_APART = 0.1  # relative change of the distance between banks that waves of the track may cause
_MOST_CYCLES = 1e3  # of phase within the search; more need more planes than anyone has time for
_LEAST_STRAIGHT = 0.7  # length of the mean direction of the track: 0.64 for a semicircle
_POINTS = 5  # along either side of a grid, whose geometry is checked; arbitrary
_LEAST_PHASE_RAD = 0.1  # over the whole search; less is not above the noise of usual coherences

HEIGHTS_TOLERANCE_DB = -40.0
"""Tolerance of the images of two banks for which none is requested."""
SEARCH = Span(
    "m", least=-1e8, most=1e8, help="Heights above the grid between which the seabed lies."
)
"""Declares the heights to search. Positions may lie up to ten times as far away."""
WINDOW = Number(
    "m",
    above=0.0,
    help="Side of the windows, which is the resolution of the heights.",
    default="that of about 50 independent samples",
)
"""Declares the windows in which the phase between the banks is averaged."""
PATCH_PIXELS = 1024
"""Pixels along a patch of a mosaic of heights by default, which then takes about 0.6 GiB."""
PATCH = Number(
    "m", above=0.0, help="Side of the patches of a store.", default=f"{PATCH_PIXELS} pixels"
)
"""Declares the approximate side of the patches of a mosaic of heights."""
COHERENCE = Number(least=0.1, most=0.99, help="Smallest coherence of a valid height.")
"""Declares the coherence from which on heights are valid."""
KNOWN_HEIGHT = Number(
    "m",
    least=-validate.FARTHEST_M,
    most=validate.FARTHEST_M,
    help="Height of a level seabed above the grid of the heights.",
    default="not known",
)
"""Declares the height of a level seabed."""


class UnmeasurableError(ArgumentError):
    """Two banks do not show the heights of a grid, as the message explains."""


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


def check_grid(grid: Grid) -> None:
    """Raise ValueError unless a grid is a plane or height map that heights along z can raise."""
    if grid.points_m is not None:
        allowed = "be a plane or height map, above which heights are measured"
        raise ArgumentError("grid", allowed, "arbitrary points")
    rows, columns = grid.shape
    if min(rows, columns) < 2:
        raise ArgumentError("grid", "have at least 2 rows and 2 columns", f"{rows} x {columns}")
    normal = np.cross(*grid.vectors_m[1:])
    if abs(normal[2]) < 0.1 * float(np.linalg.norm(normal)):
        given = f"a vertical one with steps of {grid.row_step_m} and {grid.column_step_m} m"
        raise ArgumentError("grid", "be a plane that heights along z can raise", given)


def check_pair(a: RangeLines, b: RangeLines) -> None:
    """Raise TypeError or ValueError unless two sets of lines can be those of two banks."""
    validate.instance("a", a, RangeLines)
    validate.instance("b", b, RangeLines)
    if a.channels != b.channels or len(a.ping_starts) != len(b.ping_starts):
        allowed = "contain the same pings, with as many channels each"
        raise ArgumentError("a and b", allowed, f"{_pings(a)} and {_pings(b)}")
    for name, unit in (("carrier_hz", "Hz"), ("sound_speed_m_s", "m/s"), ("range_step_m", "m")):
        first, second = getattr(a, name), getattr(b, name)
        if not math.isclose(first, second, rel_tol=1e-9):
            got = f"{first:.9g} and {second:.9g} {unit}"
            raise ArgumentError("a and b", f"have the same `{name}`", got)
    if a.sound_speed != b.sound_speed:
        raise ArgumentError(
            "a and b",
            "have the same `sound_speed`, since echoes reach both banks through the same water",
            f"{a.sound_speed!r} and {b.sound_speed!r}",
        )
    apart_m = np.linalg.norm(a.phase_centres_m - b.phase_centres_m, axis=1)
    usual_m = float(np.median(apart_m))
    worst = int(np.abs(apart_m - usual_m).argmax())
    if abs(apart_m[worst] - usual_m) > _APART * usual_m + 1e-6:
        raise ArgumentError(
            "a and b",
            "contain the same pings in the same order",
            f"phase centres {usual_m:.3g} m apart in most channels, and {apart_m[worst]:.3g} m in "
            f"channel {worst}",
        )


def check_echoes(a: RangeLines, b: RangeLines) -> None:
    """Raise ValueError if the samples of a bank are all zero."""
    for name, lines in (("a", a), ("b", b)):
        if not lines.samples.any():
            raise ArgumentError(name, "contain echoes", "samples that are all zero")


def _pings(lines: RangeLines) -> str:
    return f"{len(lines.ping_starts)} pings of {lines.channels} channels in all"


def check_geometry(
    baseline: Baseline,
    grid: Grid,
    search_m: tuple[float, float],
    relative_band: float,
    least_coherence: float,
) -> float:
    """Return the height of ambiguity, metres; raise UnmeasurableError if there are no heights."""
    points_m = grid.spread(_POINTS)
    low_m, high_m = search_m
    straightness = float(np.linalg.norm(baseline.course(points_m.mean(axis=0))))
    if straightness < _LEAST_STRAIGHT:
        raise UnmeasurableError(
            "a and b",
            "see the grid from a track that turns by less than 170 degrees",
            hint="banks on a circle see no curves of equal range: divide the channels into arcs",
        )
    # These come first: far from the sonar the phase hardly changes, so a search that reaches too
    # far would be reported as a missing baseline.
    _check_below(baseline, points_m, search_m)
    _check_ranges(baseline, points_m, search_m)
    up = np.array([0.0, 0.0, 1.0])
    sights = [baseline.sight(points_m + offset_m * up) for offset_m in (low_m, 0.0, high_m)]
    rad_m = np.concatenate([each.rad_m for each in sights])
    usual_rad_m = float(np.median(np.abs(rad_m)))
    if usual_rad_m * (high_m - low_m) < _LEAST_PHASE_RAD:
        apart_m = float(np.median(np.linalg.norm(_separation_m(baseline), axis=1)))
        raise UnmeasurableError(
            "a and b",
            f"be apart across the line of sight, with a phase that changes by {_LEAST_PHASE_RAD:g} "
            "rad or more over `search_m`",
            f"phase centres {apart_m:.3g} m apart, and {usual_rad_m * (high_m - low_m):.2g} rad",
        )
    if (rad_m > 0).any() and (rad_m < 0).any():
        raise UnmeasurableError(
            "a and b",
            "see all of the grid and `search_m` from one side",
            "a phase whose sign changes within them",
            "divide the grid at the track's nadir",
        )
    ambiguity_m = 2 * math.pi / usual_rad_m
    if high_m - low_m > _MOST_CYCLES * ambiguity_m:
        allowed = f"span at most {_MOST_CYCLES:g} heights of ambiguity ({ambiguity_m:.3g} m each)"
        raise UnmeasurableError("search_m", allowed, f"{high_m - low_m:g} m")
    _check_decorrelation(baseline, points_m, ambiguity_m, relative_band, least_coherence)
    return ambiguity_m


def _separation_m(baseline: Baseline) -> NDArray[np.float64]:
    some = baseline.channels
    return baseline.b.phase_centres_m[some] - baseline.a.phase_centres_m[some]


def _check_below(
    baseline: Baseline, points_m: NDArray[np.float64], search_m: tuple[float, float]
) -> None:
    """Raise UnmeasurableError if heights to search reach the antennas."""
    some = baseline.channels
    antennas_m = np.concatenate([baseline.a.tx_m[some], baseline.a.rx_m[some]])
    lowest_m = float(antennas_m[:, 2].min() - points_m[:, 2].max())
    highest_m = float(antennas_m[:, 2].max() - points_m[:, 2].min())
    if lowest_m > 0 and search_m[1] >= lowest_m:
        allowed = f"end below the sonar, which is {lowest_m:.4g} m above the grid"
        raise UnmeasurableError("search_m", allowed, f"{search_m[1]:g} m")
    if highest_m < 0 and search_m[0] <= highest_m:
        allowed = f"begin above the sonar, which is {-highest_m:.4g} m below the grid"
        raise UnmeasurableError("search_m", allowed, f"{search_m[0]:g} m")


def _check_ranges(
    baseline: Baseline, points_m: NDArray[np.float64], search_m: tuple[float, float]
) -> None:
    """Raise UnmeasurableError if no line reaches the ends of the search anywhere on the grid."""
    some = baseline.channels
    first_m, last_m = baseline.a.first_range_m[some], baseline.a.last_range_m[some]
    for offset_m in search_m:
        raised_m = points_m + [0.0, 0.0, offset_m]
        range_m = pairwise_range_m(raised_m, *antennas_of(baseline.a, some))
        if not ((range_m >= first_m) & (range_m <= last_m)).any():
            raise UnmeasurableError(
                "search_m",
                f"lie within the range of the lines, {first_m.min():.5g} to {last_m.max():.5g} m",
                f"{offset_m:g} m, where the grid is at {range_m.min():.5g} to "
                f"{range_m.max():.5g} m",
            )


def _check_decorrelation(
    baseline: Baseline,
    points_m: NDArray[np.float64],
    ambiguity_m: float,
    relative_band: float,
    least_coherence: float,
) -> None:
    """Raise UnmeasurableError if the banks are so far apart that a level seabed is not coherent.

    From another elevation, one frequency samples another wavenumber of the seabed. The shift,
    relative to the carrier, is |D|/|g| with D and g the horizontal gradients of the difference and
    the mean of the ranges. Only the part of the band that both banks share is coherent (Gatelli et
    al. 1994).
    """
    of_a, of_b = (each[:, :2] for each in baseline.gradients(points_m))
    of_ground = np.linalg.norm(of_a + of_b, axis=1) / 2
    shift = np.median(np.linalg.norm(of_a - of_b, axis=1) / np.maximum(of_ground, 1e-9))
    left = 1 - float(shift) / relative_band
    if left < least_coherence:
        apart_m = float(np.median(np.linalg.norm(_separation_m(baseline), axis=1)))
        raise UnmeasurableError(
            "a and b",
            "be closer together",
            f"{2 * apart_m:.3g} m between the banks",
            f"the height of ambiguity is {ambiguity_m:.2g} m and a level seabed has a coherence of "
            f"at most {max(left, 0):.2f}, less than `least_coherence` = {least_coherence:g}",
        )


def window_within(grid: Grid, window_m: float) -> Window:
    """Return the window of about `window_m`; raise ValueError unless it fits into a grid."""
    _, *steps_m = grid.vectors_m
    sides_m = [
        n * float(np.linalg.norm(step))
        for n, step in zip(grid.shape, steps_m, strict=True)
        if n > 1  # the window of a single row is that row
    ]
    if not sides_m:
        raise ArgumentError("grid", "have more than one pixel")
    validate.number("window_m", window_m, "m", above=0.0, most=min(sides_m))
    return Window.of(grid, window_m)


def check_looks(window_m: float, looks: float) -> None:
    """Raise UnmeasurableError if a window has too few looks to estimate a coherence."""
    if looks < LEAST_LOOKS:
        allowed = f"contain at least {LEAST_LOOKS:g} independent samples of the images"
        raise UnmeasurableError("window_m", allowed, f"{window_m:g} m, which contains {looks:.1f}")
