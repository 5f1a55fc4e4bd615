"""Corrections of ranges along exact rays, for groups of neighbouring pixels.

In a profile of the sound speed, echoes from two heights may take equally long and yet focus
differently. Apparent antennas and pixels are right for one of these heights. What they lack varies
slowly: it is a fraction of a wavelength that changes over metres of pixels, and over metres of
antennas. Images are formed in groups of some dozen neighbouring pixels, whose differences in range
the device computes. The host adds the correction of one pixel of a group to the ranges of all.

Exact rays lead to some channels, the *nodes*. Other antennas interpolate between these.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines, some_channels
from clsas.engine.data.threads import in_threads
from clsas.engine.water.apparent_antennas import Change
from clsas.engine.water.ray_delays import RaySample, delays_s, in_beam, straight_m
from clsas.engine.water.ray_times import RayTimes

_GROUP = 8  # rows and columns of the largest groups of pixels, which have 64
_NODES = 32  # channels that see a pixel; twice as many if receivers differ
_MOST_NODES = 512  # bounds memory
_NEAREST = 12  # nodes from which others are interpolated
_BESIDE = 4  # further nodes on either side of the beam, so that its ends are interpolated too
_SINGULAR = 1e-3  # squared ratio of width to length below which nodes count as a straight row
_PAIRS_AT_ONCE = 1 << 16  # rays that a thread finds together; bounds memory


@dataclass(frozen=True, eq=False)
class Corrections:
    """Ranges along exact rays less those of apparent antennas and pixels.

    Attributes
    ----------
    lines : RangeLines
        Lines of the nodes, with the profile.
    nodes : int64 [nodes]
        Their channels.
    along : float64 [nodes, 3] or None
        Directions of the beam; None without one.
    beam : BeamWindow or None
    change : Change
        Apparent antennas.
    antennas : float64 [channels, 6]
        Phase centres of all channels in homogeneous water, and receivers relative to transmitters.
    grid, apparent : Grid
        Pixels, and their apparent positions.
    times : RayTimes
    """

    lines: RangeLines
    nodes: NDArray[np.int64]
    along: NDArray[np.float64] | None
    beam: BeamWindow | None
    change: Change
    antennas: NDArray[np.float64]
    grid: Grid
    apparent: Grid
    times: RayTimes

    @classmethod
    def between(
        cls,
        lines: RangeLines,
        beam: BeamWindow | None,
        sample: RaySample,
        change: Change,
        grids: tuple[Grid, Grid],
    ) -> Corrections:
        """Return the corrections of a change, for pixels and their apparent positions."""
        assert lines.sound_speed is not None
        seen = np.count_nonzero(sample.visible, axis=1)
        share = seen[seen > 0].min() / len(sample.channels)
        count = (2 if np.ptp(lines.rx_m - lines.tx_m, axis=0).any() else 1) * _NODES
        nodes = some_channels(lines.channels, min(round(count / share), _MOST_NODES))
        nodes = np.union1d(nodes, [0, lines.channels - 1])
        part = lines.select(nodes).without_samples()
        low_m, high_m = grids[0].bounds_m
        times = RayTimes(
            lines.sound_speed,
            _distances_m(part, low_m[:2], high_m[:2]),
            (float(low_m[2]), float(high_m[2])),
            expected=grids[0].size / _GROUP**2 * len(nodes),
        )
        along = None if beam is None else beam.directions(lines)[nodes]
        apparent = change.antennas(lines.without_samples(), slice(None))
        antennas = np.column_stack([apparent.phase_centres_m, apparent.rx_m - apparent.tx_m])
        return cls(part, nodes, along, beam, change, antennas, *grids, times)

    def at(self, pixels: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the corrections of the ranges of pixels at the nodes, metres.

        Parameters
        ----------
        pixels : int64 [pixels]

        Returns
        -------
        float64 [pixels, nodes]
            Nodes that do not see a pixel have the correction of a node that does, or 0.
        """
        found = np.empty((len(pixels), len(self.nodes)))
        at_once = max(_PAIRS_AT_ONCE // len(self.nodes), 1)

        def find(first: int) -> None:
            some = slice(first, first + at_once)
            found[some] = self._some_at(pixels[some])

        for _ in in_threads(find, range(0, len(pixels), at_once)):
            pass
        return found

    def usual(self, centres_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return antennas [n, 6] at phase centres [n, 3], with receivers as far away as usual."""
        apart_m = np.broadcast_to(self.antennas[:, 3:].mean(axis=0), centres_m.shape)
        return np.concatenate([centres_m, apart_m], axis=1)

    def weights(self, antennas: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the weights with which corrections are interpolated between nodes.

        Parameters
        ----------
        antennas : float64 [n, 6]
            Like `antennas`, of any channels.

        Returns
        -------
        float64 [n, nodes]
            Corrections of pixels for these antennas are ``at(pixels) @ weights.T``.
        """
        nodes = self.antennas[self.nodes]
        count = min(_NEAREST, len(nodes))
        nearest = cKDTree(nodes).query(antennas, k=count)[1].reshape(-1, count)
        weights = np.zeros((len(antennas), len(nodes)))
        np.put_along_axis(weights, nearest, _interpolating(nodes[nearest], antennas), axis=1)
        return weights

    def error(self, sample: RaySample) -> float:
        """Return the squared phase error that corrections leave at the worst sample pixel, rad^2.

        It is that of a pixel with the correction of another one, as far away as groups are wide,
        for other channels than the nodes.
        """
        beside_m = self.at(_beside(self.grid, sample.pixels))
        correction_m = beside_m @ self.weights(self.antennas[sample.channels]).T
        return self.change.error(sample, self.apparent.at(sample.pixels), correction_m)

    def _some_at(self, pixels: NDArray[np.int64]) -> NDArray[np.float64]:
        points_m = self.grid.at(pixels)
        visible = self._visible(points_m)
        pixel, node = np.nonzero(visible)
        delay_s = np.full(visible.shape, np.inf)
        delay_s[visible] = delays_s(self.lines, node, points_m[pixel], self._one_way_s)
        known = np.isfinite(delay_s)
        straight = straight_m(
            self.change.antennas(self.lines, self.nodes), self.apparent.at(pixels)
        )
        range_m = self.change.ranges_m(self.nodes, np.where(known, delay_s, 0.0).T).T
        return _filled(range_m - straight, known)

    def _visible(self, points_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return, for each point and node, whether rays are computed, [points, nodes].

        They are if the node sees the point, or lies beside a node that does.
        """
        if self.beam is None or self.along is None:
            return np.ones((len(points_m), len(self.nodes)), np.bool_)
        visible = in_beam(self.lines, points_m, self.beam, self.along, 0.0)
        for _ in range(_BESIDE):
            before, after = visible[:, :-1].copy(), visible[:, 1:].copy()
            visible[:, 1:] |= before
            visible[:, :-1] |= after
        return visible

    def _one_way_s(
        self, points_m: NDArray[np.float64], antennas_m: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the travel times between points and antennas; infinite where there is no ray."""
        distance_m = np.hypot(*(points_m[:, :2] - antennas_m[:, :2]).T)
        return self.times.between(distance_m, antennas_m[:, 2], points_m[:, 2])


def _distances_m(
    lines: RangeLines, low_m: NDArray[np.float64], high_m: NDArray[np.float64]
) -> tuple[float, float]:
    """Return the least and the largest distance of antennas from a rectangle, metres."""
    antennas_m = np.concatenate([lines.tx_m, lines.rx_m])[:, :2]
    nearest_m = np.maximum(np.maximum(low_m - antennas_m, antennas_m - high_m), 0.0)
    farthest_m = np.maximum(high_m - antennas_m, antennas_m - low_m)
    near_m, far_m = float(np.hypot(*nearest_m.T).min()), float(np.hypot(*farthest_m.T).max())
    if lines.rx_velocity_m_s is None:
        return near_m, far_m
    assert lines.sound_speed is not None
    # Receivers move until the echo arrives.
    longest_s = 2 * far_m / lines.sound_speed.speed_m_s.min()
    moved_m = float(longest_s * np.linalg.norm(lines.rx_velocity_m_s, axis=1).max())
    return max(near_m - moved_m, 0.0), far_m + moved_m


def _beside(grid: Grid, pixels: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return for each pixel one as far away as pixels of a group are from its middle."""
    if len(grid.shape) == 2:
        half = _GROUP // 2
        row, column = (
            np.where(each < half, np.minimum(each + half, n - 1), each - half)
            for each, n in zip(np.divmod(pixels, grid.shape[1]), grid.shape, strict=True)
        )
        return row * grid.shape[1] + column
    points_m = grid.positions_m().reshape(-1, 3)
    count = min(_GROUP**2, len(points_m))
    return cKDTree(points_m).query(points_m[pixels], k=[count])[1][:, 0]


def _filled(values: NDArray[np.float64], known: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return rows in which unknown values are those of the known ones before, or of the first."""
    before = np.maximum.accumulate(np.where(known, np.arange(known.shape[1]), -1), axis=1)
    source = np.where(before < 0, np.argmax(known, axis=1, keepdims=True), before)
    filled = np.take_along_axis(values, source, axis=1)
    return np.where(known.any(axis=1, keepdims=True), filled, 0.0)


def _interpolating(
    nodes_m: NDArray[np.float64], wanted_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the weights of nodes [n, count, axes] that interpolate to [n, axes], [n, count].

    They are exact for cubics along the direction in which the nodes extend most, for quadratics
    across it, and for what is linear in the third direction, as far as the nodes extend there. Of
    such weights, they are those with the least sum of squares, in which near nodes count most.
    Beyond the nodes, the value is that of the nearest end.
    """
    middle_m = nodes_m.mean(axis=1, keepdims=True)
    offset_m = nodes_m - middle_m
    scale_m = np.maximum(np.abs(offset_m).max(axis=(1, 2)), 1e-9)[:, None, None]
    axes = np.linalg.eigh(np.einsum("nki,nkj->nij", offset_m, offset_m))[1][..., ::-1]
    nodes = offset_m / scale_m @ axes
    position = (wanted_m[:, None] - middle_m) / scale_m @ axes
    position = np.clip(position, nodes.min(axis=1, keepdims=True), nodes.max(axis=1, keepdims=True))
    square = np.sum((nodes - position) ** 2, axis=-1)
    closeness = 1 / (square + square.mean(axis=1, keepdims=True) / 4 + 1e-12)
    closeness /= closeness.sum(axis=1, keepdims=True)
    terms, wanted = _terms(nodes), _terms(position)[:, 0]
    weighted = closeness[..., None] * terms
    gram = np.einsum("nkt,nku->ntu", weighted, terms)
    solved = np.einsum("ntu,nu->nt", np.linalg.pinv(gram, rcond=_SINGULAR, hermitian=True), wanted)
    weights = np.einsum("nkt,nt->nk", weighted, solved)
    return weights + (1 - weights.sum(axis=1, keepdims=True)) * closeness


def _terms(position: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the polynomials of `_interpolating` at positions along its axes, [..., terms]."""
    along, across, aside = np.moveaxis(position, -1, 0)[:3]
    cubic = chebyshev.chebvander(along, 3)
    others = np.stack([across, along * across, across**2, aside], axis=-1)
    return np.concatenate([cubic, others], axis=-1)
