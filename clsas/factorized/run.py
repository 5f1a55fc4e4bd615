"""One factorized image at work on a device."""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Iterator

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from clsas.core.lines import RangeLines
from clsas.factorized import device_lines
from clsas.factorized.leaves import Finish, LeafStage, Leaves
from clsas.factorized.plane_leaves import PlaneLeaves
from clsas.factorized.sectors import Roots, Sector
from clsas.factorized.stages import SectorTables, Stages
from clsas.factorized.surface_leaves import SurfaceLeaves
from clsas.opencl.buffers import Slot
from clsas.opencl.device import Device
from clsas.plans.plan import Plan

_AHEAD_S = 0.1  # of enqueued work: hides the preparation of roots; an interruption waits for it
_PREPARED_FIRST = 4  # batches in the first sector, few, so that the device starts early


class Run:
    """An image of some lines at work on a device.

    Parameters
    ----------
    lines : RangeLines
    plan : Plan
    roots : Roots
        What all images of the same geometry share.
    device : Device
    pixels : complex64 array
        The image, which the run fills.
    largest : float
        Largest magnitude of a sample.
    """

    def __init__(
        self,
        lines: RangeLines,
        plan: Plan,
        roots: Roots,
        device: Device,
        pixels: NDArray[np.complex64],
        largest: float,
    ) -> None:
        self.plan, self.roots, self.device = plan, roots, device
        # Uploaded first: the device upsamples lines while the host prepares the geometry.
        uploaded = device_lines.upload(lines, plan.factorization, device, largest)
        geometry = roots.geometry
        uploaded = device_lines.in_enough_precision(uploaded, lines, geometry, device, largest)
        self.stages = Stages(uploaded, geometry, device)
        self.leaves = _leaves(lines, uploaded, plan, roots, device, pixels)
        # One set of tables is filled while the device works with the other.
        self.table_slots = itertools.cycle([Slot(device), Slot(device)])

    def parts(self) -> Iterator[int]:
        """Form all pixels; yield the number of pixels each time that some are finished.

        The geometry of a sector is prepared while the device works on the one before.
        """
        under_way: deque[Finish] = deque()
        at_once = self.plan.factorization.roots_at_once
        batches = -(-len(self.roots.geometry.division.roots) // at_once)
        most = max(math.ceil(_AHEAD_S * batches / max(self.plan.predicted_seconds, 1e-9)), 2)
        for sector, tables in self._sectors():
            for first in range(0, len(sector.roots), at_once):
                batch = slice(first, min(first + at_once, len(sector.roots)))
                under_way.append(self._start(sector, tables, batch))
                if len(under_way) > most:
                    yield under_way.popleft()()
            tables.slot.busy = cl.enqueue_marker(self.device.queue)
        while under_way:
            yield under_way.popleft()()
        self.leaves.complete()

    def _sectors(self) -> Iterator[tuple[Sector, SectorTables]]:
        """Prepare sectors of roots; the first is small, for the device to begin with."""
        factorization = self.plan.factorization
        first = _PREPARED_FIRST * factorization.roots_at_once
        for sector in self.roots.sectors(first, factorization.roots_prepared):
            slot = next(self.table_slots)
            slot.wait()
            tables = self.stages.fill(slot, sector)
            self.leaves.fill(slot, sector)
            yield sector, tables

    def _start(self, sector: Sector, tables: SectorTables, batch: slice) -> Finish:
        """Start forming the pixels of some roots of a sector."""
        if not tables.has_lines:
            return self.leaves.blank(sector, batch)
        lines = self.stages.form(tables, batch)
        finish = self.leaves.form(tables.slot, sector, batch, lines)
        self.stages.busy_until(cl.enqueue_marker(self.device.queue))
        return finish


def _leaves(
    lines: RangeLines,
    uploaded: device_lines.DeviceLines,
    plan: Plan,
    roots: Roots,
    device: Device,
    pixels: NDArray[np.complex64],
) -> Leaves:
    """Return the leaves of an image: tiles on a plane, groups of points elsewhere."""
    allowed_db = min(plan.predicted_error_db, plan.tolerance_db or 0.0)
    stage = LeafStage.of(lines, uploaded, roots.geometry, device, allowed_db)
    if roots.geometry.surface.is_plane:
        return PlaneLeaves(stage, pixels)
    return SurfaceLeaves(stage, roots.groups(device.info.width), pixels)
