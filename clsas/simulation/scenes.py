"""Scenes: point targets and seabeds, which a simulated sonar receives echoes from.

A scene returns the points that are visible to an observer (`visible`), and spheres that hold them
(`spheres`). Point targets are always visible. The scatterers of a seabed are visible where they are
lit and within the beam.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsas.core import reprs, validate
from clsas.simulation.height_field import HeightField
from clsas.simulation.scatterers import Scatterers, draw_scatterers


class Observer(NamedTuple):
    """Position of some channels, and how their elements direct sound.

    Attributes
    ----------
    position_m : ndarray, [3]
        Middle between transmitter and receivers.
    radius_m : float
        Largest distance of an element from this position.
    gain : callable or None
        gain(directions [points, 3], slack [points]) is an upper bound of the two-way amplitude
        pattern in all directions whose components differ from the given ones by up to `slack`.
        None: every element is omnidirectional.
    """

    position_m: NDArray[np.float64]
    radius_m: float = 0.0
    gain: Callable[[NDArray, NDArray | float], NDArray] | None = None


@dataclass(frozen=True, eq=False)
class PointTargets:
    """Point reflectors without multiple scattering (Born approximation).

    Equation [8] of the thesis (Ødegaard 2004).

    Parameters
    ----------
    positions_m : array_like, [points, 3]
        World positions.
    amplitudes : array_like, [points] or scalar
        Real or complex amplitudes; 1 by default.

    Raises
    ------
    TypeError, ValueError
        If an array has the wrong type or shape, is empty or not finite, or a position is beyond
        1e9 m.
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
        """Relative error that an echo may have: 0, so only rounding."""
        return 0.0

    def spheres(self, observer: Observer) -> tuple[NDArray, NDArray]:
        """Return the points as spheres, centres [points, 3] and radii [points] of zero."""
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


@dataclass(frozen=True, eq=False)
class Seabed:
    """Patch of seabed: a height field covered with scatterers, which casts shadows on itself.

    Heights are linear between the points of a regular lattice. Scatterers lie at random on the
    surface, `density_m2` per m2, with circular complex Gaussian amplitudes. With several per
    resolution cell the image is fully developed speckle. Averaged over the seeds, every m2 of the
    surface returns the intensity (sum of squared amplitudes) of Lambert's law,

        texture^2 cos^2(angle of incidence).

    Slopes that face away from the sonar return nothing, nor do points in a shadow.

    Parameters
    ----------
    x_m, y_m : (first, last)
        World coordinates of the lattice's first and last columns and rows, ascending.
    heights_m : array_like, [rows, columns]
        Height (world z) of row y and column x; at least 2 x 2.
    texture : array_like, [rows, columns], or scalar
        Backscattered amplitude of 1 m2 at perpendicular incidence, at least 0; linear in between.
    density_m2 : float
        Scatterers per m2 of surface. 600 are 3 per resolution cell of 5 cm by 10 cm.
    seed : int
        Seed of positions and amplitudes, at least 0.
    floor_db : float
        -200 to -10 dB. Scatterers are left out, in tiles of about 2 m, where an upper bound of the
        two-way element pattern is below this floor. Their echoes are below the floor, relative to
        the same scatterer on the beam's axis. All other echoes have an error of at most a third
        of the floor.

    Raises
    ------
    TypeError, ValueError
        If a value has the wrong type or shape, is not finite or is outside its limits; or if there
        are more scatterers than fit into memory.

    Notes
    -----
    For equal transmitter and receiver, long against the wavelength, the pattern sinc^2(u) is below
    the floor F from u = 1/(pi sqrt(F)) on. A homogeneous seabed loses about 0.0038/u^3 of its
    energy there: -47 dB for the default floor of -50 dB, where u = 5.7.

    Shadows follow from the running maximum of the elevation along the rays of a polar fan around
    the sonar. A scatterer at ground range g is lit if its elevation (z - z_sonar)/g is not below
    the maximum on the nearest ray, up to one or two lattice steps before it. Rays lie at most one
    step apart. The sides of a shadow are therefore right to half a step. Its far end is right to
    the shadow's change when the object that casts it is two steps shorter. Objects thinner than
    two steps cast no reliable shadow.
    """

    x_m: tuple[float, float]
    y_m: tuple[float, float]
    heights_m: NDArray[np.float64]
    texture: NDArray[np.float64] = 1.0  # type: ignore[assignment]
    density_m2: float = 600.0
    seed: int = 0
    floor_db: float = -50.0

    if TYPE_CHECKING:  # the constructor converts array_like arguments

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
            object.__setattr__(self, name, checked_extent(name, getattr(self, name)))
        heights = validate.array("heights_m", self.heights_m, np.float64, (None, None))
        if min(heights.shape) < 2:
            raise ValueError(
                f"heights_m must have at least 2 rows and 2 columns, got {heights.shape}"
            )
        texture = validate.array("texture", self.texture, np.float64, None)
        texture = np.broadcast_to(texture, heights.shape) if texture.ndim == 0 else texture
        texture = validate.array("texture", texture, np.float64, heights.shape)
        if texture.min() < 0:
            raise ValueError(f"texture must be at least 0, got {texture.min():g}")
        fields = {
            "heights_m": heights,
            "texture": texture,
            "density_m2": validate.positive("density_m2", self.density_m2, "per m2"),
            "seed": validate.count("seed", self.seed, least=0),
            "floor_db": validate.number("floor_db", self.floor_db, "dB", least=-200.0, most=-10.0),
        }
        for name, value in fields.items():
            object.__setattr__(self, name, value)
        with np.errstate(over="ignore", invalid="ignore"):
            area_m2 = self._surface.cell_areas_m2.sum()
        validate.memory("density_m2", 100 * self.density_m2 * area_m2)

    def __repr__(self) -> str:
        """Return extents, the lattice's step and the density of scatterers."""
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
        """Distance between the lattice's columns, and between its rows."""
        return self._surface.steps_m

    @property
    def points(self) -> int:
        """Number of scatterers."""
        return len(self._scatterers.amplitudes)

    @property
    def error(self) -> float:
        """Relative error that an echo may have: a third of the floor."""
        return 10 ** (self.floor_db / 20) / 3

    def height_m(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.float64]:
        """Return the heights at positions on the patch, which broadcast; NaN beside the patch.

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
            raise ValueError(
                f"x_m and y_m must broadcast, got shapes {x_m.shape} and {y_m.shape}"
            ) from None
        return self._surface.height_m(x_m, y_m)

    def lit(self, points_m: ArrayLike, eye_m: ArrayLike) -> NDArray[np.bool_]:
        """Return which points are not in shadow for a position, bool [points]; see the Notes.

        Parameters
        ----------
        points_m : array_like, [points, 3]
            Points on the seabed or above it.
        eye_m : array_like, [3]
            Position of the sonar.

        Raises
        ------
        TypeError, ValueError
            If an array has the wrong type or shape, is empty or not finite.
        """
        points = validate.array("points_m", points_m, np.float64, (None, 3))
        eye = validate.array("eye_m", eye_m, np.float64, (3,))
        return self._surface.lit(np.ascontiguousarray((points - eye).T), eye)

    def spheres(self, observer: Observer) -> tuple[NDArray, NDArray]:
        """Return spheres that hold all visible points, centres [spheres, 3] and radii [spheres]."""
        validate.instance("observer", observer, Observer)
        kept = self._in_beam(observer)
        # A receive window is needed even if no echo arrives.
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
        rays = offsets.astype(np.float32)
        # Lambert's law: the amplitude falls with the cosine of the angle of incidence.
        facing = -np.einsum("ip,ip->p", scatterers.normals[:, chosen], rays)
        facing /= np.sqrt(np.einsum("ip,ip->p", rays, rays))
        lit = np.flatnonzero((facing > 0) & self._surface.lit(offsets, observer.position_m))
        return positions[:, lit].T, scatterers.amplitudes[chosen[lit]] * facing[lit]

    def _in_beam(self, observer: Observer) -> NDArray[np.intp]:
        """Tiles in which the pattern may exceed the floor, those near the beam's axis first."""
        scatterers = self._scatterers
        if observer.gain is None:
            return np.arange(len(scatterers.radii_m))
        offsets = scatterers.centres_m - observer.position_m
        distance = np.maximum(np.linalg.norm(offsets, axis=1), np.finfo(float).tiny)
        near = scatterers.radii_m + observer.radius_m
        # Upper bound of how much the directions from any element to any point of a tile differ.
        slack = np.where(distance > near, near / np.maximum(distance - near, 1e-9 * near), np.inf)
        gains = observer.gain(offsets / distance[:, None], slack)
        order = np.argsort(-observer.gain(offsets / distance[:, None], 0.0), kind="stable")
        return order[gains[order] >= 10 ** (self.floor_db / 20)]

    @cached_property
    def _surface(self) -> HeightField:
        return HeightField(self.x_m, self.y_m, self.heights_m)

    @cached_property
    def _scatterers(self) -> Scatterers:
        """The scatterers, drawn when first asked for."""
        return draw_scatterers(self._surface, self.texture, self.density_m2, self.seed)


Scene = PointTargets | Seabed | tuple[PointTargets | Seabed, ...]


def checked_extent(name: str, value: ArrayLike) -> tuple[float, float]:
    """Return `value` as (first, last) in metres; raises ValueError unless they ascend."""
    first, last = validate.array(name, value, np.float64, (2,)).tolist()
    if not first < last:
        raise ValueError(f"{name} must be first < last in m, got ({first:g}, {last:g})")
    return first, last
