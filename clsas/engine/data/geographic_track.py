"""Tracks of latitudes and longitudes: the local frame, and the poses in it."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsas.engine.data import projections, validate
from clsas.engine.data.georeference import Georeference

_ALIGNED = 0.5  # mean length of unit vectors, above which headings have a common direction
# Largest drift angle of a platform that is believed, and the best agreement needed to suspect
# radians, degrees: plain choices, since crab angles rarely exceed 30 degrees.
_MOST_DRIFT_DEG, _AGREEMENT_DEG = 30.0, 15.0


def georeference_of(
    latitude_deg: NDArray[np.float64],
    longitude_deg: NDArray[np.float64],
    height_m: NDArray[np.float64],
    heading_deg: NDArray[np.float64],
) -> Georeference:
    """Return a local georeference at the middle of a track, whose x axis has its mean heading.

    If headings have no common direction, as on parallel lines there and back, the x axis has the
    first of them. The numbers are rounded, to 0.1 m and 0.01 degrees.
    """
    turns = (longitude_deg - longitude_deg[0] + 180) % 360 - 180  # also across 180 degrees
    longitude = (longitude_deg[0] + turns.mean() + 180) % 360 - 180
    direction = np.exp(1j * np.radians(heading_deg)).mean()
    heading = np.degrees(np.angle(direction)) if abs(direction) > _ALIGNED else heading_deg[0]
    return Georeference.local(
        round(float(latitude_deg.mean()), 6),
        round(float(longitude), 6),
        round(float(height_m.mean()), 1),
        heading_deg=round(float(heading), 2) % 360,
    )


def poses(
    latitude_deg: ArrayLike,
    longitude_deg: ArrayLike,
    height_m: ArrayLike,
    heading_deg: ArrayLike,
    georeference: Georeference | None,
) -> tuple[NDArray[np.float64], NDArray[np.float64], Georeference]:
    """Return positions [pings, 3] and yaw angles [pings] (rad) of a track, and its georeference.

    Parameters and errors are those of `Track.from_geographic`.
    """
    validate.instance("georeference", georeference, Georeference, type(None))
    latitude, longitude = projections.checked(latitude_deg, longitude_deg, (None,))
    if len(longitude) != len(latitude):
        raise ValueError(
            f"longitude_deg must have shape ({len(latitude)}) like latitude_deg, "
            f"got {longitude.shape}"
        )
    height = validate.array("height_m", height_m, np.float64, latitude.shape, broadcast=True)
    heading = validate.array("heading_deg", heading_deg, np.float64, latitude.shape, broadcast=True)
    if np.abs(heading).max() > 360:
        raise ValueError(
            "heading_deg must be from -360 to 360 degrees, got "
            f"{heading[np.abs(heading).argmax()]:g}"
        )
    _check_headings(latitude, longitude, heading)
    frame = georeference or georeference_of(latitude, longitude, height, heading)
    positions_m = frame.from_geographic(latitude, longitude, height)
    on_map = heading - frame.convergence_deg(latitude, longitude)
    lost = np.flatnonzero(~np.isfinite(positions_m.sum(axis=1) + on_map))
    if lost.size:
        raise ValueError(
            f"latitude_deg and longitude_deg must lie on one map, but those of ping {lost[0]}, "
            f"{latitude[lost[0]]:g} and {longitude[lost[0]]:g}, are on another side of the Earth: "
            "probably a wrong fix"
        )
    of_x_axis = 90.0 if frame.heading_deg is None else frame.heading_deg
    yaw = np.radians((of_x_axis - on_map + 180) % 360 - 180)
    return positions_m, yaw, frame


def _check_headings(
    latitude: NDArray[np.float64], longitude: NDArray[np.float64], heading: NDArray[np.float64]
) -> None:
    """Raise ValueError if headings are probably in radians: then they agree with the course."""
    if len(heading) < 2 or np.abs(heading).max() > 2 * np.pi:
        return
    about = Georeference.local(latitude[0], longitude[0], heading_deg=90.0)
    east_m, north_m, _ = about.from_geographic(latitude, longitude, 0.0).T
    steps = np.diff(north_m) + 1j * np.diff(east_m)  # their angles are courses
    if not np.abs(steps).any():
        return
    in_degrees, in_radians = (
        abs(np.degrees(np.angle((steps * np.exp(-1j * (angles[1:] + angles[:-1]) / 2)).sum())))
        for angles in (np.radians(heading), heading)
    )
    if in_degrees > _MOST_DRIFT_DEG and in_radians < _AGREEMENT_DEG:
        raise ValueError(
            f"heading_deg must be in degrees, but the headings up to {np.abs(heading).max():.3g} "
            f"are {in_degrees:.0f} degrees off the course of the track, and {in_radians:.0f} "
            "degrees as radians: convert them with numpy.degrees"
        )
