"""Form one patch of a mosaic: read its lines, plan, image, and write it to the store."""

from __future__ import annotations

import json
import threading
import time
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.coverage import reaches
from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Image, holds_any
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.validate import ArgumentError
from clsas.engine.device.device import Device
from clsas.engine.factorized.plan import ExactImage, Plan
from clsas.engine.factorized.planner import Request, planned, tolerance_in_db
from clsas.engine.forming import SceneImager, form
from clsas.engine.scene import Scene
from clsas.mosaics.devices import process_device, thread_device
from clsas.mosaics.patches import PatchWindow, host_bytes
from clsas.mosaics.provenance import REQUESTS, beam_json
from clsas.mosaics.record import Record
from clsas.mosaics.store import Store
from clsas.mosaics.survey import Survey, largest_gap_m, open_files
from clsas.mosaics.visibility import SurveyVisibility

# Pixels times channels. Backprojecting a smaller patch takes less time than planning it.
_WORTH_A_PLAN = 5e7
_OPENING = threading.Lock()
_LATEST: list[Survey] = []  # at most one entry: the survey that this process opened last

StampedFiles = tuple[tuple[Path, tuple[int, int]], ...]
"""Files of a survey, each with its size in bytes and time of change in ns."""


@dataclass(frozen=True, eq=False)
class Job:
    """Settings shared by all patches. They are pickled with every task and include no samples.

    Attributes
    ----------
    files : tuple of (Path, (int, int))
        Files from which a worker process opens the survey.
    local : SurveyVisibility or None
        The survey if patches are formed in this process, else None.
    request : dict
        One of `REQUESTS` with its value.
    beam : BeamWindow or None
    memory_bytes : int
        Memory of one patch.
    store : Path or None
    """

    files: StampedFiles
    local: SurveyVisibility | None
    request: dict[str, Any]
    beam: BeamWindow | None
    memory_bytes: int
    store: Path | None

    def accuracy_db(self, pairs: int) -> float | None:
        """Return the accuracy of exact imaging, dB, or None if the patch needs a plan.

        Parameters
        ----------
        pairs : int
            Number of pixels times number of channels.
        """
        if "accuracy_db" in self.request:
            return self.request["accuracy_db"]
        if "stages" in self.request or pairs > _WORTH_A_PLAN:
            return None
        return tolerance_in_db(*(self.request.get(name) for name in REQUESTS[:2]))

    def on(self, visibility: SurveyVisibility, in_process: bool) -> Job:
        """Return the settings with the present survey."""
        if in_process:
            return replace(self, local=visibility)
        return replace(self, files=stamped_files(visibility.survey))

    def form(self, window: PatchWindow) -> tuple[Record, Image | None]:
        """Form a patch; see `form_patch`."""
        return form_patch(self, window)

    def visibility(self) -> SurveyVisibility:
        """Return the survey. A worker process opens the files again if their number has changed.

        Raises
        ------
        ValueError
            If a file has changed.
        """
        if self.local is not None:
            return self.local
        with _OPENING:
            beam = None if self.beam is None else beam_json(self.beam)
            found = open_visibility(self.files, beam)
        if found.survey.stamps != tuple(stamp for _, stamp in self.files):
            raise ArgumentError(
                "source", "not change while a mosaic is formed, but a file of it did"
            )
        return found

    def opened_store(self) -> Store | None:
        """Return the store, or None if there is none."""
        return None if self.store is None else Store.at(self.store)

    def complete(self) -> None:
        """Compute the levels of the store that mix patches, once all patches are finished."""
        store = self.opened_store()
        if store is not None:
            store.complete_levels()


def stamped_files(survey: Survey) -> StampedFiles:
    """Return the files of a survey with their stamps, for `Job.files`."""
    pairs = zip(survey.parts, survey.stamps, strict=True)
    return tuple((part, stamp) for part, stamp in pairs if isinstance(part, Path))


@lru_cache(maxsize=2)
def open_visibility(files: StampedFiles, beam: str | None) -> SurveyVisibility:
    """Return a survey that a worker process opens; `beam` is JSON, which can be hashed."""
    # If files have been added to the survey, open only these.
    before = next((s for s in _LATEST if files[: len(s.parts)] == stamped_files(s)), None)
    survey = open_files(tuple(path for path, _ in files), before)
    _LATEST[:] = [survey]
    return SurveyVisibility.of(survey, None if beam is None else BeamWindow(**json.loads(beam)))


def form_patch(job: Job, window: PatchWindow) -> tuple[Record, Image | None]:
    """Form one patch and write it to the store.

    Returns
    -------
    record : Record
    image : Image or None
        None in a worker process: the main process then reads the pixels from the store.

    Raises
    ------
    ValueError
        If the patch cannot be imaged; a note says which patch it is.
    """
    try:
        device = process_device() if job.local is None else thread_device()
        record, image = _image(job, job.visibility(), window.grid, device)
    except ValueError as error:
        error.add_note(f"patch {window.row},{window.column}")
        raise
    store = job.opened_store()
    if store is not None:
        place = (window.row, window.column, window.rows, window.columns)
        store.write(*place, image.pixels, record)
    return record, None if job.local is None else image


def _image(
    job: Job, visibility: SurveyVisibility, grid: Grid, device: Device
) -> tuple[Record, Image]:
    """Return the image of one patch and the record of how it was formed."""
    start = time.perf_counter()
    survey, visible = visibility.survey, visibility.channels(grid)
    known: dict[str, Any] = {
        "survey_channels": survey.channels,
        "device": device.info.label,
        "driver": device.info.driver,
        "channels": int(np.count_nonzero(visible)),
    }
    if not visible.any():
        return Record(**known, seconds=time.perf_counter() - start), _empty(grid)
    lines, missing = survey.read(visible, *visibility.ranges_m(grid))
    known |= {
        "missing_channels": int(np.count_nonzero(missing)),
        "gap_m": largest_gap_m(lines, missing),
        "read_seconds": time.perf_counter() - start,
    }
    if missing.all():
        return Record(**known, seconds=time.perf_counter() - start), _empty(grid)
    beam = None
    if job.beam is not None and visibility.along is not None:
        beam = replace(job.beam, along=visibility.along[visible][~missing])
    if missing.any():
        lines = lines.select(~missing)
    if not reaches(lines, grid, beam, None if beam is None else beam.along):
        return Record(**known, seconds=time.perf_counter() - start), _empty(grid)
    _check_memory(job, lines, grid)
    image, how = _formed(job, lines, grid, beam, device)
    if beam is not None and beam.normalise:
        # The beam was normalised by the number of channels of this patch instead of all channels.
        scale = np.float32(survey.channels / lines.channels)
        image = replace(image, pixels=scale * image.pixels) if scale != 1 else image
    known |= how | {
        "has_pixels": holds_any(image.pixels),
        "seconds": time.perf_counter() - start,
    }
    return Record(**known), image


def _formed(
    job: Job, lines: RangeLines, grid: Grid, beam: BeamWindow | None, device: Device
) -> tuple[Image, dict[str, Any]]:
    """Return the image of some lines, and the fields of its record that describe the method."""
    patch_bytes = host_bytes(lines.channels, lines.length, grid.size)
    accuracy_db = job.accuracy_db(lines.channels * grid.size)
    if accuracy_db is not None:
        scene = Scene.of(lines, grid, beam, accuracy_db)
        scene.warn("accuracy_db", accuracy_db, doubts=False)
        # The record reports if the patch is zero.
        imager = SceneImager(scene, ExactImage(accuracy_db), device, warned=True, keep=False)
        assert imager.decision is not None
        error_db = max(accuracy_db, imager.decision.error_db(scene))
        how = {"predicted_error_db": error_db, "memory_bytes": patch_bytes}
        return imager.form(lines), how
    before = time.perf_counter()
    available = min(job.memory_bytes - patch_bytes, device.info.memory_bytes // 2)
    request = Request(lines, grid, **job.request, beam=beam, memory_bytes=available)
    scene = request.scene()
    scene.warn("tolerance_db", request.tolerance_db, doubts=False)
    chosen, track = planned(scene, request, device)
    how = {
        "plan_seconds": time.perf_counter() - before,
        "predicted_error_db": chosen.predicted_error_db,
        "predicted_seconds": chosen.predicted_seconds,
        "memory_bytes": patch_bytes + int(chosen.memory_bytes),
        "plan": json.loads(_without_directions(chosen).to_json()),
    }
    return form(scene, chosen, device, track=track, warned=True), how


def _check_memory(job: Job, lines: RangeLines, grid: Grid) -> None:
    """Raise ValueError if the lines and pixels of a patch alone exceed its memory."""
    patch_bytes = host_bytes(lines.channels, lines.length, grid.size)
    if patch_bytes >= job.memory_bytes:
        raise ArgumentError(
            "memory_bytes",
            f"be more than {patch_bytes / 2**20:.1f} MiB for {grid.shape[0]} x {grid.shape[1]} "
            f"pixels from {lines.channels} lines of {lines.length} samples",
            f"{job.memory_bytes / 2**20:.1f} MiB",
            "use smaller patches",
        )


def _empty(grid: Grid) -> Image:
    pixels: NDArray[np.complex64] = np.zeros(grid.shape, np.complex64)
    return Image(pixels, grid)


def _without_directions(chosen: Plan) -> Plan:
    """Return a plan without the beam's directions, which would be most of a record."""
    if chosen.beam is None:
        return chosen
    return replace(chosen, beam=replace(chosen.beam, along=None))
