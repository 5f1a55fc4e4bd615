"""What is out there: point targets, seabed with shadows, and three built-in seabeds.

A scene is asked, view by view, for the points that are seen (`seen`) and for spheres that hold
them all (`spheres`). Point targets are always seen; a seabed's scatterers only where they are lit
and within the beam.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft
from scipy.ndimage import map_coordinates

from clsas.core import reprs, validate

_TILE_M = 2.0  # side of what is within the beam or not as a whole
_CLEAR = -1e30  # elevation where there is no seabed
_FARTHEST_M = 1e9  # of a point: float64 leaves 1e-7 m of its range


class View(NamedTuple):
    """From where, and through which pattern, some channels see the scene.

    Attributes
    ----------
    position_m : ndarray, [3]
        In the middle between transmitter and receivers.
    reach_m : float
        The elements lie no farther than this from it.
    gain : callable or None
        gain(directions [points, 3], slack [points]) is an upper bound of the two-way amplitude
        pattern, and of all that it is for directions whose components differ by up to `slack`.
        None: no element directs sound.
    """

    position_m: NDArray[np.float64]
    reach_m: float = 0.0
    gain: Callable[[NDArray, NDArray | float], NDArray] | None = None


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
        If an array has the wrong kind or shape, is empty or not finite, or a position is beyond
        1e9 m.
    """

    positions_m: NDArray[np.float64]
    amplitudes: NDArray[np.complex128] = 1.0  # type: ignore[assignment]

    if TYPE_CHECKING:  # arrays are converted: the constructor takes what holds numbers

        def __init__(
            self,
            positions_m: ArrayLike,
            amplitudes: ArrayLike = 1.0,
        ) -> None: ...

    def __post_init__(self) -> None:
        """Check every field and convert it."""
        positions = validate.array("positions_m", self.positions_m, np.float64, (None, 3))
        farthest_m = float(np.abs(positions).max())
        validate.number("the farthest of positions_m", farthest_m, "m", most=_FARTHEST_M)
        given = np.asarray(self.amplitudes)
        # A real amplitude is a complex one without phase; only numbers are widened.
        given = given.astype(np.complex128) if given.dtype.kind in "iuf" else given
        amplitudes = validate.array(
            "amplitudes", given, np.complex128, (len(positions),), broadcast=True
        )
        object.__setattr__(self, "positions_m", positions)
        object.__setattr__(self, "amplitudes", amplitudes)

    def __repr__(self) -> str:
        """Return the number of points and where they lie."""
        place_m = self.positions_m
        return reprs.summary(
            self,
            f"{self.points} point{'s' * (self.points > 1)}",
            reprs.extents(place_m.min(axis=0), place_m.max(axis=0)),
        )

    @property
    def points(self) -> int:
        """Number of points."""
        return len(self.positions_m)

    @property
    def error(self) -> float:
        """Relative error that an echo may have: none but rounding."""
        return 0.0

    def spheres(self, view: View) -> tuple[NDArray, NDArray]:
        """Return the points as spheres, centres [points, 3] and radii [points] of zero."""
        return self.positions_m, np.zeros(self.points)

    def seen(self, view: View) -> tuple[NDArray, NDArray]:
        """Return all positions and amplitudes, those in the beam's middle first."""
        if view.gain is None:
            return self.positions_m, self.amplitudes
        offsets = self.positions_m - view.position_m
        distance = np.maximum(np.linalg.norm(offsets, axis=1), np.finfo(float).tiny)
        order = np.argsort(-view.gain(offsets / distance[:, None], 0.0), kind="stable")
        return self.positions_m[order], self.amplitudes[order]


@dataclass(frozen=True, eq=False)
class Seabed:
    """A patch of seabed: a height field covered with scatterers, which casts shadows on itself.

    Heights are linear between the points of a regular lattice. On the surface lie scatterers at
    random, `density_m2` per m2 of it, with circular complex Gaussian amplitudes: with several per
    resolution cell the image is fully developed speckle. A seabed returns from every m2 of its
    surface, on average over the seeds, an intensity (sum of squared amplitudes) of

        texture^2 cos^2(angle of incidence),

    that is Lambert's law. From every side that faces away, and wherever the straight way to the
    sonar does not clear the heights, it returns nothing.

    Parameters
    ----------
    x_m, y_m : (first, last)
        Where the lattice's first and last columns and rows lie, world coordinates, ascending.
    heights_m : array_like, [rows, columns]
        Height (world z) of row y and column x; at least 2 x 2.
    texture : array_like, [rows, columns], or scalar
        Backscattered amplitude of 1 m2 seen perpendicularly, at least 0; linear in between.
    density_m2 : float
        Scatterers per m2 of surface. 600 are 3 per resolution cell of 5 cm by 10 cm.
    seed : int
        Of positions and amplitudes, at least 0; the same seed gives the same scatterers.
    floor_db : float
        -200 to -10 dB. Scatterers for which an upper bound of the two-way element pattern is
        below this are left out, in groups of about 2 m; what they would have added is below this,
        relative to the same scatterer in the beam's middle. All other echoes are right to a third
        of it.

    Raises
    ------
    TypeError, ValueError
        If a value has the wrong kind or shape, is not finite or outside its limits, or there are
        more scatterers than fit into memory.

    Notes
    -----
    For equal transmitter and receiver, long against the wavelength, a pattern sinc^2(u) is below
    the floor F from u = 1/(pi sqrt(F)) on. What a homogeneous seabed loses with it is about
    0.0038/u^3 of its energy: -47 dB for the default of -50 dB, where u = 5.7.

    A shadow is found by the elevation's running maximum along rays of a polar fan around the
    sonar: a scatterer at ground range g is lit if its elevation tan = (z - z_sonar)/g is not below
    the largest on the nearest ray up to one or two lattice steps before it. Rays lie at most one
    step apart. So a shadow's sides are right to half a step, and its end to what two steps on what
    casts it make; what is thinner than two steps casts no reliable shadow.
    """

    x_m: tuple[float, float]
    y_m: tuple[float, float]
    heights_m: NDArray[np.float64]
    texture: NDArray[np.float64] = 1.0  # type: ignore[assignment]
    density_m2: float = 600.0
    seed: int = 0
    floor_db: float = -50.0

    if TYPE_CHECKING:  # arrays are converted: the constructor takes what holds numbers

        def __init__(
            self,
            x_m: tuple[float, float],
            y_m: tuple[float, float],
            heights_m: ArrayLike,
            texture: ArrayLike = 1.0,
            density_m2: float = 600.0,
            seed: int = 0,
            floor_db: float = -50.0,
        ) -> None: ...

    def __post_init__(self) -> None:
        """Check every field and convert it."""
        for name in ("x_m", "y_m"):
            object.__setattr__(self, name, _extent(name, getattr(self, name)))
        heights = validate.array("heights_m", self.heights_m, np.float64, (None, None))
        if min(heights.shape) < 2:
            raise ValueError(
                f"heights_m must have at least 2 rows and 2 columns, got {heights.shape}"
            )
        texture: Any = self.texture
        if np.ndim(texture) == 0:
            texture = np.full(heights.shape, validate.number("texture", texture, least=0.0))
        texture = validate.array("texture", texture, np.float64, heights.shape)
        if texture.min() < 0:
            raise ValueError(f"texture must be at least 0, got {texture.min():g}")
        validate.positive("density_m2", self.density_m2, "per m2")
        validate.count("seed", self.seed, least=0)
        validate.number("floor_db", self.floor_db, "dB", least=-200.0, most=-10.0)
        object.__setattr__(self, "heights_m", heights)
        object.__setattr__(self, "texture", texture)
        validate.memory("density_m2", 100 * self.density_m2 * self._cell_areas_m2.sum())

    def __repr__(self) -> str:
        """Return extents, the lattice's step and the density of scatterers."""
        low_m, high_m = zip(self.x_m, self.y_m, (self._level_m, self.heights_m.max()), strict=True)
        steps = " x ".join(reprs.quantity(step, "m") for step in self.steps_m)
        return reprs.summary(
            self,
            reprs.extents(low_m, high_m),
            f"steps of {steps}",
            f"{self.density_m2:g} scatterers per m2",
        )

    @property
    def steps_m(self) -> tuple[float, float]:
        """Distance between the lattice's columns, and between its rows."""
        rows, columns = self.heights_m.shape
        return (self.x_m[1] - self.x_m[0]) / (columns - 1), (self.y_m[1] - self.y_m[0]) / (rows - 1)

    @property
    def points(self) -> int:
        """Number of scatterers."""
        return len(self._scatterers.amplitudes)

    @property
    def error(self) -> float:
        """Relative error that an echo may have: a third of the floor."""
        return 10 ** (self.floor_db / 20) / 3

    def height_m(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.float64]:
        """Return the height at places on the patch, which broadcast; not a number beside it."""
        x, y = np.broadcast_arrays(np.asarray(x_m, np.float64), np.asarray(y_m, np.float64))
        dx, dy = self.steps_m
        where = [((y - self.y_m[0]) / dy).ravel(), ((x - self.x_m[0]) / dx).ravel()]
        heights = map_coordinates(self.heights_m, where, order=1, mode="constant", cval=np.nan)
        return heights.reshape(x.shape)

    def lit(self, points_m: ArrayLike, eye_m: ArrayLike) -> NDArray[np.bool_]:
        """Return which points have a clear way to a position, as described in the Notes.

        Parameters
        ----------
        points_m : array_like, [points, 3]
            On the seabed or above it.
        eye_m : array_like, [3]
            From where it is looked at.

        Raises
        ------
        TypeError, ValueError
            If an array has the wrong kind or shape, is empty or not finite.
        """
        points = validate.array("points_m", points_m, np.float64, (None, 3))
        eye = validate.array("eye_m", eye_m, np.float64, (3,))
        return self._lit(np.ascontiguousarray((points - eye).T), eye)

    def spheres(self, view: View) -> tuple[NDArray, NDArray]:
        """Return spheres that hold all that is seen, centres [spheres, 3] and radii [spheres]."""
        kept = self._in_beam(view)
        # Some window is needed even where nothing is heard.
        kept = kept if len(kept) else np.arange(len(self._scatterers.radii_m))
        return self._scatterers.centres_m[kept], self._scatterers.radii_m[kept]

    def seen(self, view: View) -> tuple[NDArray, NDArray]:
        """Return positions [points, 3] and amplitudes [points] of the scatterers that are seen.

        They come tile by tile, those in the beam's middle first.
        """
        cast = self._scatterers
        kept = self._in_beam(view)
        first, counts = cast.first[kept], cast.first[kept + 1] - cast.first[kept]
        chosen = np.arange(counts.sum()) + np.repeat(first - np.cumsum(counts) + counts, counts)
        positions = cast.positions_m[:, chosen]
        offsets = positions - view.position_m[:, None]
        ways = offsets.astype(np.float32)
        # Lambert's law: the amplitude falls with the cosine of the angle of incidence.
        facing = -np.einsum("ip,ip->p", cast.normals[:, chosen], ways)
        facing /= np.sqrt(np.einsum("ip,ip->p", ways, ways))
        lit = np.flatnonzero((facing > 0) & self._lit(offsets, view.position_m))
        return positions[:, lit].T, cast.amplitudes[chosen[lit]] * facing[lit]

    def _in_beam(self, view: View) -> NDArray[np.intp]:
        """Return the tiles where the pattern may reach the floor, the beam's middle first."""
        cast = self._scatterers
        if view.gain is None:
            return np.arange(len(cast.radii_m))
        offsets = cast.centres_m - view.position_m
        distance = np.maximum(np.linalg.norm(offsets, axis=1), np.finfo(float).tiny)
        near = cast.radii_m + view.reach_m
        # Directions from any element to any point differ by no more than this.
        slack = np.where(distance > near, near / np.maximum(distance - near, 1e-9 * near), np.inf)
        gains = view.gain(offsets / distance[:, None], slack)
        order = np.argsort(-view.gain(offsets / distance[:, None], 0.0), kind="stable")
        return order[gains[order] >= 10 ** (self.floor_db / 20)]

    def _lit(self, offsets_m: NDArray[np.float64], eye_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which points, relative to the eye as [3, points], are lit."""
        x, y, z = offsets_m
        lowest = eye_m[2] + min(z.min(initial=0.0), 0.0)
        if not x.size or (lowest >= self._level_m and not self._heights.any()):
            return np.ones(x.size, bool)
        step = min(self.steps_m)
        # Azimuth is measured from the way to the patch's middle, so that no ray of a patch that
        # lies to one side is at +-180 degrees.
        centre = np.arctan2(sum(self.y_m) / 2 - eye_m[1], sum(self.x_m) / 2 - eye_m[0])
        cosine, sine = np.cos(centre), np.sin(centre)
        ground = np.sqrt(x**2 + y**2)
        azimuth = np.arctan2(cosine * y - sine * x, cosine * x + sine * y)
        # The rays do not depend on the points, so that neither does what is lit.
        away = np.abs([np.subtract(self.x_m, eye_m[0]), np.subtract(self.y_m, eye_m[1])])
        ray_step = step / max(np.hypot(*away.max(axis=1)), step)
        first_ray = np.floor(azimuth.min() / ray_step)
        ray = np.rint(azimuth / ray_step - first_ray).astype(np.intp)
        angles = centre + ray_step * (first_ray + np.arange(ray.max() + 1))
        nearest = max(_distance(eye_m[0], self.x_m), _distance(eye_m[1], self.y_m), step)
        before = np.floor((ground - nearest) / step).astype(np.intp) - 1
        ranges = nearest + step * np.arange(max(before.max(), 0) + 1)

        validate.memory("heights_m", 40 * len(angles) * len(ranges))
        dx, dy = self.steps_m
        columns = (np.cos(angles)[:, None] * ranges + (eye_m[0] - self.x_m[0])) / dx
        rows = (np.sin(angles)[:, None] * ranges + (eye_m[1] - self.y_m[0])) / dy
        fan = map_coordinates(
            self._heights, [rows, columns], np.float32, order=1, mode="constant", cval=_CLEAR
        )
        highest = np.maximum.accumulate(
            (fan - np.float32(eye_m[2] - self._level_m)) / ranges.astype(np.float32), axis=1
        )

        elevation = z / np.maximum(ground, np.finfo(float).tiny)
        return (before < 0) | (elevation >= highest[ray, np.maximum(before, 0)])

    @property
    def _level_m(self) -> float:
        """Height that single precision counts from."""
        return float(self.heights_m.min())

    @cached_property
    def _heights(self) -> NDArray[np.float32]:
        return (self.heights_m - self._level_m).astype(np.float32)

    @property
    def _cell_areas_m2(self) -> NDArray[np.float64]:
        """Surface of every cell between four lattice points, [rows - 1, columns - 1]."""
        dx, dy = self.steps_m
        h = self.heights_m
        along_x = (h[:-1, 1:] - h[:-1, :-1] + h[1:, 1:] - h[1:, :-1]) / (2 * dx)
        along_y = (h[1:, :-1] - h[:-1, :-1] + h[1:, 1:] - h[:-1, 1:]) / (2 * dy)
        return dx * dy * np.sqrt(1 + along_x**2 + along_y**2)

    @cached_property
    def _scatterers(self) -> _Scatterers:
        """The scatterers, tile by tile; drawn when first asked for."""
        random = np.random.default_rng(self.seed)
        counts = random.poisson(self.density_m2 * self._cell_areas_m2)
        dx, dy = self.steps_m
        rows, columns = np.indices(counts.shape)
        tiles = rows // max(1, round(_TILE_M / dy)), columns // max(1, round(_TILE_M / dx))
        tile = (tiles[0] * (tiles[1].max() + 1) + tiles[1]).ravel()
        order = np.argsort(tile, kind="stable")
        cells = np.repeat(order, counts.ravel()[order])
        if not cells.size:
            raise ValueError(
                f"density_m2 must put some scatterer on the seabed, got {self.density_m2:g} per m2"
            )
        row, column = np.divmod(cells, counts.shape[1])
        u, v = random.random((2, len(cells)))
        h = self.heights_m
        corners = [h[row, column], h[row, column + 1], h[row + 1, column], h[row + 1, column + 1]]
        z = (1 - v) * ((1 - u) * corners[0] + u * corners[1])
        z += v * ((1 - u) * corners[2] + u * corners[3])
        slopes = (
            ((1 - v) * (corners[1] - corners[0]) + v * (corners[3] - corners[2])) / dx,
            ((1 - u) * (corners[2] - corners[0]) + u * (corners[3] - corners[1])) / dy,
        )
        positions = np.stack([self.x_m[0] + dx * (column + u), self.y_m[0] + dy * (row + v), z])
        normals = np.stack([-slopes[0], -slopes[1], np.ones_like(z)]).astype(np.float32)
        normals /= np.sqrt(np.einsum("ip,ip->p", normals, normals))
        deviation = map_coordinates(self.texture, [row + v, column + u], order=1, mode="nearest")
        deviation /= np.sqrt(2 * self.density_m2)
        amplitudes = random.standard_normal((len(cells), 2), dtype=np.float32).view(np.complex64)
        amplitudes = amplitudes[:, 0] * deviation.astype(np.float32)

        first = np.flatnonzero(np.diff(tile[cells], prepend=-1))
        centres = (
            np.maximum.reduceat(positions, first, axis=1)
            + np.minimum.reduceat(positions, first, axis=1)
        ) / 2
        ends = np.append(first, len(cells))
        from_centre = positions - np.repeat(centres, np.diff(ends), axis=1)
        radii = np.sqrt(np.maximum.reduceat(np.sum(from_centre**2, axis=0), first))
        return _Scatterers(positions, normals, amplitudes, ends, centres.T, radii)


class _Scatterers(NamedTuple):
    """A seabed's scatterers, tile after tile, and the spheres that hold the tiles."""

    positions_m: NDArray[np.float64]  # [3, points]
    normals: NDArray[np.float32]  # [3, points]
    amplitudes: NDArray[np.complex64]  # [points]
    first: NDArray[np.intp]  # [tiles + 1]: where each tile begins
    centres_m: NDArray[np.float64]  # [tiles, 3]
    radii_m: NDArray[np.float64]  # [tiles]


def _extent(name: str, value: ArrayLike) -> tuple[float, float]:
    first, last = validate.array(name, value, np.float64, (2,)).tolist()
    if not first < last:
        raise ValueError(f"{name} must be first < last in m, got ({first:g}, {last:g})")
    return first, last


def _distance(x: float, interval: tuple[float, float]) -> float:
    return max(interval[0] - x, x - interval[1], 0.0)


def wreck(
    x_m: tuple[float, float] = (-32.0, 32.0),
    y_m: tuple[float, float] = (36.0, 92.0),
    *,
    position_m: ArrayLike = (0.0, 60.0),
    heading_deg: float = 14.0,
    mast_m: float = 6.5,
    cell_m: float = 0.1,
    density_m2: float = 600.0,
    seed: int = 0,
    floor_db: float = -50.0,
) -> Seabed:
    """Return a fishing vessel of 25 m by 7 m that stands upright on sand (THESIS chapter 6).

    The seabed lies at z = 0 but for ripples of 2 cm. The hull is 2.4 m high, higher at the bow,
    with a bulwark, an open hold, a wheelhouse aft (4.4 m above the seabed) and a mast of 0.6 m
    thickness before it. A sonar 20 m above the seabed and 60 m beside sees shadows of 8 m
    behind the hull and of 29 m behind the mast.

    Parameters
    ----------
    x_m, y_m : (first, last)
        The patch of seabed, world coordinates.
    position_m : array_like, [2]
        Middle of the hull, world x and y.
    heading_deg : float
        Where the bow points to: from x towards y.
    mast_m : float
        Height of the mast's top above the seabed, at least 0.
    cell_m : float
        Step of the height field: the patch is divided into whole steps of about this size.
    density_m2, seed, floor_db
        As for `Seabed`; the seed also draws the sand.

    Raises
    ------
    TypeError, ValueError
        If a value has the wrong kind or is outside its limits, or the position is off the patch.
    """
    mast = validate.number("mast_m", mast_m, "m", least=0.0, most=_HIGHEST_MAST_M)
    sand = _Sand.draw(x_m, y_m, cell_m, seed)
    ahead, aside = sand.around(position_m, heading_deg)
    length, width = 25.0, 7.0

    # Half the breadth along the hull: a transom of 70 % that fills out, and a bow that runs out.
    aft = np.clip(-(ahead + length / 10) / (0.4 * length), 0, 1)
    fore = np.clip((ahead - length / 10) / (0.4 * length), 0, None)
    breadth = width / 2 * np.clip(1 - 0.3 * aft**2 - fore**2, 0, 1) * (np.abs(ahead) <= length / 2)
    inboard = breadth - np.abs(aside)
    deck = 2.0 + 0.8 * np.clip(ahead / (length / 2), -0.5, 1) ** 2
    hull = np.where(inboard > 0, deck, 0.0)
    hull = np.where((inboard > 0) & (inboard < 0.4), deck + 0.4, hull)
    hull[_box(ahead - 3.5, aside, 4.5, 2.6)] = 0.9
    hull[_box(ahead + 7.0, aside, 5.0, 3.8)] = 4.4
    hull = np.where(_box(ahead - 0.2, aside, 0.6, 0.6), np.maximum(hull, mast), hull)
    # Old steel, overgrown, returns several times what sand does.
    return sand.seabed(hull, 4.0, density_m2, floor_db)


def pipeline(
    x_m: tuple[float, float] = (-32.0, 32.0),
    y_m: tuple[float, float] = (36.0, 76.0),
    *,
    position_m: ArrayLike = (0.0, 56.0),
    heading_deg: float = 8.0,
    cell_m: float = 0.1,
    density_m2: float = 600.0,
    seed: int = 0,
    floor_db: float = -50.0,
) -> Seabed:
    """Return a pipeline of 0.9 m diameter, gently curved, a third sunk into sand.

    Parameters
    ----------
    position_m, heading_deg
        A place on the pipeline and its direction there, from x towards y; it bends with a radius
        of 400 m, so that a shadow of even width would be a mistake.
    x_m, y_m, cell_m, density_m2, seed, floor_db
        As for `wreck`.

    Raises
    ------
    TypeError, ValueError
        As `wreck` does.
    """
    sand = _Sand.draw(x_m, y_m, cell_m, seed)
    ahead, aside = sand.around(position_m, heading_deg)
    radius = 0.45
    chord = np.clip(radius**2 - (aside - ahead**2 / 800) ** 2, 0, None)
    pipe = np.where(chord > 0, np.sqrt(chord) + radius / 3, 0.0)
    return sand.seabed(pipe, 3.0, density_m2, floor_db)


def rocks(
    x_m: tuple[float, float] = (-32.0, 32.0),
    y_m: tuple[float, float] = (36.0, 76.0),
    *,
    position_m: ArrayLike = (0.0, 56.0),
    count: int = 60,
    cell_m: float = 0.1,
    density_m2: float = 600.0,
    seed: int = 0,
    floor_db: float = -50.0,
) -> Seabed:
    """Return boulders of 0.5 to 4 m across, scattered on sand.

    Parameters
    ----------
    position_m : array_like, [2]
        Middle of the field of boulders, which thins out over some 12 m around it.
    count : int
        Number of boulders, 1 to 100 000.
    x_m, y_m, cell_m, density_m2, seed, floor_db
        As for `wreck`; the seed also draws the boulders.

    Raises
    ------
    TypeError, ValueError
        As `wreck` does.
    """
    count = validate.count("count", count, most=_MOST_BOULDERS)
    sand = _Sand.draw(x_m, y_m, cell_m, seed)
    east, north = sand.around(position_m, 0.0)
    random = np.random.default_rng([seed, 1])
    top = np.zeros(sand.heights.shape)
    for place in 12 * random.standard_normal((count, 2)):
        half = np.clip(0.5 * np.exp(0.5 * random.standard_normal()), 0.25, 2.0)
        stretch, turn = random.uniform(1.0, 1.6), random.uniform(0, np.pi)
        # Only the columns and rows that the boulder covers.
        rows = np.flatnonzero(np.abs(north[:, 0] - place[1]) < half * stretch)
        columns = np.flatnonzero(np.abs(east[0] - place[0]) < half * stretch)
        some = np.ix_(rows, columns)
        across, up = east[some] - place[0], north[some] - place[1]
        long = (np.cos(turn) * across + np.sin(turn) * up) / stretch
        wide = np.cos(turn) * up - np.sin(turn) * across
        cap = np.sqrt(np.clip(half**2 - long**2 - wide**2, 0, None))
        top[some] = np.maximum(top[some], 1.2 * cap)
    return sand.seabed(top, 3.0, density_m2, floor_db)


# Of about 1 m2 each in a field of some 3000 m2: far more than lie side by side.
_MOST_BOULDERS = 100_000
_LARGEST_CELL_M, _HIGHEST_MAST_M = 1.0, 100.0  # what shows a wreck at all


class _Sand(NamedTuple):
    """Rippled sand on a lattice, for something to stand on."""

    x_m: tuple[float, float]
    y_m: tuple[float, float]
    heights: NDArray[np.float64]
    texture: NDArray[np.float64]
    seed: int

    @classmethod
    def draw(
        cls, x_m: tuple[float, float], y_m: tuple[float, float], cell_m: float, seed: int
    ) -> _Sand:
        x_m, y_m = _extent("x_m", x_m), _extent("y_m", y_m)
        cell = validate.number("cell_m", cell_m, "m", above=0.0, most=_LARGEST_CELL_M)
        seed = validate.count("seed", seed, least=0)
        sizes = [(extent[1] - extent[0]) / cell for extent in (y_m, x_m)]
        validate.memory("cell_m", 80 * sizes[0] * sizes[1])
        shape = tuple(max(2, round(size) + 1) for size in sizes)
        random = np.random.default_rng([seed, 0])
        x = np.linspace(0, x_m[1] - x_m[0], shape[1])
        y = np.linspace(0, y_m[1] - y_m[0], shape[0])[:, None]
        # Slopes stay far below the grazing angles of a sidescan: sand casts no shadow of its own.
        bends = _smooth_noise(random, shape, cell, 4.0)
        heights = 0.02 * np.sin(2 * np.pi * (0.35 * x + 0.75 * y) / 1.3 + 2.5 * bends)
        heights += 0.05 * _smooth_noise(random, shape, cell, 3.0)
        heights += 0.004 * _smooth_noise(random, shape, cell, 0.3)
        texture = np.exp(0.12 * _smooth_noise(random, shape, cell, 5.0))
        return cls(x_m, y_m, heights, texture, seed)

    def around(self, position_m: ArrayLike, heading_deg: float) -> tuple[NDArray, NDArray]:
        """Return the lattice's coordinates ahead of and to port of a place with a heading."""
        position = validate.array("position_m", position_m, np.float64, (2,))
        heading = math.radians(validate.number("heading_deg", heading_deg, "degrees"))
        for value, extent in zip(position, (self.x_m, self.y_m), strict=True):
            if not extent[0] <= value <= extent[1]:
                raise ValueError(
                    f"position_m must lie on the patch, x {self.x_m} m and y {self.y_m} m, "
                    f"got {tuple(position.tolist())} m"
                )
        rows, columns = self.heights.shape
        east = np.linspace(*self.x_m, columns) - position[0]
        north = np.linspace(*self.y_m, rows)[:, None] - position[1]
        cosine, sine = math.cos(heading), math.sin(heading)
        return cosine * east + sine * north, cosine * north - sine * east

    def seabed(
        self, top: NDArray[np.float64], texture: float, density_m2: float, floor_db: float
    ) -> Seabed:
        """Return the sand with something on it that reaches up to `top` (0: nothing there)."""
        above = top > np.maximum(self.heights, 0.0)
        return Seabed(
            self.x_m,
            self.y_m,
            np.where(above, top, self.heights),
            np.where(above, texture, self.texture),
            density_m2,
            self.seed,
            floor_db,
        )


def _box(ahead: NDArray, aside: NDArray, length: float, width: float) -> NDArray[np.bool_]:
    # Half a millimetre more, so that rounding does not decide on cells at the edge.
    return (np.abs(ahead) <= length / 2 + 5e-4) & (np.abs(aside) <= width / 2 + 5e-4)


def _smooth_noise(
    random: np.random.Generator, shape: tuple[int, ...], cell_m: float, scale_m: float
) -> NDArray[np.float64]:
    """Return Gaussian noise of unit power, correlated over about `scale_m`, periodic."""
    spectrum = fft.rfft2(random.standard_normal(shape))
    k = 2 * np.pi * np.hypot(fft.fftfreq(shape[0], cell_m)[:, None], fft.rfftfreq(shape[1], cell_m))
    noise = fft.irfft2(spectrum * np.exp(-((k * scale_m) ** 2) / 4), shape)
    return noise / max(noise.std(), np.finfo(float).tiny)
