"""The raster of an image as SICD describes it: a plane in earth-centred, earth-fixed coordinates.

Sensor Independent Complex Data (NGA.STND.0024-1) calls these coordinates ECF.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import polynomial
from numpy.typing import NDArray

from clsas.engine.data.georeference import Georeference
from clsas.engine.data.grid import Grid
from clsas.engine.data.validate import ArgumentError
from clsas.maps.georeferencing import geographic
from clsas.maps.orientation import Orientation

_OVERHEAD = 1e-3  # radians from the vertical within which there is no direction of range
_LEVEL = 1e-9  # slope of a horizontal plane, above rounding


@dataclass(frozen=True, eq=False)
class Raster:
    """Rows and columns of an image in the order of SICD: rows lead away from the radar.

    Attributes
    ----------
    orientation : Orientation
        How the pixels of the image are turned.
    first_m : float64 [3]
        Position of the raster's pixel [0, 0], in the image's coordinates.
    steps_m : float64 [2, 3]
        Steps from row to row and from column to column.
    georeference : Georeference
    """

    orientation: Orientation
    first_m: NDArray[np.float64]
    steps_m: NDArray[np.float64]
    georeference: Georeference

    @classmethod
    def of(cls, grid: Grid, radar_m: NDArray[np.float64]) -> Raster:
        """Return the raster of a plane that is seen from a position.

        Raises
        ------
        ValueError
            If the grid is vertical, or lies straight below the radar.
        """
        place = grid.georeference
        assert place is not None  # the caller has checked it
        a, b, c, d, e, f = place.affine(grid)
        towards_m = place.to_map(radar_m) - place.to_map(np.mean(grid.bounds_m, axis=0))
        east_m, north_m, _ = towards_m
        distance_m = float(np.hypot(east_m, north_m))
        if distance_m <= _OVERHEAD * np.linalg.norm(towards_m):
            raise ArgumentError("lines", "look at the grid from the side, not from straight above")
        # With the radar in the north, rows of a north-up map lead away from it.
        sine, cosine = east_m / distance_m, north_m / distance_m
        turned = (
            *(cosine * east - sine * north for east, north in ((a, d), (b, e), (c, f))),
            *(sine * east + cosine * north for east, north in ((a, d), (b, e), (c, f))),
        )
        orientation = Orientation.of((grid.shape[0], grid.shape[1]), turned)
        return cls(orientation, *orientation.vectors_m(grid), place)

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rows and columns."""
        return self.orientation.shape

    @property
    def centre(self) -> NDArray[np.int64]:
        """Row and column of the scene centre point, int64 [2]."""
        return np.array(self.shape) // 2

    @property
    def is_level(self) -> bool:
        """True if the plane is horizontal."""
        *across, up = np.cross(*self.steps_m)
        return bool(np.hypot(*across) <= _LEVEL * abs(up))

    @property
    def corners(self) -> NDArray[np.int64]:
        """Rows and columns of the corners, clockwise from pixel [0, 0], int64 [4, 2]."""
        last_row, last_column = (n - 1 for n in self.shape)
        return np.array([[0, 0], [0, last_column], [last_row, last_column], [last_row, 0]])

    def positions_m(self, index: NDArray) -> NDArray[np.float64]:
        """Return the positions of rows and columns [..., 2], which may be fractions, [..., 3]."""
        return self.first_m + index @ self.steps_m

    def corners_on_ground(self, track: NDArray[np.float64], time_s: float) -> NDArray[np.float64]:
        """Return latitude and longitude of the corners at the height of the middle, deg [4, 2].

        A corner above or below it is moved along the normal of the slant plane, on which range and
        Doppler stay the same to first order.
        """
        import sarkit.wgs84

        place, centre_m = self.georeference, self.positions_m(self.centre)
        places = geographic(place, self.positions_m(self.corners))
        middle, middle_m = geographic(place, centre_m), ecf_m(place, centre_m)
        radar_m = polynomial.polyval(time_s, track)
        velocity_m_s = polynomial.polyval(time_s, polynomial.polyder(track))
        normal = np.cross(velocity_m_s, middle_m - radar_m)
        normal /= normal @ sarkit.wgs84.up(middle)
        raised_m = (places[:, 2] - middle[2])[:, None]
        ground_m = sarkit.wgs84.geodetic_to_cartesian(places) - raised_m * normal
        return sarkit.wgs84.cartesian_to_geodetic(ground_m)[:, :2]

    def vectors_m(self) -> NDArray[np.float64]:
        """Return the steps from row to row and from column to column in ECF, [2, 3].

        They are chords through the scene centre point, since the Earth is round.
        """
        row, column = self.centre
        last_row, last_column = (n - 1 for n in self.shape)
        ends = np.array([[[0, column], [last_row, column]], [[row, 0], [row, last_column]]])
        first_m, last_m = np.moveaxis(ecf_m(self.georeference, self.positions_m(ends)), 1, 0)
        return (last_m - first_m) / np.array([[last_row], [last_column]])


def ecf_m(place: Georeference, positions_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return earth-centred, earth-fixed coordinates of positions [..., 3], metres."""
    import sarkit.wgs84

    return sarkit.wgs84.geodetic_to_cartesian(geographic(place, positions_m))
