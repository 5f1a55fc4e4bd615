"""Factorized backprojection: the aperture interpolated, stage by stage."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from clsas import validate
from clsas.backproject import float_pairs, padded_lines
from clsas.device import Device, open_device
from clsas.geometry import pairwise_range_m
from clsas.grid import Grid
from clsas.image import Image
from clsas.layout import STACK
from clsas.lines import RangeLines
from clsas.plan import Plan, aperture_coordinate, direction_angles, half_lengths, plan

# Zeros that the last stage's lookup may touch on either side of a line.
_GUARD = 16
# Points at which the mean track is looked up, and how far beyond its ends, in its lengths.
_CURVE_POINTS = 257
_CURVE_BEYOND = 0.5


@dataclass(frozen=True, eq=False)
class _Stage:
    """Lines of some subimages on the device, each aligned on its subimage's centre."""

    lines: cl.Buffer
    pitch: int
    centre_sample: int
    centres_m: NDArray[np.float64]  # [subimages, 3]
    positions_m: NDArray[np.float64]  # of the virtual channels, [subimages, channels, 3]


def factorize(
    lines: RangeLines,
    grid: Grid,
    plan_or_tolerance: Plan | float,
    *,
    device: Device | str | int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Image:
    """Form the image of range lines on a plane, fast, to a tolerance.

    Parameters
    ----------
    lines : RangeLines
        Monostatic or bistatic, at rest during flight, from a track that a cubic describes but for
        small motion.
    grid : Grid
        A plane.
    plan_or_tolerance : Plan or float
        A plan made for these lines and this grid, or the relative rms error wanted, dB.
    device : Device, str or int, optional
        See `clsas.device.choose`.
    progress : callable, optional
        Called as progress(pixels done, pixels).

    Returns
    -------
    Image

    Raises
    ------
    TypeError, ValueError
        If an argument is not what is allowed.
    DeviceError
        If there is no such device.

    Notes
    -----
    Aligned on a subimage's centre c, channel n's steering function exp(j 2 k (rho_n(x) - rho_n(c)))
    varies slowly with its direction, and is interpolated from those of fewer, virtual channels:
    f_n ~ sum_m a_nm f_m. Hence sum_n s_n f_n ~ sum_m (sum_n a_nm s_n) f_m.
    """
    validate.progress(progress)
    chosen = plan_or_tolerance
    if not isinstance(chosen, Plan):
        chosen = plan(lines, grid, tolerance_db=chosen)
    run = _Run(lines, grid, chosen, open_device(device))
    side = chosen.sides[0]
    rows, columns = grid.shape
    pixels = np.empty(grid.shape, np.complex64)
    done = 0
    try:
        for row in range(0, rows, side):
            for column in range(0, columns, side):
                part = np.s_[row : row + side, column : column + side]
                pixels[part] = run.root(row, column)[: rows - row, : columns - column]
                done += pixels[part].size
                if progress is not None:
                    progress(done, grid.size)
    finally:
        run.device.finish()
    return Image(pixels, grid)


class _Run:
    """A plan at work on a device."""

    def __init__(self, lines: RangeLines, grid: Grid, chosen: Plan, device: Device) -> None:
        self.raw, self.grid, self.plan, self.device = lines, grid, chosen, device
        self.width = device.info.width
        self.samples_per_m = chosen.resampling.ratio / lines.range_step_m
        self.half = half_lengths(grid, chosen.sides, chosen.align, chosen.final, self.samples_per_m)
        resampling = chosen.resampling
        self.cycles_per_m = (
            lines.carrier_cycles_per_m + resampling.centre_cycles_per_sample / lines.range_step_m
        )
        self.filters = {
            name: device.upload(getattr(chosen, name).coefficients.astype(np.float32))
            for name in ("align", "aperture", "final")
        }
        aperture = {"WIDTH": self.width, "TAPS": chosen.aperture.taps}
        self.align = device.kernel("align", "align", WIDTH=self.width, TAPS=chosen.align.taps)
        self.weigh = device.kernel("combine", "aperture_weights", **aperture)
        self.combine = device.kernel("combine", "combine", **aperture)
        last = {
            "WIDTH": self.width,
            "TAPS": chosen.final.taps,
            "TILE": chosen.sides[-1],
            "PERMUTE": int(device.info.permute),
            "BISTATIC": 0,
            "MOVING": 0,
            "OWN_LINES": 1,
        }
        self.expand = device.kernel("backproject", "expand_tiles", **last)
        self.backproject = device.kernel("backproject", "backproject_tiles", **last)
        self.coordinates = [
            aperture_coordinate(grid, side, chosen.highest_cycles_per_m) for side in chosen.sides
        ]
        self.track_m = _mean_track(lines)
        # Zeros around a line: a subimage may reach beyond its end, or lie outside it.
        self.margin = 2 * self.half[0] + 64
        self.pitch = resampling.length + 2 * self.margin
        upsampled = resampling.apply(lines.samples)
        padded = padded_lines(upsampled, self.width, self.margin, self.pitch)
        self.samples = device.upload(padded)

    def root(self, row: int, column: int) -> NDArray[np.complex64]:
        """Return the pixels of the root subimage that begins at a pixel."""
        sides = self.plan.sides
        stage = None
        for level, side in enumerate(sides):
            across = sides[0] // side
            down, right = np.divmod(np.arange(across**2), across)
            middle = (side - 1) / 2
            centres_m = (
                self.grid.origin_m
                + (row + down * side + middle)[:, None] * self.grid.row_step_m
                + (column + right * side + middle)[:, None] * self.grid.column_step_m
            )
            factor = sides[max(level - 1, 0)] // side
            parent_of = down // factor * (across // factor) + right // factor
            stage = self._divide(stage, level, centres_m, parent_of)
        return self._backproject(stage)

    def _divide(
        self,
        parent: _Stage | None,
        level: int,
        centres_m: NDArray[np.float64],
        parent_of: NDArray[np.int64],
    ) -> _Stage:
        """Return the stage of some subimages from their parents', or from the raw lines."""
        device, half = self.device, self.half[level]
        taps = self.plan.aperture.taps
        place, cycles, angle = self._references(parent, centres_m, parent_of)
        lines, pitch = (
            (self.samples, self.pitch) if parent is None else (parent.lines, parent.pitch)
        )
        place -= half
        lower = np.floor(place)
        start = np.clip(lower + 1 - self.plan.align.taps // 2, -half, pitch).astype(np.int32)
        first, order, nu, positions_m = self._nodes(level, centres_m, angle)
        children, channels = angle.shape
        nodes = positions_m.shape[1]
        length = -(-(2 * half + 1) // self.width) * self.width

        weights = device.buffer(4 * children * channels * taps)
        size = (channels, children)
        device.run(self.weigh, size, device.upload(nu), self.filters["aperture"], weights)
        aligned = device.buffer(8 * children * channels * length)
        device.run(
            self.align,
            size,
            lines,
            pitch,
            device.upload(parent_of.astype(np.int32)),
            device.upload(start),
            device.upload((place - lower - 0.5).astype(np.float32)),
            device.upload((cycles - np.rint(cycles)).astype(np.float32)),
            self.filters["align"],
            aligned,
            length,
        )
        pitch = length + 2 * _GUARD
        combined = device.zeros(8 * children * nodes * pitch)
        device.run(
            self.combine,
            (length // self.width, children),
            aligned,
            length,
            channels,
            device.upload(order),
            device.upload(first),
            weights,
            nodes,
            combined,
            pitch,
            _GUARD,
        )
        return _Stage(combined, pitch, half + _GUARD, centres_m, positions_m)

    def _references(
        self, parent: _Stage | None, centres_m: NDArray[np.float64], parent_of: NDArray[np.int64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return how each centre sees the channels of its parent, [subimages, channels].

        That is the place in their lines, in samples, the phase in cycles, and the angle.
        """
        raw, resampling = self.raw, self.plan.resampling
        if parent is None:
            range_m = pairwise_range_m(centres_m, raw.tx_m, raw.rx_m)
            place = (range_m - raw.first_range_m) / raw.range_step_m + resampling.lead
            cycles = raw.carrier_cycles_per_m * range_m
            cycles += place * resampling.centre_cycles_per_sample
            place = place * resampling.ratio + self.margin - resampling.first
            return place, cycles, direction_angles(self.grid, centres_m, raw.tx_m, raw.rx_m)
        shape = (len(centres_m), parent.positions_m.shape[1])
        range_m, angle = np.empty(shape), np.empty(shape)
        for index, positions_m in enumerate(parent.positions_m):
            mine = np.flatnonzero(parent_of == index)
            own = parent.centres_m[index : index + 1]
            range_m[mine] = pairwise_range_m(centres_m[mine], positions_m, positions_m)
            range_m[mine] -= pairwise_range_m(own, positions_m, positions_m)
            angle[mine] = direction_angles(self.grid, centres_m[mine], positions_m)
        place = parent.centre_sample + range_m * self.samples_per_m
        return place, self.cycles_per_m * range_m, angle

    def _nodes(
        self, level: int, centres_m: NDArray[np.float64], angle: NDArray[np.float64]
    ) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float32], NDArray[np.float64]]:
        """Return the virtual channels of some subimages and what each channel gives to them.

        Returns
        -------
        first : int32 [subimages, nodes + 1]
        order : int32 [subimages, channels]
            See cl/combine.cl.
        nu : float32 [subimages, channels]
            Position of each channel between its middle two nodes, -0.5 to 0.5.
        positions_m : float64 [subimages, nodes, 3]
            On the mean track, equally spaced in the aperture coordinate.
        """
        angles, turned = self.coordinates[level]
        aperture = self.plan.aperture
        density = 2 * aperture.upsampling
        place = density * np.interp(angle, angles, turned)
        base = np.floor(place.min(axis=1, keepdims=True)) - (aperture.taps // 2 - 1)
        place -= base
        lower = np.floor(place).astype(np.int32)
        first_node = lower - (aperture.taps // 2 - 1)
        nodes = int(first_node.max()) + aperture.taps
        order = np.argsort(first_node, axis=1, kind="stable").astype(np.int32)
        flat = first_node + (nodes + 1) * np.arange(len(place))[:, None]
        counts = np.bincount(flat.ravel(), minlength=len(place) * (nodes + 1))
        before = np.cumsum(counts.reshape(-1, nodes + 1), axis=1)
        first = np.pad(before[:, :-1], ((0, 0), (1, 0))).astype(np.int32)

        node_angle = np.interp((base + np.arange(nodes)) / density, turned, angles)
        along = np.linspace(-1 - _CURVE_BEYOND, 1 + _CURVE_BEYOND, _CURVE_POINTS)
        seen = direction_angles(self.grid, centres_m, self.track_m(along))
        node_along = np.empty_like(node_angle)
        for each, (wanted, curve) in enumerate(zip(node_angle, seen, strict=True)):
            falling = curve[0] > curve[-1]
            backwards = slice(None, None, -1 if falling else 1)
            node_along[each] = np.interp(wanted, curve[backwards], along[backwards])
        nu = (place - lower - 0.5).astype(np.float32)
        return first, order, nu, self.track_m(node_along)

    def _backproject(self, stage: _Stage) -> NDArray[np.complex64]:
        """Return the pixels of a root from its last stage."""
        device, side = self.device, self.plan.sides[0]
        tiles, nodes = stage.positions_m.shape[:2]
        channel_pitch = -(-nodes // 16) * 16
        origin_m = stage.centres_m[0]
        geometry = float_pairs((stage.positions_m - origin_m).reshape(-1, 3))
        geometry = geometry.reshape(tiles, nodes, 6).swapaxes(1, 2)
        geometry = np.pad(geometry, ((0, 0), (0, 0), (0, channel_pitch - nodes)), mode="edge")
        geometry = device.upload(geometry)
        expansion = device.buffer(4 * 9 * tiles * channel_pitch)
        steps = (self.grid.column_step_m, self.grid.row_step_m)
        device.run(
            self.expand,
            (channel_pitch // self.width, tiles),
            geometry,
            channel_pitch,
            device.upload(float_pairs(stage.centres_m - origin_m)),
            *(np.append(step, 0).astype(np.float32) for step in steps),
            self.samples_per_m,
            expansion,
        )
        # Every line is aligned on its tile's centre: nothing is left to refer to.
        zeros = device.zeros(4 * tiles * channel_pitch)
        centre = np.full((tiles, channel_pitch), stage.centre_sample, np.int32)
        pixels = device.zeros(8 * side**2)
        device.run(
            self.backproject,
            (self.plan.sides[-1] ** 2 // (self.width * STACK), tiles),
            stage.lines,
            stage.pitch,
            device.upload(centre),
            zeros,
            zeros,
            expansion,
            nodes,
            channel_pitch,
            self.cycles_per_m / self.samples_per_m,
            self.filters["final"],
            pixels,
            side,
            0,
        )
        image = np.empty((side, side), np.complex64)
        cl.enqueue_copy(device.queue, image, pixels)
        return image


def _mean_track(lines: RangeLines) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """Return a cubic through the phase centres: a function from -1..1 to positions [..., 3]."""
    centres_m = (lines.tx_m + lines.rx_m) / 2
    middle_m = centres_m.mean(axis=0)
    along = (centres_m - middle_m) @ np.linalg.svd(centres_m - middle_m, full_matrices=False)[2][0]
    reach_m = np.abs(along).max() or 1.0
    cubic = np.polyfit(along / reach_m, centres_m - middle_m, min(3, lines.channels - 1))
    return lambda place: middle_m + np.polyval(cubic[:, None], place[..., None])
