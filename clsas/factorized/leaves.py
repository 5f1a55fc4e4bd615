"""The last stage of a factorized image: leaves are backprojected from their virtual channels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import permutations
from typing import Any, Protocol

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
from clsas.factorized.device_lines import DeviceLines
from clsas.factorized.geometry import Geometry
from clsas.factorized.sectors import Sector
from clsas.opencl.buffers import (
    BeamTable,
    Slot,
    beam_table,
    filter_table,
    float_pairs,
    phase_polynomials,
    pixel_buffers,
)
from clsas.opencl.device import Device
from clsas.sonar.beam import INTERVALS
from clsas.sonar.visibility import sines

_SHARE = 0.02  # of an image's error power, for one cubic of weights per block of pixels

Finish = Callable[[], int]
"""Waits for pixels, puts them in place, and returns their number."""


class Leaves(Protocol):
    """Backprojection of leaves: in tiles on a plane, in groups of points elsewhere."""

    def fill(self, slot: Slot, sector: Sector) -> None:
        """Start copying the tables of a sector's leaves to the device."""

    def form(self, tables: Slot, sector: Sector, batch: slice, samples: cl.Buffer) -> Finish:
        """Start forming the pixels of some roots of a sector from the lines of their leaves.

        Parameters
        ----------
        tables : Slot
            Filled by `fill`.
        sector : Sector
        batch : slice
            The roots, among those of the sector.
        samples : Buffer
            The lines.
        """

    def blank(self, sector: Sector, batch: slice) -> Finish:
        """Return a function that sets the pixels of roots without visible channels to 0."""

    def complete(self) -> None:
        """Hand all pixels to the host, once they are finished."""


@dataclass(frozen=True, eq=False)
class LeafStage:
    """The last stage: lines, geometry and kernel arguments that both kinds of leaves share.

    Attributes
    ----------
    lines : RangeLines
    geometry : Geometry
    device : Device
    half_precision : bool
        True if the leaves' lines are in half precision.
    allowed_db : float
        Error that the image may have.
    level : Level
        Layout of the leaves' lines.
    beam : BeamTable
        Weights of the beam.
    arguments : dict
        Arguments of the backprojection kernels that are the same for all leaves, by name.
    slot : Slot
        Buffers in which leaves are formed.
    """

    lines: RangeLines
    geometry: Geometry
    device: Device
    half_precision: bool
    allowed_db: float
    level: Level
    beam: BeamTable
    arguments: dict[str, Any]
    slot: Slot

    @classmethod
    def of(
        cls,
        lines: RangeLines,
        uploaded: DeviceLines,
        geometry: Geometry,
        device: Device,
        allowed_db: float,
    ) -> LeafStage:
        """Return the last stage of an image whose lines are on a device."""
        factorization = geometry.factorization
        level = Level.of(factorization.half_lengths[-1], device.info.width)
        beam = beam_table(device, geometry.beam, lines)
        arguments = {
            "cycles_per_sample": geometry.cycles_per_m / geometry.samples_per_m,
            "filter": filter_table(device, factorization.final.coefficients / uploaded.gain),
            "phase_polynomials": phase_polynomials(device, factorization.phase_terms),
            "line_pitch": level.pitch,
            **beam.arguments,
        }
        return cls(
            lines=lines,
            geometry=geometry,
            device=device,
            half_precision=uploaded.half_precision,
            allowed_db=allowed_db,
            level=level,
            beam=beam,
            arguments=arguments,
            slot=Slot(device),
        )

    @property
    def normalise(self) -> bool:
        """True if pixels are divided by the sums of their weights."""
        return self.geometry.beam is not None and self.geometry.beam.normalise

    @property
    def aligned(self) -> bool:
        """True if tiles are leaves, on whose centres lines are aligned.

        Smaller tiles need references of their own.
        """
        return self.geometry.factorization.tile == self.geometry.factorization.sides[-1]

    def options(self, layout: Tiles | Groups) -> dict[str, int]:
        """Return the build options of the backprojection kernels."""
        factorization, width = self.geometry.factorization, self.device.info.width
        taps = factorization.final.taps
        return {
            "WIDTH": width,
            "TAPS": taps,
            "BEAM": 0 if self.geometry.beam is None else INTERVALS,
            "ONE_CUBIC": int(self._one_cubic_serves(layout)),
            "NORMALISE": int(self.normalise),
            "OVERWRITE": 1,
            "ALIGNED": int(self.aligned),
            "HALF": int(self.half_precision),
            "PHASE_TERMS": factorization.phase_terms,
        } | lookup_options(self.device, layout, self.lines, self.geometry.samples_per_m, taps)

    def _one_cubic_serves(self, layout: Tiles | Groups) -> bool:
        """Return whether one cubic of the beam's weights is enough for a block of pixels."""
        geometry = self.geometry
        beam, along, nearest_m = geometry.beam, geometry.along, geometry.nearest_m
        if beam is None or along is None or nearest_m is None:
            return False
        nearest_m = max(nearest_m - geometry.surface.radius_m(geometry.division.sides[0]), 1e-6)
        wave_m, on_track = wavelength_m(self.lines), geometry.track.on_track
        centres_m = geometry.division.centres_m(0, geometry.division.roots)
        sine = sines(centres_m, geometry.track.sampled_m[0][on_track], along[on_track])
        error = layout.one_cubic_error(beam, nearest_m, wave_m)
        error /= beam.fullness(sine, wave_m, on_track.sum() / self.lines.channels)
        return bool(error**2 < _SHARE * power(self.allowed_db))

    def fill(self, slot: Slot, sector: Sector, parts: dict[str, NDArray]) -> None:
        """Start copying the tables of a sector's leaves to the device.

        Parameters
        ----------
        slot : Slot
        sector : Sector
        parts : dict of str to array
            Tables of tiles or groups; see `clsas.factorized.buffers.leaf_tables`.
        """
        position_m = sector.positions_m(-1)
        rows = [float_pairs(position_m.reshape(-1, 3))]
        if self.geometry.directions is not None:
            virtual = sector.virtual[-1]
            along = self.geometry.directions.at(virtual.coordinate, virtual.across)
            rows.append((along * self.beam.per_sine).astype(np.float32).reshape(-1, 3))
        values = {"geometry": np.concatenate(rows, axis=1).T} | parts
        if self.normalise:
            values["represented"] = represented(sector, self.geometry.track).reshape(1, -1)
        count = values["ranges"].size // 3
        points = values["offsets"].shape[1] if "offsets" in values else None
        corrected = values["corrections"].shape[1] if "corrections" in values else 0
        tables = leaf_tables(len(rows[0]), count, points, self.geometry.beam, corrected)
        for name, buffer in tables.items():
            slot.fill(name, buffer.holding(values[name]))

    def ranges(
        self, sector: Sector, root: NDArray[np.int64], leaf: NDArray[np.int64]
    ) -> NDArray[np.int32]:
        """Return virtual channels of tiles or groups, and the first line, [..., 3].

        Parameters
        ----------
        sector : Sector
        root : int64 [...]
            Root of each tile or group, among those of the sector.
        leaf : int64 [...]
            Its leaf, among those of the root.
        """
        need = sector.needs[-1]
        first_of_root = root * sector.virtual[-1].coordinate.shape[1]
        at_once = self.geometry.factorization.roots_at_once
        in_batch = root % at_once * need.first.shape[1] + leaf
        ranges = [
            first_of_root + need.first[root, leaf],
            first_of_root + need.last[root, leaf],
            in_batch * sector.stride(-1),
        ]
        return np.stack(np.broadcast_arrays(*ranges), axis=-1).astype(np.int32)

    def pixels(self, tables: Slot, count: int) -> dict[str, Any]:
        """Return the kernels' arguments for some pixels that they form."""
        found: dict[str, Any] = self.slot.make(pixel_buffers(count, self.geometry.beam))
        if self.normalise and self.aligned:
            found["represented"] = tables["represented"]
        return found


def represented(sector: Sector, track: MeanTrack) -> NDArray[np.float32]:
    """Return the number of raw channels that each virtual channel of the leaves stands for.

    Cubics interpolate the beam's weights, which are smooth along the track and across a sheet. The
    stages' filters have errors as small on average, but of the same sign on such a smooth function.

    Returns
    -------
    float32 [roots, virtual channels]
    """
    if track.is_sheet:
        cubics_of = _cubics_on_sheet
    elif track.others:
        cubics_of = _cubics_on_strips
    else:
        cubics_of = _cubics_on_curve
    shares = np.empty(sector.virtual[-1].coordinate.shape)
    for root, share in enumerate(shares):
        index, weights = cubics_of(sector, track, root)
        share[:] = np.bincount(index.ravel(), weights.ravel(), len(share))
    return shares.astype(np.float32)


_Cubics = tuple[NDArray[np.int64], NDArray[np.float64]]
"""Indices of virtual channels that interpolate raw channels, and their weights."""


def _cubics_on_curve(sector: Sector, track: MeanTrack, root: int) -> _Cubics:
    return _cubics(sector.virtual[-1].coordinate[root], sector.coordinate[root])


def _cubics_on_strips(sector: Sector, track: MeanTrack, root: int) -> _Cubics:
    virtual = sector.virtual[-1]
    assert virtual.bands is not None
    strip = track.strip_of(sector.coordinate[0])
    first = virtual.bands.first[root][strip]
    stop = first + virtual.bands.width[root][strip]
    return _cubics(virtual.coordinate[root], sector.coordinate[root], first, stop)


def _cubics_on_sheet(sector: Sector, track: MeanTrack, root: int) -> _Cubics:
    virtual = sector.virtual[-1]
    assert virtual.rows is not None
    assert sector.across is not None
    rows, coordinate = virtual.rows[root], virtual.coordinate[root]
    columns = coordinate[: len(coordinate) // len(rows)]
    column, along = _cubics(columns, sector.coordinate[root])
    row, across = _cubics(rows, sector.across[root])
    index = len(columns) * row[:, :, None] + column[:, None]
    return index, across[:, :, None] * along[:, None]


def _cubics(
    virtual: NDArray[np.float64],
    coordinate: NDArray[np.float64],
    first: NDArray[np.int64] | int = 0,
    stop: NDArray[np.int64] | int | None = None,
) -> _Cubics:
    """Return the four virtual channels that interpolate each raw channel, and weights, [n, 4].

    Parameters
    ----------
    virtual : float64 [virtual channels]
        Coordinates of virtual channels, ascending.
    coordinate : float64 [n]
        Coordinates of the raw channels.
    first, stop : int64 [n] or int, optional
        Virtual channels that may interpolate each: the first, and the one after the last.
    """
    stop = len(virtual) if stop is None else stop
    begin = np.clip(np.searchsorted(virtual, coordinate) - 2, first, np.asarray(stop) - 4)
    index = begin[:, None] + np.arange(4)
    near = virtual[index]
    weights = np.ones(near.shape)
    for one, other in permutations(range(4), 2):
        weights[:, one] *= (coordinate - near[:, other]) / (near[:, one] - near[:, other])
    return index, weights
