"""Built-in seabeds: a wreck, a pipeline and a field of boulders on rippled sand."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft

from clsas.engine.data import validate
from clsas.engine.data.validate import ArgumentError
from clsas.simulation.scenes import FLOOR_DB, Seabed, checked_extent

_MOST_BOULDERS = 100_000  # boulders of about 1 m2 each, many times the default patch of 2560 m2
_LARGEST_CELL_M = 1.0  # coarser height fields do not show a wreck
_HIGHEST_MAST_M = 100.0


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
    floor_db: float = FLOOR_DB,
) -> Seabed:
    """Return a fishing vessel of 25 m by 7 m that stands upright on sand.

    It is modelled on the wreck in chapter 6 of Ødegaard (2004). The seabed lies at z = 0 and has
    ripples of 2 cm. The hull is 2.4 m high and rises towards the bow. It has a bulwark, an open
    hold, a wheelhouse aft (4.4 m above the seabed) and, in front of that, a mast 0.6 m thick. For a
    sonar 20 m above the seabed at a ground range of 60 m, the hull casts a shadow of 8 m and the
    mast one of 29 m.

    Parameters
    ----------
    x_m, y_m : (first, last)
        World coordinates of the patch of seabed, metres.
    position_m : array_like, [2]
        Middle of the hull, world x and y, metres.
    heading_deg : float
        Direction of the bow, degrees from x towards y.
    mast_m : float
        Height of the top of the mast above the seabed, metres, 0 to 100.
    cell_m : float
        Approximate step of the height field, metres, at most 1. The patch is divided into whole
        steps.
    density_m2, seed, floor_db
        As for `Seabed`. The sand also depends on the seed.

    Raises
    ------
    TypeError, ValueError
        If a value has the wrong type or is outside its limits, or the position is not on the patch.
    """
    mast = validate.number("mast_m", mast_m, "m", least=0.0, most=_HIGHEST_MAST_M)
    sand = _Sand.draw(x_m, y_m, cell_m, seed)
    ahead, aside = sand.around(position_m, heading_deg)
    length, width = 25.0, 7.0

    # Half the breadth of the hull. It is 70 % at the transom, full amidships and zero at the bow.
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
    # Overgrown steel has several times the backscatter of sand.
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
    floor_db: float = FLOOR_DB,
) -> Seabed:
    """Return a pipeline of 0.9 m diameter, a third of which is sunk into sand.

    The pipeline bends with a radius of 400 m, so the width of its shadow varies.

    Parameters
    ----------
    position_m, heading_deg
        Point on the pipeline, metres, and direction of the pipeline there, degrees from x towards
        y.
    x_m, y_m, cell_m, density_m2, seed, floor_db
        As for `wreck`.

    Raises
    ------
    TypeError, ValueError
        As for `wreck`.
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
    floor_db: float = FLOOR_DB,
) -> Seabed:
    """Return boulders of 0.5 to 4 m across, scattered on sand.

    Parameters
    ----------
    position_m : array_like, [2]
        Middle of the field of boulders, whose density falls off over about 12 m, metres.
    count : int
        Number of boulders, 1 to 100 000.
    x_m, y_m, cell_m, density_m2, seed, floor_db
        As for `wreck`. The boulders also depend on the seed.

    Raises
    ------
    TypeError, ValueError
        As for `wreck`.
    """
    count = validate.count("count", count, most=_MOST_BOULDERS)
    sand = _Sand.draw(x_m, y_m, cell_m, seed)
    east, north = sand.around(position_m, 0.0)
    random = np.random.default_rng([seed, 1])
    top = np.zeros(sand.heights.shape)
    for x, y in 12 * random.standard_normal((count, 2)):
        half = np.clip(0.5 * np.exp(0.5 * random.standard_normal()), 0.25, 2.0)
        stretch, turn = random.uniform(1.0, 1.6), random.uniform(0, np.pi)
        # Only the rows and columns that the boulder covers are computed.
        rows = np.flatnonzero(np.abs(north[:, 0] - y) < half * stretch)
        columns = np.flatnonzero(np.abs(east[0] - x) < half * stretch)
        some = np.ix_(rows, columns)
        across, up = east[some] - x, north[some] - y
        long = (np.cos(turn) * across + np.sin(turn) * up) / stretch
        wide = np.cos(turn) * up - np.sin(turn) * across
        cap = np.sqrt(np.clip(half**2 - long**2 - wide**2, 0, None))
        top[some] = np.maximum(top[some], 1.2 * cap)
    return sand.seabed(top, 3.0, density_m2, floor_db)


class _Sand(NamedTuple):
    """Rippled sand on a lattice, onto which objects are placed."""

    x_m: tuple[float, float]
    y_m: tuple[float, float]
    heights: NDArray[np.float64]
    texture: NDArray[np.float64]
    seed: int

    @classmethod
    def draw(
        cls, x_m: tuple[float, float], y_m: tuple[float, float], cell_m: float, seed: int
    ) -> _Sand:
        """Check the arguments and return random sand."""
        x_m, y_m = checked_extent("x_m", x_m), checked_extent("y_m", y_m)
        cell = validate.number("cell_m", cell_m, "m", above=0.0, most=_LARGEST_CELL_M)
        seed = validate.count("seed", seed, least=0)
        sizes = [(extent[1] - extent[0]) / cell for extent in (y_m, x_m)]
        validate.memory("cell_m", 80 * sizes[0] * sizes[1])
        shape = tuple(max(2, round(size) + 1) for size in sizes)
        random = np.random.default_rng([seed, 0])
        x = np.linspace(0, x_m[1] - x_m[0], shape[1])
        y = np.linspace(0, y_m[1] - y_m[0], shape[0])[:, None]
        # Slopes stay far below the grazing angles of a sidescan sonar, so ripples cast no shadow.
        bends = _smooth_noise(random, shape, cell, 4.0)
        heights = 0.02 * np.sin(2 * np.pi * (0.35 * x + 0.75 * y) / 1.3 + 2.5 * bends)
        heights += 0.05 * _smooth_noise(random, shape, cell, 3.0)
        heights += 0.004 * _smooth_noise(random, shape, cell, 0.3)
        texture = np.exp(0.12 * _smooth_noise(random, shape, cell, 5.0))
        return cls(x_m, y_m, heights, texture, seed)

    def around(self, position_m: ArrayLike, heading_deg: float) -> tuple[NDArray, NDArray]:
        """Return the coordinates of the lattice ahead and to port of a position with a heading."""
        position = validate.array("position_m", position_m, np.float64, (2,))
        heading = math.radians(validate.number("heading_deg", heading_deg, "degrees"))
        for value, extent in zip(position, (self.x_m, self.y_m), strict=True):
            if not extent[0] <= value <= extent[1]:
                allowed = f"lie on the patch, x {self.x_m} m and y {self.y_m} m"
                raise ArgumentError("position_m", allowed, f"{tuple(position.tolist())} m")
        rows, columns = self.heights.shape
        east = np.linspace(*self.x_m, columns) - position[0]
        north = np.linspace(*self.y_m, rows)[:, None] - position[1]
        cosine, sine = math.cos(heading), math.sin(heading)
        return cosine * east + sine * north, cosine * north - sine * east

    def seabed(
        self, top: NDArray[np.float64], texture: float, density_m2: float, floor_db: float
    ) -> Seabed:
        """Return the sand with objects up to the heights `top`, which are 0 where there is none."""
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
    # The box is half a millimetre larger, so that rounding does not decide about cells at the edge.
    return (np.abs(ahead) <= length / 2 + 5e-4) & (np.abs(aside) <= width / 2 + 5e-4)


def _smooth_noise(
    random: np.random.Generator, shape: tuple[int, ...], cell_m: float, scale_m: float
) -> NDArray[np.float64]:
    """Return periodic Gaussian noise of unit power, correlated over about `scale_m`."""
    spectrum = fft.rfft2(random.standard_normal(shape))
    k = 2 * np.pi * np.hypot(fft.fftfreq(shape[0], cell_m)[:, None], fft.rfftfreq(shape[1], cell_m))
    noise = fft.irfft2(spectrum * np.exp(-((k * scale_m) ** 2) / 4), shape)
    return noise / max(noise.std(), np.finfo(float).tiny)
