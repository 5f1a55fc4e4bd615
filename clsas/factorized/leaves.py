"""The last stage of a factorized image: leaves are backprojected from their virtual channels."""

from __future__ import annotations

from collections.abc import Callable
from itertools import permutations
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from clsas.aperture.mean_track import MeanTrack
from clsas.core.decibels import power
from clsas.core.lines import RangeLines
from clsas.core.wavelengths import wavelength_m
from clsas.exact.groups import Groups
from clsas.exact.lookup import lookup_options
from clsas.exact.tiles import Tiles
from clsas.factorized.buffers import Level, leaf_tables
from clsas.factorized.sectors import Roots, Sector
from clsas.opencl.buffers import (
    Slot,
    beam_table,
    filter_table,
    float_pairs,
    phase_polynomials,
    pixel_buffers,
)
from clsas.opencl.device import Device
from clsas.plans.plan import Plan
from clsas.sonar.beam import INTERVALS
from clsas.sonar.visibility import sines

_SHARE = 0.02  # of an image's error power, for one cubic of weights per block of pixels

Finish = Callable[[], int]
"""Waits for pixels, puts them in place, and returns their number."""


class Leaves:
    """Backprojection of leaves: in tiles on a plane, in groups of points elsewhere.

    Lines have half or single precision, and were multiplied by `gain`.
    """

    def __init__(
        self,
        lines: RangeLines,
        roots: Roots,
        plan: Plan,
        level: Level,
        device: Device,
        image: NDArray[np.complex64],
        half_precision: bool,
        gain: float,
    ) -> None:
        geometry = roots.geometry
        self.lines, self.roots, self.geometry = lines, roots, geometry
        self.level, self.device, self.plan = level, device, plan
        self.factorization = geometry.factorization
        self.surface, self.width = geometry.surface, device.info.width
        beam = geometry.beam
        self.normalise = beam is not None and beam.normalise
        self.beam = beam_table(device, beam, lines)
        self.arguments: dict[str, Any] = {
            "cycles_per_sample": geometry.cycles_per_m / geometry.samples_per_m,
            "filter": filter_table(device, geometry.factorization.final.coefficients / gain),
            "phase_polynomials": phase_polynomials(device, geometry.factorization.phase_terms),
            "line_pitch": level.pitch,
            **self.beam.arguments,
        }
        # Lines are aligned on the centres of leaves. Smaller tiles need references of their own.
        self.aligned = geometry.factorization.tile == geometry.factorization.sides[-1]
        self.slot, self.image, self.half_precision = Slot(device), image, half_precision
        self._prepare()

    def _prepare(self) -> None:
        """Build the kernels, and lay out tiles or groups."""
        raise NotImplementedError

    def _options(self, layout: Tiles | Groups) -> dict[str, int]:
        """Return the kernels' build options."""
        taps, one_cubic = self.factorization.final.taps, False
        beam, along, nearest_m = (
            self.geometry.beam, self.geometry.along, self.geometry.nearest_m,
        )  # fmt: skip
        if beam is not None and along is not None and nearest_m is not None:
            radius_m = self.surface.radius_m(self.geometry.division.sides[0])
            nearest_m = max(nearest_m - radius_m, 1e-6)
            wave_m, track = wavelength_m(self.lines), self.geometry.track
            on_track = track.on_track
            centres_m = self.geometry.division.centres_m(0, self.geometry.division.roots)
            sine = sines(centres_m, track.sampled_m[0][on_track], along[on_track])
            error = layout.one_cubic_error(beam, nearest_m, wave_m)
            error /= beam.fullness(sine, wave_m, on_track.sum() / self.lines.channels)
            allowed_db = min(self.plan.predicted_error_db, self.plan.tolerance_db or 0.0)
            one_cubic = error**2 < _SHARE * power(allowed_db)
        return {
            "WIDTH": self.width,
            "TAPS": taps,
            "BEAM": 0 if beam is None else INTERVALS,
            "ONE_CUBIC": int(one_cubic),
            "NORMALISE": int(self.normalise),
            "OVERWRITE": 1,
            "ALIGNED": int(self.aligned),
            "HALF": int(self.half_precision),
            "PHASE_TERMS": self.factorization.phase_terms,
        } | lookup_options(self.device, layout, self.lines, self.geometry.samples_per_m, taps)

    def fill(self, slot: Slot, sector: Sector) -> None:
        """Start copying the tables of a sector's leaves to the device."""
        position_m = sector.positions_m(-1)
        rows = [float_pairs(position_m.reshape(-1, 3))]
        if self.geometry.directions is not None:
            nodes = sector.nodes[-1]
            along = self.geometry.directions.at(nodes.coordinate, nodes.across)
            rows.append((along * self.beam.per_sine).astype(np.float32).reshape(-1, 3))
        values = {"geometry": np.concatenate(rows, axis=1).T} | self._parts(sector)
        if self.normalise:
            values["represented"] = represented(sector, self.geometry.track).reshape(1, -1)
        parts = values["ranges"].size // 3
        points = values["offsets"].shape[1] if "offsets" in values else None
        tables = leaf_tables(len(rows[0]), parts, points, self.geometry.beam)
        for name, buffer in tables.items():
            slot.fill(name, buffer.holding(values[name]))

    def form(self, tables: Slot, sector: Sector, batch: slice, samples: cl.Buffer) -> Finish:
        """Start forming the pixels of some roots of a sector from the lines of their leaves.

        Parameters
        ----------
        tables : Slot
            Filled by `fill`.
        samples : Buffer
            The lines.
        """
        raise NotImplementedError

    def complete(self) -> None:
        """Hand all pixels to the host, once they are finished."""

    def blank(self, sector: Sector, batch: slice) -> Finish:
        """Return a function that sets the pixels of roots that no channel sees to 0."""
        raise NotImplementedError

    def _parts(self, sector: Sector) -> dict[str, NDArray]:
        """Return the tables of a sector's tiles or groups: see `leaf_tables`."""
        raise NotImplementedError

    def _ranges(
        self,
        sector: Sector,
        root: NDArray[np.int64],
        leaf: NDArray[np.int64],
    ) -> NDArray[np.int32]:
        """Return virtual channels of tiles or groups, and the first line, [..., 3]."""
        need = sector.needs[-1]
        node = root * sector.nodes[-1].coordinate.shape[1]
        in_batch = root % self.factorization.roots_at_once * need.first.shape[1] + leaf
        ranges = [
            node + need.first[root, leaf],
            node + need.last[root, leaf],
            in_batch * sector.stride(-1),
        ]
        return np.stack(np.broadcast_arrays(*ranges), axis=-1).astype(np.int32)

    def _pixels(self, tables: Slot, count: int) -> dict[str, Any]:
        """Return the arguments of kernels that form some pixels."""
        found = self.slot.make(pixel_buffers(count, self.geometry.beam))
        if self.normalise and self.aligned:
            found["represented"] = tables["represented"]
        return found


def represented(sector: Sector, track: MeanTrack) -> NDArray[np.float32]:
    """Return how many raw channels each virtual channel of the leaves stands for, [roots, n].

    Cubics interpolate the beam's weights, which are smooth along the track and across a sheet. The
    stages' filters err as little on average, but with the same sign on a function so smooth.
    """
    nodes = sector.nodes[-1]
    shares = np.empty(nodes.coordinate.shape)
    strip = track.strip_of(sector.coordinate[0])
    for root, (at, place) in enumerate(zip(nodes.coordinate, sector.coordinate, strict=True)):
        if nodes.rows is not None and sector.across is not None:
            columns = at[: len(at) // len(nodes.rows[root])]
            column, along = _cubics(columns, place)
            row, across = _cubics(nodes.rows[root], sector.across[root])
            index = len(columns) * row[:, :, None] + column[:, None]
            weights = across[:, :, None] * along[:, None]
        elif nodes.bands is not None:
            first = nodes.bands.first[root][strip]
            index, weights = _cubics(at, place, first, first + nodes.bands.width[root][strip])
        else:
            index, weights = _cubics(at, place)
        shares[root] = np.bincount(index.ravel(), weights.ravel(), len(at))
    return shares.astype(np.float32)


def _cubics(
    at: NDArray[np.float64],
    place: NDArray[np.float64],
    first: NDArray[np.int64] | int = 0,
    stop: NDArray[np.int64] | int | None = None,
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return which four of ascending coordinates interpolate places, and their weights, [n, 4].

    Those of each place are from `first` on, and before `stop`.
    """
    stop = len(at) if stop is None else stop
    begin = np.clip(np.searchsorted(at, place) - 2, first, np.asarray(stop) - 4)
    index = begin[:, None] + np.arange(4)
    near = at[index]
    weights = np.ones(near.shape)
    for one, other in permutations(range(4), 2):
        weights[:, one] *= (place - near[:, other]) / (near[:, one] - near[:, other])
    return index, weights
