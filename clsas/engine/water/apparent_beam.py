"""Apparent beam: weights in homogeneous water that are those of the rays at the antennas.

The pattern of an antenna weighs the direction in which a ray leaves it. The horizontal slowness p
is the same all along a ray. At the antenna, where the speed is c, the ray's aspect angle has the
sine p c, and in homogeneous water of speed h it has about the sine p h, if the track is level.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.geometry import SAME_PLACE_M, unit_vectors
from clsas.engine.data.lines import RangeLines, wavelength_m
from clsas.engine.water.ray_delays import RaySample
from clsas.engine.water.rays import rays

_NEAR = 0.1  # part of the width whose channels stand for those at its end; a plain choice
_SINES = 129  # at which the weights of a beam are sampled; a plain choice


@dataclass(frozen=True, eq=False, repr=False)
class ApparentBeam(BeamWindow):
    """Beam that is given the sines of aspect angles in homogeneous water.

    Attributes
    ----------
    ratio : float
        Factor by which the sines at the antennas are larger.
    """

    ratio: float = 1.0

    @property
    def limits_rad(self) -> tuple[float, float]:
        """Aspect angles in homogeneous water at which the beam begins and ends, radians."""
        low, high = (math.sin(each) / self.ratio for each in super().limits_rad)
        return math.asin(min(max(low, -1.0), 1.0)), math.asin(min(max(high, -1.0), 1.0))

    def _from_axis(self, q: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return super()._from_axis(self.ratio * q)


def apparent_beam(
    beam: BeamWindow,
    lines: RangeLines,
    sample: RaySample,
    straight: RangeLines,
    points_m: NDArray[np.float64],
) -> tuple[ApparentBeam, float, float]:
    """Return the beam for homogeneous water, and the two relative error powers that it leaves.

    Parameters
    ----------
    beam : BeamWindow
        Beam whose weights apply to the directions of rays at the antennas.
    lines : RangeLines
        Lines with a profile.
    sample : RaySample
        A sample of them, in which some pixels are visible.
    straight : RangeLines
        The channels of the sample in homogeneous water.
    points_m : float64 [points, 3]
        The pixels of the sample in homogeneous water.

    Notes
    -----
    The ratio of sines depends a little on the distance and on heave. One ratio is fitted to the
    horizontal components of exact rays, and another to the vertical ones, which matter where tracks
    slope. The error is what they leave: in the weights, as far as these are smooth, and by the
    channels that a window which begins with a step includes or leaves out wrongly.
    """
    profile = lines.sound_speed
    assert profile is not None
    along = beam.directions(lines)
    point, channel = np.nonzero(sample.visible)
    of_rays = _directions_of_rays(sample, point, channel)
    apparent = unit_vectors(points_m[point] - straight.phase_centres_m[channel])
    faster = float(profile.at(lines.phase_centres_m[:, 2]).mean()) / straight.sound_speed_m_s
    ratio = _ratio(of_rays[:, :2], apparent[:, :2], faster)
    turned = unit_vectors(along * [1, 1, _ratio(of_rays[:, 2], apparent[:, 2], ratio) / ratio])
    values = {each.name: getattr(beam, each.name) for each in fields(BeamWindow)}
    if beam.element_length_m is not None:  # wavelengths at the antennas are longer
        values["element_length_m"] = beam.element_length_m / faster
    found = ApparentBeam(**values | {"along": turned, "ratio": ratio})
    wanted, given = (
        np.einsum("ni,ni->n", towards, each[sample.channels[channel]])
        for towards, each in ((of_rays, along), (apparent, turned))
    )
    at_antennas_m = faster * wavelength_m(straight)
    weights, others = (beam.weights(each, at_antennas_m) for each in (wanted, ratio * given))
    inside = (weights > 0) & (others > 0)
    if not inside.any():
        return found, 0.0, 0.0
    # Not relative to the weights of the sample: of few channels, all may lie near the edges.
    low, high = np.clip(beam.limits, -1, 1)
    sine = np.linspace(low, high, _SINES + 2)[1:-1]
    usual2 = np.mean(beam.weights(sine, at_antennas_m) ** 2)
    smooth = float(np.mean((others - weights)[inside] ** 2) / usual2)
    errors = ratio * given[inside] - wanted[inside]
    steps = _step_error(beam, wanted[inside], errors, at_antennas_m) / float(usual2)
    return found, smooth, steps


def _step_error(
    beam: BeamWindow,
    sines: NDArray[np.float64],
    errors: NDArray[np.float64],
    wavelength_m: float,
) -> float:
    """Return the mean squared error of weights at the steps with which a window begins and ends.

    A step is displaced by the errors of sines near it. Channels between its two places have the
    error of its height.
    """
    low, high = beam.limits
    near = _NEAR * (high - low)
    total = 0.0
    for edge, inwards in ((low, 1.0), (high, -1.0)):
        beside = np.abs(sines - edge) < near
        if abs(edge) < 1 and beside.any():
            height = float(beam.weights(edge + 1e-6 * inwards * near, wavelength_m))
            total += height**2 * float(np.abs(errors[beside]).sum()) / near
    return total / len(sines)


def _ratio(wanted: NDArray[np.float64], given: NDArray[np.float64], otherwise: float) -> float:
    """Return the factor by which given components fit wanted ones best, by least squares."""
    square = float(np.vdot(given, given))
    return float(np.vdot(wanted, given)) / square if square > 0 else otherwise


def _directions_of_rays(
    sample: RaySample, point: NDArray[np.int64], channel: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the directions in which rays leave the phase centres, unit vectors [pairs, 3]."""
    profile = sample.lines.sound_speed
    assert profile is not None
    centres_m = sample.lines.phase_centres_m[channel]
    offset_m = sample.points_m[point] - centres_m
    distance_m = np.hypot(offset_m[:, 0], offset_m[:, 1])
    found = rays(profile, distance_m, centres_m[:, 2], sample.points_m[point, 2])
    level = offset_m[:, :2] * (found.slowness_s_m / np.maximum(distance_m, SAME_PLACE_M))[:, None]
    speed_m_s = profile.at(centres_m[:, 2])
    return np.column_stack([level, -found.one_slope_s_m]) * speed_m_s[:, None]
