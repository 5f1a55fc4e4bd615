"""Scenes: point targets and seabeds, from which a simulated sonar receives echoes.

A scene returns the points that are visible to an observer (`visible`), and spheres that contain
them (`spheres`). Point targets are always visible. Scatterers of a seabed are visible if they are
lit and within the beam.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import map_coordinates

from clsas.engine.data import reprs, validate
from clsas.engine.data.decibels import amplitude
from clsas.engine.data.declared import Count, Number, check_fields
from clsas.engine.data.validate import ArgumentError
from clsas.simulation.refraction import Sightlines

FLOOR_DB = -50.0
"""Two-way element pattern below which scatterers of seabeds are left out by default, dB."""
_TILE_M = 2.0  # side of the tiles that are kept or left out as a whole, depending on the beam
_CLEAR = -1e30  # height beyond the lattice, where nothing casts shadows


class Observer(NamedTuple):
    """Position of some channels, and the directivity of their elements.

    Attributes
    ----------
    position_m : ndarray, [3]
        Middle between transmitter and receivers.
    radius_m : float
        Largest distance of an element from this position.
    gain : callable or None
        gain(directions [points, 3], slack [points]) is an upper bound on the two-way amplitude
        pattern in all directions whose components differ from the given ones by up to `slack`.
        None if every element is omnidirectional.
    sightlines : Sightlines or None
        Rays in water whose sound speed varies with depth; None if they are straight.
    """

    position_m: NDArray[np.float64]
    radius_m: float = 0.0
    gain: Callable[[NDArray, NDArray | float], NDArray] | None = None
    sightlines: Sightlines | None = None


@dataclass(frozen=True, eq=False)
class PointTargets:
    """Point reflectors without multiple scattering (Born approximation).

    They follow equation [8] of Ødegaard (2004).

    Parameters
    ----------
    positions_m : array_like, [points, 3]
        World positions, metres.
    amplitudes : array_like, [points] or scalar
        Real or complex amplitudes; 1 by default.

    Raises
    ------
    TypeError, ValueError
        If an array has the wrong type or shape, is empty or not finite, or a coordinate exceeds
        1e9 m.

    See Also
    --------
    Seabed : A seabed with shadows.
    simulate, simulate_lines : Echoes and range lines of scenes.

    Examples
    --------
    >>> import clsas
    >>> clsas.PointTargets([[0, 40, 0], [1, 42, 0]], amplitudes=[1, 0.5j])
    PointTargets(2 points, x 0 to 1 m, y 40 to 42 m, z 0 m)
    """

    positions_m: NDArray[np.float64]
    amplitudes: NDArray[np.complex128] = 1.0  # type: ignore[assignment]

    if TYPE_CHECKING:  # the constructor converts array_like arguments

        def __init__(
            self,
            positions_m: ArrayLike,
            amplitudes: ArrayLike = 1.0,
        ) -> None: ...

    def __post_init__(self) -> None:
        """Check every field and convert it."""
        positions = validate.array("positions_m", self.positions_m, np.float64, (None, 3))
        farthest_m = float(np.abs(positions).max())
        validate.number("the farthest of positions_m", farthest_m, "m", most=validate.FARTHEST_M)
        amplitudes = validate.real_or_complex(
            "amplitudes", self.amplitudes, np.complex128, (len(positions),), broadcast=True
        )
        object.__setattr__(self, "positions_m", positions)
        object.__setattr__(self, "amplitudes", amplitudes.astype(np.complex128, copy=False))

    def __repr__(self) -> str:
        """Return the number of points and their extents."""
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
        """Relative error that an echo may have: 0, apart from rounding."""
        return 0.0

    def spheres(self, observer: Observer) -> tuple[NDArray, NDArray]:
        """Return the points as spheres: centres [points, 3], and radii [points] of zero."""
        validate.instance("observer", observer, Observer)
        return self.positions_m, np.zeros(self.points)

    def visible(self, observer: Observer) -> tuple[NDArray, NDArray]:
        """Return all positions and amplitudes, those near the beam's axis first."""
        validate.instance("observer", observer, Observer)
        if observer.gain is None:
            return self.positions_m, self.amplitudes
        offsets = self.positions_m - observer.position_m
        distance = np.maximum(np.linalg.norm(offsets, axis=1), np.finfo(float).tiny)
        order = np.argsort(-observer.gain(offsets / distance[:, None], 0.0), kind="stable")
        return self.positions_m[order], self.amplitudes[order]


class _Scatterers(NamedTuple):
    """Scatterers of a seabed sorted by tile, and the spheres that contain the tiles."""

    positions_m: NDArray[np.float64]  # [3, points]
    normals: NDArray[np.float32]  # [3, points], of the surface
    amplitudes: NDArray[np.complex64]  # [points]
    first: NDArray[np.intp]  # [tiles + 1]: where each tile begins
    centres_m: NDArray[np.float64]  # [tiles, 3]
    radii_m: NDArray[np.float64]  # [tiles]


@dataclass(frozen=True, eq=False)
class Seabed:
    """Patch of seabed: a height field covered with scatterers, which casts shadows on itself.

    Heights are linear between the points of a regular lattice. Scatterers lie at random positions
    on the surface, `density_m2` per m2, with circular complex Gaussian amplitudes. With several
    scatterers per resolution cell, the image is fully developed speckle. Averaged over seeds, every
    m2 of the surface returns the intensity (sum of squared amplitudes) of Lambert's law,

        texture^2 cos^2(angle of incidence).

    Slopes that face away from the sonar, and points in shadow, return nothing.

    Parameters
    ----------
    x_m, y_m : (first, last)
        World coordinates of the first and last column and row of the lattice, metres, ascending.
    heights_m : array_like, [rows, columns]
        Heights (world z) for rows along y and columns along x, metres; at least 2 x 2.
    texture : array_like, [rows, columns], or scalar
        Backscattered amplitude of 1 m2 at perpendicular incidence, at least 0. It is linear between
        the points of the lattice.
    density_m2 : float
        Scatterers per m2 of surface. 600 per m2 are 3 per resolution cell of 5 cm by 10 cm.
    seed : int
        Seed of positions and amplitudes, at least 0.
    floor_db : float
        Floor of the two-way element pattern, -200 to -10 dB. Scatterers are left out, in tiles of
        about 2 m, where an upper bound on the pattern is below the floor. Their echoes would be
        below the floor relative to the same scatterer on the beam's axis. All other echoes have an
        error of at most a third of the floor.

    Raises
    ------
    TypeError, ValueError
        If a value has the wrong type or shape, is not finite or is outside its limits, or if the
        scatterers do not fit into memory.

    See Also
    --------
    PointTargets : Single points.
    simulate, simulate_lines : Echoes and range lines of scenes.

    Notes
    -----
    For a transmitter and a receiver of equal length, which is long compared with the wavelength,
    the pattern sinc^2(u) is below the floor F for all u > 1/(pi sqrt(F)). A homogeneous seabed
    loses about 0.0038/u^3 of its energy there. This is -47 dB for the default floor of -50 dB,
    where u = 5.7.

    Shadows follow from the running maximum of the elevation along the rays of a polar fan around
    the sonar. A scatterer at ground range g is lit if its elevation (z - z_sonar)/g is not below
    the maximum on the nearest ray, up to one or two lattice steps before the scatterer. Rays lie at
    most one step apart, so the sides of a shadow are accurate to half a step. The error of its far
    end is the change that the shadow would have if the object were two steps shorter. Objects
    thinner than two steps do not cast reliable shadows. If the sound speed varies with depth, the
    elevations are those at which rays leave the sonar, and the angle of incidence is that at which
    they arrive.

    Examples
    --------
    A flat seabed with a wall 1 m high:

    >>> import clsas
    >>> import numpy as np
    >>> heights_m = np.zeros((41, 21))
    >>> heights_m[10:13] = 1.0
    >>> seabed = clsas.Seabed((0, 2), (40, 44), heights_m)
    >>> seabed.steps_m
    (0.1, 0.1)
    >>> seabed.lit([[1, 40.5, 0], [1, 42, 0]], eye_m=[1, 0, 10])
    array([ True, False])
    """

    x_m: tuple[float, float]
    y_m: tuple[float, float]
    heights_m: NDArray[np.float64]
    texture: NDArray[np.float64] = 1.0  # type: ignore[assignment]
    density_m2: Annotated[
        float, Number("per m2", above=0.0, help="Scatterers per square metre of the surface.")
    ] = 600.0
    seed: Annotated[int, Count(0, help="Seed of sand, scatterers and boulders.")] = 0
    floor_db: Annotated[
        float,
        Number(
            "dB",
            least=-200.0,
            most=-10.0,
            help="Scatterers whose two-way element pattern is below this level are left out.",
        ),
    ] = FLOOR_DB

    def __post_init__(self) -> None:
        """Check every field and convert it."""
        check_fields(self)
        for name in ("x_m", "y_m"):
            object.__setattr__(self, name, checked_extent(name, getattr(self, name)))
        heights = validate.array("heights_m", self.heights_m, np.float64, (None, None))
        if min(heights.shape) < 2:
            allowed = "have at least 2 rows and 2 columns"
            raise ArgumentError("heights_m", allowed, str(heights.shape))
        texture = validate.array("texture", self.texture, np.float64, None)
        texture = np.broadcast_to(texture, heights.shape) if texture.ndim == 0 else texture
        texture = validate.array("texture", texture, np.float64, heights.shape)
        if texture.min() < 0:
            raise ArgumentError("texture", "be at least 0", f"{texture.min():g}")
        object.__setattr__(self, "heights_m", heights)
        object.__setattr__(self, "texture", texture)
        with np.errstate(over="ignore", invalid="ignore"):
            area_m2 = self._cell_areas_m2().sum()
        validate.memory("density_m2", 100 * self.density_m2 * area_m2)

    def __repr__(self) -> str:
        """Return the extents, the step of the lattice and the density of scatterers."""
        heights_m = self.heights_m.min(), self.heights_m.max()
        low_m, high_m = zip(self.x_m, self.y_m, heights_m, strict=True)
        steps = " x ".join(reprs.quantity(step, "m") for step in self.steps_m)
        return reprs.summary(
            self,
            reprs.extents(low_m, high_m),
            f"steps of {steps}",
            f"{self.density_m2:g} scatterers per m2",
        )

    @property
    def steps_m(self) -> tuple[float, float]:
        """Distance between the columns and between the rows of the lattice, metres."""
        rows, columns = self.heights_m.shape
        return (self.x_m[1] - self.x_m[0]) / (columns - 1), (self.y_m[1] - self.y_m[0]) / (rows - 1)

    @property
    def points(self) -> int:
        """Number of scatterers."""
        return len(self._scatterers.amplitudes)

    @property
    def error(self) -> float:
        """Relative error that an echo may have: a third of the floor."""
        return amplitude(self.floor_db) / 3

    def height_m(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.float64]:
        """Return the heights of the seabed at some positions, metres.

        Parameters
        ----------
        x_m, y_m : array_like
            World coordinates, metres, which broadcast.

        Returns
        -------
        float64 array
            Heights, NaN outside the patch.

        Raises
        ------
        TypeError, ValueError
            If the positions are not finite real numbers, or do not broadcast.
        """
        x_m = validate.array("x_m", x_m, np.float64, None)
        y_m = validate.array("y_m", y_m, np.float64, None)
        try:
            np.broadcast_shapes(x_m.shape, y_m.shape)
        except ValueError:
            shapes = f"shapes {x_m.shape} and {y_m.shape}"
            raise ArgumentError("x_m", "broadcast with `y_m`", shapes) from None
        x, y = np.broadcast_arrays(x_m, y_m)
        dx, dy = self.steps_m
        where = [((y - self.y_m[0]) / dy).ravel(), ((x - self.x_m[0]) / dx).ravel()]
        heights = map_coordinates(self.heights_m, where, order=1, mode="constant", cval=np.nan)
        return heights.reshape(x.shape)

    def lit(self, points_m: ArrayLike, eye_m: ArrayLike) -> NDArray[np.bool_]:
        """Return a mask of the points that are not in shadow from a position, bool [points].

        The Notes of `Seabed` describe how shadows are determined.

        Parameters
        ----------
        points_m : array_like, [points, 3]
            Points on the seabed or above it, metres.
        eye_m : array_like, [3]
            Position of the sonar, metres.

        Raises
        ------
        TypeError, ValueError
            If an array has the wrong type or shape, is empty or not finite.
        """
        points = validate.array("points_m", points_m, np.float64, (None, 3))
        eye = validate.array("eye_m", eye_m, np.float64, (3,))
        return self._lit(np.ascontiguousarray((points - eye).T), eye)

    def spheres(self, observer: Observer) -> tuple[NDArray, NDArray]:
        """Return spheres around all visible points: centres [spheres, 3], and radii [spheres]."""
        validate.instance("observer", observer, Observer)
        kept = self._in_beam(observer)
        # The receive window follows from the spheres, and is needed even if no echo arrives.
        kept = kept if len(kept) else np.arange(len(self._scatterers.radii_m))
        return self._scatterers.centres_m[kept], self._scatterers.radii_m[kept]

    def visible(self, observer: Observer) -> tuple[NDArray, NDArray]:
        """Return positions [points, 3] and amplitudes [points] of the visible scatterers.

        They are sorted by tile, with the tiles nearest to the beam's axis first.
        """
        validate.instance("observer", observer, Observer)
        scatterers = self._scatterers
        kept = self._in_beam(observer)
        first, counts = scatterers.first[kept], scatterers.first[kept + 1] - scatterers.first[kept]
        chosen = np.arange(counts.sum()) + np.repeat(first - np.cumsum(counts) + counts, counts)
        positions = scatterers.positions_m[:, chosen]
        offsets = positions - observer.position_m[:, None]
        if observer.sightlines is None:
            rays, leaving = offsets.astype(np.float32), None
        else:
            rays, leaving = observer.sightlines.arrivals(offsets)
        # Lambert's law: the amplitude falls with the cosine of the angle of incidence.
        facing = -np.einsum("ip,ip->p", scatterers.normals[:, chosen], rays)
        facing /= np.sqrt(np.einsum("ip,ip->p", rays, rays))
        in_sight = self._lit(offsets, observer.position_m, observer.sightlines, leaving)
        lit = np.flatnonzero((facing > 0) & in_sight)
        return positions[:, lit].T, scatterers.amplitudes[chosen[lit]] * facing[lit]

    def _in_beam(self, observer: Observer) -> NDArray[np.intp]:
        """Return the tiles in which the pattern may exceed the floor, nearest to the axis first."""
        scatterers = self._scatterers
        if observer.gain is None:
            return np.arange(len(scatterers.radii_m))
        offsets = scatterers.centres_m - observer.position_m
        distance = np.maximum(np.linalg.norm(offsets, axis=1), np.finfo(float).tiny)
        near = scatterers.radii_m + observer.radius_m
        # Upper bound on the difference of directions from any element to any point of a tile.
        slack = np.where(distance > near, near / np.maximum(distance - near, 1e-9 * near), np.inf)
        directions = offsets / distance[:, None]
        if observer.sightlines is not None:
            directions, magnification = observer.sightlines.departures(offsets)
            slack *= magnification
        gains = observer.gain(directions, slack)
        order = np.argsort(-observer.gain(directions, 0.0), kind="stable")
        return order[gains[order] >= amplitude(self.floor_db)]

    def _lit(
        self,
        offsets_m: NDArray[np.float64],
        eye_m: NDArray[np.float64],
        sightlines: Sightlines | None = None,
        leaving: NDArray[np.float64] | None = None,
    ) -> NDArray[np.bool_]:
        """Return a mask of points with a clear line of sight to a position, bool [points].

        A polar fan of rays surrounds the position. A point is lit if its elevation is not below the
        largest elevation on the nearest ray, up to one or two lattice steps before the point.

        Parameters
        ----------
        offsets_m : float64 [3, points]
            Points relative to the position.
        eye_m : float64 [3]
            The position.
        sightlines : Sightlines, optional
            Bent rays to the position; by default rays are straight.
        leaving : float64 [points], optional
            Elevations of the bent rays to the points, NaN without a ray. Such points count as lit,
            and cast no shadows.
        """
        x, y, z = offsets_m
        level_m = float(self.heights_m.min())
        lowest = eye_m[2] + min(z.min(initial=0.0), 0.0)
        if not x.size or (lowest >= level_m and not self._relative_heights.any()):
            return np.ones(x.size, bool)
        step = min(self.steps_m)
        # Azimuth is measured from the direction to the middle of the lattice. Then no ray to a
        # lattice on one side of the sonar is at +-180 degrees.
        centre = np.arctan2(sum(self.y_m) / 2 - eye_m[1], sum(self.x_m) / 2 - eye_m[0])
        cosine, sine = np.cos(centre), np.sin(centre)
        ground = np.sqrt(x**2 + y**2)
        azimuth = np.arctan2(cosine * y - sine * x, cosine * x + sine * y)
        # The rays must not depend on the points. Otherwise whether a point is lit would depend on
        # the other points.
        away = np.abs([np.subtract(self.x_m, eye_m[0]), np.subtract(self.y_m, eye_m[1])])
        ray_step = step / max(np.hypot(*away.max(axis=1)), step)
        first_ray = np.floor(azimuth.min() / ray_step)
        ray = np.rint(azimuth / ray_step - first_ray).astype(np.intp)
        angles = centre + ray_step * (first_ray + np.arange(ray.max() + 1))
        nearest = max(
            self.x_m[0] - eye_m[0], eye_m[0] - self.x_m[1],
            self.y_m[0] - eye_m[1], eye_m[1] - self.y_m[1], step,
        )  # fmt: skip
        # Nothing beyond the lattice casts shadows.
        last = np.ceil((np.hypot(*away.max(axis=1)) - nearest) / step) + 2
        before = np.floor(np.minimum((ground - nearest) / step, last)).astype(np.intp) - 1
        ranges = nearest + step * np.arange(max(before.max(), 0) + 1)

        validate.memory("heights_m", 40 * len(angles) * len(ranges))
        dx, dy = self.steps_m
        columns = (np.cos(angles)[:, None] * ranges + (eye_m[0] - self.x_m[0])) / dx
        rows = (np.sin(angles)[:, None] * ranges + (eye_m[1] - self.y_m[0])) / dy
        fan = map_coordinates(
            self._relative_heights,
            [rows, columns],
            np.float32,
            order=1,
            mode="constant",
            cval=_CLEAR,
        )
        fan -= np.float32(eye_m[2] - level_m)
        if sightlines is None or leaving is None:
            fan /= ranges.astype(np.float32)
            elevation = z / np.maximum(ground, np.finfo(float).tiny)
        else:  # a bent ray passes above whatever has a smaller elevation
            covered = fan > _CLEAR / 2
            along, heights = np.broadcast_to(ranges, fan.shape)[covered], fan[covered]
            fan = np.full(fan.shape, np.float32(_CLEAR))
            fan[covered] = np.nan_to_num(
                sightlines.elevations(along, heights.astype(float)), nan=_CLEAR
            )
            elevation = np.nan_to_num(leaving, nan=np.inf)
        highest = np.maximum.accumulate(fan, axis=1)
        return (before < 0) | (elevation >= highest[ray, np.maximum(before, 0)])

    @cached_property
    def _relative_heights(self) -> NDArray[np.float32]:
        """Heights above the lowest one, so that single precision resolves them."""
        return (self.heights_m - self.heights_m.min()).astype(np.float32)

    @cached_property
    def _scatterers(self) -> _Scatterers:
        """The scatterers, which are drawn at first use."""
        random = np.random.default_rng(self.seed)
        counts = random.poisson(self.density_m2 * self._cell_areas_m2())
        dx, dy = self.steps_m
        rows, columns = np.indices(counts.shape)
        tiles = rows // max(1, round(_TILE_M / dy)), columns // max(1, round(_TILE_M / dx))
        tile = (tiles[0] * (tiles[1].max() + 1) + tiles[1]).ravel()
        order = np.argsort(tile, kind="stable")
        cells = np.repeat(order, counts.ravel()[order])
        if not cells.size:
            allowed = "put at least one scatterer on the seabed"
            raise ArgumentError("density_m2", allowed, f"{self.density_m2:g} per m2")
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

    def _cell_areas_m2(self) -> NDArray[np.float64]:
        """Return the surface area of cells between four lattice points, [rows - 1, columns - 1]."""
        dx, dy = self.steps_m
        h = self.heights_m
        along_x = (h[:-1, 1:] - h[:-1, :-1] + h[1:, 1:] - h[1:, :-1]) / (2 * dx)
        along_y = (h[1:, :-1] - h[:-1, :-1] + h[1:, 1:] - h[:-1, 1:]) / (2 * dy)
        return dx * dy * np.sqrt(1 + along_x**2 + along_y**2)


Scene = PointTargets | Seabed | tuple[PointTargets | Seabed, ...]


def checked_extent(name: str, value: ArrayLike) -> tuple[float, float]:
    """Return `value` as (first, last) in metres; raises ValueError unless they ascend."""
    first, last = validate.array(name, value, np.float64, (2,)).tolist()
    if not first < last:
        raise ArgumentError(name, "be first < last in m", (first, last))
    return first, last
