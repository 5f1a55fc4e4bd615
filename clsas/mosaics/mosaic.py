"""Mosaics: an image of any size, patch by patch, resumable and on many devices or machines.

Every patch is planned and formed by itself, from the channels and samples that it needs. In a store
(clsas.store) it is finished once its record is there, which is written after its pixels.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import queue
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsas.core import reprs, validate
from clsas.core.geometry import bistatic_range_m
from clsas.core.grid import Grid
from clsas.core.image import Image, holds_any
from clsas.core.lines import RangeLines
from clsas.core.threads import uninterrupted, wait
from clsas.exact.backprojection import BEST_ACCURACY_DB, prepare
from clsas.exact.run import execute
from clsas.factorized.plan import Plan
from clsas.mosaics.provenance import WISHES, beam_json, inputs_of
from clsas.mosaics.record import Record, describe_damage
from clsas.mosaics.store import Store
from clsas.mosaics.survey import Survey, files_of, has_ended, largest_gap_m, open_files, open_survey
from clsas.opencl.device import (
    ENVIRONMENT_VARIABLE,
    Device,
    DeviceInfo,
    choose,
    list_devices,
    open_device,
)
from clsas.planning.factorize import factorize
from clsas.planning.planner import TOLERANCE_DB, checked_pairs, plan, tolerance_in_db
from clsas.sonar.beam import MOST_TRACK_PINGS, BeamWindow, touches_boxes

if TYPE_CHECKING:
    from distributed import Client

MEMORY_BYTES = 1 << 30
"""What one patch may take unless told otherwise."""

_LARGEST_SIDE = 4096  # pixels of a patch, where memory allows more: seconds of work
_SMALLEST_SIDE = 128
_WORTH_A_PLAN = 5e7  # pixels times channels; fewer are backprojected sooner than planned for
_POLL_S = 0.5
_MOST_WORKERS = 1024  # of one machine
_LOCAL = threading.local()  # a thread's own: its `device`
_OPENING = threading.Lock()
_LATEST: list[Survey] = []  # what this worker's threads opened last


@dataclass(frozen=True, eq=False)
class Patch:
    """One patch of a mosaic, formed.

    Attributes
    ----------
    row, column : int
        Which patch.
    rows, columns : slice
        Which pixels of the mosaic's grid it has.
    grid : Grid
        These pixels' grid.
    record : Record
        What is known about it: error, seconds, plan, gaps.
    """

    row: int
    column: int
    rows: slice
    columns: slice
    grid: Grid
    record: Record
    _formed: Image | None
    _store: Store | None

    def __repr__(self) -> str:
        """Return the patch's place, size and extents."""
        return reprs.summary(
            self,
            f"row {self.row}",
            f"column {self.column}",
            f"{reprs.by(self.grid.shape)} pixels",
            reprs.extents(*self.grid.bounds_m),
        )

    @property
    def image(self) -> Image:
        """The pixels; read from the store where another process formed them."""
        if self._formed is not None:
            return self._formed
        return Image(self._store.read(self.rows, self.columns), self.grid)


@dataclass(frozen=True, eq=False)
class Mosaic:
    """A mosaic to be formed: patch by patch, or whole as `image`.

    Iterating over it yields each `Patch` when finished; once more, only what the store has not.
    It pickles, with its lines unless they are in files: the process that reads it opens devices of
    the same names. One with a client does not, since the connection belongs to this process.

    Attributes
    ----------
    grid : Grid
        All of its pixels.
    patch_shape : (rows, columns)
        Pixels of a patch; those at the end may have fewer.
    shape : (rows, columns)
        Patches.
    finished : dict of (row, column) to Record
        Patches that the store has.
    """

    grid: Grid
    patch_shape: tuple[int, int]
    finished: dict[tuple[int, int], Record]
    _job: _Job
    _inputs: dict[str, Any]
    _sight: _Sight
    _source: RangeLines | Path
    _devices: tuple[Device, ...]
    _client: Client | None
    _idle_s: float | None

    def __getstate__(self) -> dict[str, Any]:
        """Return the fields to pickle; devices are opened anew by the process that reads them.

        Raises
        ------
        TypeError
            If the mosaic has a client, whose connection belongs to this process.
        """
        if self._client is not None:
            raise TypeError(
                "a mosaic with a client cannot be pickled, since its connection belongs to this "
                "process: make the mosaic where it is needed, with the same source and store"
            )
        return self.__dict__

    def __repr__(self) -> str:
        """Return the patches, how many of them are finished, the store and the extents."""
        store = self._job.store
        return reprs.summary(
            self,
            f"{reprs.by(self.shape)} patches of {reprs.by(self.patch_shape)} pixels",
            f"{len(self.finished)} of {len(self)} finished",
            None if store is None else f"store {str(store)!r}",
            reprs.extents(*self.grid.bounds_m),
        )

    @property
    def shape(self) -> tuple[int, int]:
        """Number of patches along rows and columns."""
        rows, columns = (
            math.ceil(n / m) for n, m in zip(self.grid.shape, self.patch_shape, strict=True)
        )
        return rows, columns

    def __len__(self) -> int:
        """Return the number of all patches."""
        return self.shape[0] * self.shape[1]

    def __iter__(self) -> Iterator[Patch]:
        """Form what is not finished and yield it, patch by patch.

        Raises
        ------
        OSError
            If the store cannot be written (a full disk); what is finished stays.
        ValueError
            What imaging one patch raises, with its place.
        """
        sight, survey, inputs = self._sight, self._sight.survey, self._inputs
        todo = [place for place in np.ndindex(self.shape) if place not in self.finished]
        # Of how many channels it is known that a patch, formed, has all it sees of them.
        known = {place: record.survey_channels for place, record in self.finished.items()}
        ended = self._idle_s is None
        last_news = time.monotonic()
        workers = max(min(len(self._devices), len(self)), 1)
        # One more than can work: what waits to be taken is held in memory. A cluster holds records.
        most = len(self) if self._client is not None else workers + 1
        executor = self._executor(workers)
        running: dict[Future, tuple[int, int]] = {}
        try:
            ready = self._ready(todo, sight, ended)
            while True:
                for place in ready[: max(most - len(running), 0)]:
                    ready.remove(place)
                    todo.remove(place)
                    with uninterrupted():
                        job, window = self._job_on(sight), self._window(*place)
                        running[executor.submit(_form, job, *window)] = place
                    known[place] = survey.channels
                if not running and not todo and ended:
                    return
                for future in wait(running or [Future()], None if ended and running else _POLL_S):
                    with uninterrupted():
                        place = running.pop(future)
                        record, formed = future.result()
                    if self._job.store is not None:
                        self.finished[place] = record
                    yield self._patch(place, record, formed)
                news = False
                if not ended:
                    last = has_ended(self._source)  # asked before looking: nothing comes after it
                    paths = files_of(self._source)
                    if paths != survey.parts:
                        before, survey = len(survey.parts), open_files(paths, survey)
                        sight, last_news = _Sight.of(survey, self._job.beam), time.monotonic()
                        inputs = self._grown(inputs, survey, before)
                        news = True
                    ended = last or time.monotonic() - last_news > self._idle_s
                    news |= ended
                # Patches that channels see which came after they were formed.
                for place in set(known) - set(running.values()) - set(todo):
                    if sight.sees_later(self._window(*place)[0], known[place]):
                        todo.append(place)
                        news = True
                    known[place] = survey.channels
                if news:
                    ready = self._ready(todo, sight, ended)
        finally:
            with uninterrupted():
                begun = {future for future in running if not future.cancel()}
            # Patches begun are finished here; workers may have been lost.
            left = begun if self._client is None else set()
            while left:
                left = left - wait(left)
            with uninterrupted():
                executor.shutdown(wait=self._client is None)
                if self._client is None and self._job.store is not None:
                    for future in begun:
                        if future.exception() is None:
                            self.finished[running[future]] = future.result()[0]

    def image(self, tell: Callable[[Patch], object] | None = None) -> Image:
        """Form what is not finished and return the whole image.

        Patches that the store held already are read from it. Those that no channel sees are zero.

        Parameters
        ----------
        tell : callable, optional
            Called with every patch once its pixels are in the image: those that the store held
            first, then the others as they are finished, again should they be formed again.

        Returns
        -------
        Image
            On all of `grid`. It takes 8 bytes per pixel of memory, beside that of the patches which
            are being formed.

        Raises
        ------
        OSError
            If the store cannot be read or written; what is finished stays.
        ValueError
            If the image does not fit into this machine's memory, or what imaging one patch raises,
            with its place.
        """
        if not (tell is None or callable(tell)):
            raise TypeError(f"tell must be a function or None, got {tell!r}")
        validate.memory("the mosaic", 8 * self.grid.size)
        stored = [self._patch(place, record, None) for place, record in self.finished.items()]
        pixels: NDArray[np.complex64] | None = None
        for patch in chain(stored, self):
            image = patch.image
            if image.pixels.shape == self.grid.shape:
                whole = image  # to copy its pixels takes as long as to form some
            else:
                if pixels is None:
                    pixels = np.empty(self.grid.shape, np.complex64)
                pixels[patch.rows, patch.columns] = image.pixels
            if tell is not None:
                tell(patch)
        return whole if pixels is None else Image(pixels, self.grid)

    def _job_on(self, sight: _Sight) -> _Job:
        """Return what patches have in common while a survey is what it is."""
        if self._client is None:
            return replace(self._job, sight_here=sight)
        return replace(self._job, files=_files(sight.survey))

    def _grown(self, inputs: dict[str, Any], survey: Survey, first: int) -> dict[str, Any]:
        """Keep in the store what the survey has grown by; return the inputs that it has now."""
        store = self._job.opened_store()
        if store is None:
            return inputs
        inputs = inputs | {"parts": [*inputs["parts"], *survey.digests(first)]}
        store.grow(inputs)
        return inputs

    def _window(self, row: int, column: int) -> tuple[Grid, int, int, slice, slice]:
        parts = []
        for index, side, most in zip((row, column), self.patch_shape, self.grid.shape, strict=True):
            parts.append(slice(index * side, min((index + 1) * side, most)))
        return self.grid.window(*parts), row, column, *parts

    def _patch(self, place: tuple[int, int], record: Record, formed: Image | None) -> Patch:
        grid, *where = self._window(*place)
        return Patch(*where, grid, record, formed, self._job.opened_store())

    def _ready(
        self, todo: Sequence[tuple[int, int]], sight: _Sight, ended: bool
    ) -> list[tuple[int, int]]:
        """Return patches that every channel which can see them has seen."""
        if ended:
            return list(todo)
        settled = sight.settled
        if settled < 1:
            return []
        return [p for p in todo if sight.has_passed(self._window(*p)[0], settled)]

    def _executor(self, workers: int) -> Executor:
        if self._client is not None:
            return self._client.get_executor(pure=False)
        # Every thread takes a device of its own.
        free: queue.SimpleQueue[Device] = queue.SimpleQueue()
        for device in self._devices:
            free.put(device)
        return ThreadPoolExecutor(
            workers, initializer=lambda: setattr(_LOCAL, "device", free.get())
        )


def mosaic(
    source: RangeLines | str | os.PathLike,
    grid: Grid,
    store: str | os.PathLike | None = None,
    *,
    tolerance_db: float | None = None,
    tolerance_wavelengths: float | None = None,
    stages: Sequence[tuple[int, int]] | None = None,
    accuracy_db: float | None = None,
    beam: BeamWindow | None = None,
    patches: tuple[int, int] | None = None,
    memory_bytes: int | None = None,
    device: Device | str | int | Sequence[Device | str | int] | None = None,
    client: Client | None = None,
    follow_s: float | None = None,
) -> Mosaic:
    """Form an image of any size patch by patch.

    Nothing is formed until the result is iterated over::

        for patch in clsas.mosaic("lines.h5", grid, "image.zarr", tolerance_db=-40):
            print(patch.row, patch.column, patch.record.predicted_error_db)

    Parameters
    ----------
    source : RangeLines or path
        Lines, a file of them, or a folder of such files (*.h5, in the order of their names), read
        by slices. Channels whose samples are not finite or all zero count as missing.
    grid : Grid
        A plane, a height map, or points with two axes.
    store : path, optional
        Zarr store to write, or to go on with: patches that it holds are not formed again. Needed
        with a `client`. See docs/mosaic.md for its layout.
    tolerance_db, tolerance_wavelengths, stages
        See `clsas.plan`. -50 dB unless anything is given.
    accuracy_db : float, optional
        Backproject every patch exactly, see `clsas.backproject`.
    beam : BeamWindow, optional
        Weights of the channels. Where its direction follows the track, all of the track counts,
        not only what a patch sees; in a folder, which may grow, `track_pings` is 101 unless given.
    patches : (rows, columns), optional
        Patches along either axis; those at the end may be smaller. Unless given they are as large
        as memory allows, up to 4096 x 4096 pixels.
    memory_bytes : int, optional
        What one patch may take on host and device together; 1 GiB unless given. Backprojected
        exactly it takes the device's buffers besides, of up to 1024 upsampled lines.
    device : Device, str or int, or a sequence of them, optional
        Devices that work side by side. Unless given, every GPU if there are several, else the one
        that `clsas.opencl.device.choose` chooses. Not with a `client`, whose workers each take one.
    client : distributed.Client, optional
        Let the workers of a Dask cluster form the patches. They must see `source` and `store`
        under the same paths.
    follow_s : float, optional
        Wait for files to be added to the folder `source`, until it holds a file named `end` or
        nothing was added for so many seconds. A patch is formed once the latest channels have
        it behind their beam, and again should later channels see it.

    Returns
    -------
    Mosaic
        To be iterated over, or asked for its image.

    Raises
    ------
    TypeError, ValueError
        If an argument is not what is allowed, files of a folder do not belong together, the memory
        holds not even the smallest patch, or `store` was made with other inputs (the
        message names what differs).
    FileFormatError, OSError
        If a file cannot be read or the store not written.
    ImportError
        If a store is wanted and Zarr is not installed.
    DeviceError
        If there is no such device.

    Notes
    -----
    Patches are formed independently; each differs from the exact image by no more than
    the tolerance, and so do neighbours along their border.
    """
    validate.instance("grid", grid, Grid)
    if len(grid.shape) != 2:
        raise ValueError(f"grid must have two axes for a mosaic, got shape {grid.shape}")
    given = (tolerance_db, tolerance_wavelengths, stages, accuracy_db)
    wish = {name: value for name, value in zip(WISHES, given, strict=True) if value is not None}
    if len(wish) > 1:
        raise ValueError(f"at most one of {', '.join(WISHES)} must be given, got {wish}")
    wish = wish or {"tolerance_db": TOLERANCE_DB}
    tolerance_in_db(tolerance_db, tolerance_wavelengths)
    if stages is not None:
        checked_pairs(stages)
    if accuracy_db is not None:
        validate.number("accuracy_db", accuracy_db, "dB", least=BEST_ACCURACY_DB, below=0.0)
    if beam is not None:
        validate.instance("beam", beam, BeamWindow)
    if patches is not None:
        patch_shape = patch_shape_of(patches, grid)
    if memory_bytes is None:
        memory_bytes = MEMORY_BYTES
    memory_bytes = validate.count("memory_bytes", memory_bytes)
    if not isinstance(source, RangeLines):
        validate.path("source", source)
    if client is not None and not hasattr(client, "get_executor"):
        raise TypeError(f"client must be a distributed.Client, got {client!r}")
    if client is not None and store is None:
        raise ValueError("store must be given with a client")
    if client is not None and isinstance(source, RangeLines):
        raise ValueError("source must be a path with a client, whose workers read it")
    if client is not None and device is not None:
        raise ValueError("device must be left out with a client: every worker takes one")
    follows = follow_s is not None
    if follows:
        follow_s = validate.positive("follow_s", follow_s, "s")
    folder = not isinstance(source, RangeLines) and Path(source).is_dir()
    if folder and beam is not None and beam.normalise:
        raise ValueError(
            "beam must not normalise with a folder, which may grow: its scale is that of all "
            "channels"
        )
    if follows and not folder:
        got = "lines in memory" if isinstance(source, RangeLines) else repr(str(source))
        raise ValueError(f"source must be a folder where follow_s is given, got {got}")
    if not isinstance(source, RangeLines):
        source = Path(source).resolve()
    devices = () if client is not None else _devices(device)
    if follows:
        _wait_for_first(source, follow_s)
    survey = open_survey(source)
    if folder and beam is not None and beam.along is None and beam.track_pings is None:
        beam = replace(beam, track_pings=MOST_TRACK_PINGS)
    sight = _Sight.of(survey, beam)
    opened = None if store is None else Store.at(store)
    inputs = {} if opened is None else inputs_of(survey, grid, wish, beam)
    if patches is None:
        stored = None if opened is None else opened.patch_shape
        patch_shape = stored or _choose_shape(sight, grid, memory_bytes)
    job = _Job(
        files=(),
        sight_here=None,
        wish=wish,
        beam=beam,
        memory_bytes=memory_bytes,
        store=None if opened is None else opened.path,
    )
    finished: dict[tuple[int, int], Record] = {}
    if opened is not None:
        opened.begin(inputs, grid, patch_shape)
        finished = _undamaged(opened)
    found = Mosaic(
        grid, patch_shape, finished, job, inputs, sight, source, devices, client, follow_s
    )
    for place, record in list(finished.items()):
        # Files that were added since may hold channels that see it.
        if sight.sees_later(found._window(*place)[0], record.survey_channels):
            del finished[place]
    return found


def _undamaged(store: Store) -> dict[tuple[int, int], Record]:
    """Return the records of a store's finished patches; warn of damaged ones."""
    damage = store.damage()
    if damage:
        validate.warn(
            f"{store.path} is damaged and these patches are formed again: {describe_damage(damage)}"
        )
    return {place: record for place, record in store.records().items() if place not in damage}


@dataclass(frozen=True, eq=False)
class _Job:
    """What every patch of a mosaic has in common; small, it travels with each.

    The survey is in this process, or to be opened from files where the patch is formed.
    """

    files: tuple[tuple[Path, tuple[int, int]], ...]
    sight_here: _Sight | None
    wish: dict[str, Any]
    beam: BeamWindow | None
    memory_bytes: int
    store: Path | None

    def accuracy_db(self, pairs: int) -> float | None:
        """Return how exactly to backproject so many pairs of pixel and channel, None to plan."""
        if "accuracy_db" in self.wish:
            return self.wish["accuracy_db"]
        if "stages" in self.wish or pairs > _WORTH_A_PLAN:
            return None
        return tolerance_in_db(*(self.wish.get(name) for name in WISHES[:2]))

    def sight(self) -> _Sight:
        """Return the survey; a worker opens it once per number of files."""
        if self.sight_here is not None:
            return self.sight_here
        with _OPENING:
            found = _opened(self.files, beam_json(self.beam))
        if found.survey.stamps != tuple(stamp for _, stamp in self.files):
            raise ValueError("source must not change while a mosaic is formed: a file of it did")
        return found

    def opened_store(self) -> Store | None:
        return None if self.store is None else Store.at(self.store)


@dataclass(frozen=True, eq=False)
class _Sight:
    """A survey, and what its channels see through a beam."""

    survey: Survey
    beam: BeamWindow | None
    along: NDArray[np.float64] | None
    phase_centres_m: NDArray[np.float64]

    @classmethod
    def of(cls, survey: Survey, beam: BeamWindow | None) -> _Sight:
        geometry = survey.geometry
        along = None if beam is None else beam.directions(geometry)
        return cls(survey, beam, along, geometry.phase_centres_m)

    @property
    def settled(self) -> int:
        """How many channels, from the first, will keep their direction when others come."""
        if self.beam is None:
            return 0  # any channel may see any patch
        if self.beam.along is not None:
            return self.survey.channels
        pings = self.survey.geometry.ping_starts
        later = self.beam.track_pings // 2 + 1
        return int(pings[-later]) if len(pings) > 2 * later else 0

    def ranges_m(self, grid: Grid) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the nearest and farthest range of a grid from every channel, at most."""
        centre_m, half_m = _box(grid)
        geometry = self.survey.geometry
        middle_m = bistatic_range_m(centre_m, geometry.tx_m, geometry.rx_m)
        radius_m = np.linalg.norm(np.abs(half_m).sum(axis=0))
        reach_m = np.full(len(middle_m), radius_m + 2 * geometry.range_step_m)
        if geometry.rx_velocity_m_s is not None:
            speed = np.linalg.norm(geometry.rx_velocity_m_s, axis=1) / geometry.sound_speed_m_s
            reach_m += 1.1 * speed * (middle_m + radius_m)
        return middle_m - reach_m, middle_m + reach_m

    def sees(self, grid: Grid) -> NDArray[np.bool_]:
        """Return which channels may contribute to a grid, [channels]."""
        seen = self.survey.within(*self.ranges_m(grid))
        if self.beam is not None:
            centre_m, half_m = _box(grid)
            seen &= touches_boxes(
                self.beam.limits, centre_m[None], half_m, self.phase_centres_m, self.along
            )[0]
        return seen

    def sees_later(self, grid: Grid, first: int) -> bool:
        """Return whether any channel from the first on may contribute to a grid."""
        return first < self.survey.channels and bool(self.sees(grid)[first:].any())

    def has_passed(self, grid: Grid, settled: int) -> bool:
        """Return whether the latest settled channels have a grid behind their beam."""
        if self.sees_later(grid, settled):
            return False
        centre_m, half_m = _box(grid)
        offset_m = centre_m - self.phase_centres_m[settled - 1]
        direction = self.along[settled - 1]
        extent_m = np.abs(half_m @ direction).sum()
        low, away_m = max(self.beam.limits[0], -1.0), np.linalg.norm(offset_m)
        radius_m = np.linalg.norm(np.abs(half_m).sum(axis=0))
        # Of a box's points the farthest passes last, with a beam that looks ahead the nearest.
        distance_m = away_m + radius_m if low < 0 else max(away_m - radius_m, 0.0)
        return bool(direction @ offset_m + extent_m < low * distance_m)


@lru_cache(maxsize=2)
def _opened(files: tuple[tuple[Path, tuple[int, int]], ...], beam: str | None) -> _Sight:
    # Of a survey that has grown only the new files are opened.
    before = next((s for s in _LATEST if files[: len(s.parts)] == _files(s)), None)
    survey = open_files(tuple(path for path, _ in files), before)
    _LATEST[:] = [survey]
    return _Sight.of(survey, None if beam is None else BeamWindow(**json.loads(beam)))


def _form(
    job: _Job, grid: Grid, row: int, column: int, rows: slice, columns: slice
) -> tuple[Record, Image | None]:
    """Form one patch, on whichever worker this is; return its image where no store has it."""
    try:
        record, image = _image(job, job.sight(), grid, _this_device(job))
    except ValueError as error:
        raise ValueError(f"patch {row},{column}: {error}") from error
    store = job.opened_store()
    if store is not None:
        store.write(row, column, rows, columns, image.pixels, record)
    return record, None if job.sight_here is None else image


def _image(job: _Job, sight: _Sight, grid: Grid, device: Device) -> tuple[Record, Image]:
    start = time.perf_counter()
    seen = sight.sees(grid)
    known = {"survey_channels": sight.survey.channels, "device": device.info.label}
    known |= {"driver": device.info.driver, "channels": int(np.count_nonzero(seen))}
    if not seen.any():
        return Record(**known, seconds=time.perf_counter() - start), _empty(grid)
    lines, missing = sight.survey.read(seen, *sight.ranges_m(grid))
    known |= {"missing_channels": int(np.count_nonzero(missing))}
    known |= {"gap_m": largest_gap_m(lines, missing), "read_seconds": time.perf_counter() - start}
    if missing.all():
        return Record(**known, seconds=time.perf_counter() - start), _empty(grid)
    along = None if job.beam is None else sight.along[seen]
    if missing.any():
        lines = lines.select(~missing)
        along = None if along is None else along[~missing]
    beam = None if job.beam is None else replace(job.beam, along=along)
    # A normalising beam multiplies by the number of channels: that of all.
    scale = sight.survey.channels / lines.channels if beam is not None and beam.normalise else 1.0
    host_bytes = _host_bytes(lines.channels, lines.length, grid.size)
    if host_bytes >= job.memory_bytes:
        raise ValueError(
            f"memory_bytes must be more than {host_bytes / 2**20:.1f} MiB for "
            f"{grid.shape[0]} x {grid.shape[1]} pixels from {lines.channels} lines of "
            f"{lines.length} samples, got {job.memory_bytes / 2**20:.1f} MiB: use smaller patches"
        )
    accuracy_db = job.accuracy_db(lines.channels * grid.size)
    if accuracy_db is not None:
        preparation = prepare(lines, grid, accuracy_db=accuracy_db, beam=beam, device=device)
        preparation.warn_of_ambiguity()
        image = execute(preparation)
        error_db = max(accuracy_db, preparation.predicted_error_db)
        known |= {"predicted_error_db": error_db, "memory_bytes": host_bytes}
    else:
        before = time.perf_counter()
        room = min(job.memory_bytes - host_bytes, device.info.memory_bytes // 2)
        chosen = plan(lines, grid, **job.wish, beam=beam, device=device, memory_bytes=room)
        known |= {
            "plan_seconds": time.perf_counter() - before,
            "predicted_error_db": chosen.predicted_error_db,
            "predicted_seconds": chosen.predicted_seconds,
            "memory_bytes": host_bytes + int(chosen.memory_bytes),
            "plan": json.loads(_without_directions(chosen).to_json()),
        }
        image = factorize(lines, grid, chosen, device=device)
    if scale != 1:
        image = Image(np.float32(scale) * image.pixels, grid)
    known |= {"has_pixels": holds_any(image.pixels), "seconds": time.perf_counter() - start}
    return Record(**known), image


def _empty(grid: Grid) -> Image:
    return Image(np.zeros(grid.shape, np.complex64), grid)


def _host_bytes(channels: int, length: int, pixels: int) -> int:
    """Return what lines and pixels of a patch take, with the copy of either that work makes."""
    return 2 * 8 * (channels * length + pixels)


def _choose_shape(sight: _Sight, grid: Grid, memory_bytes: int) -> tuple[int, int]:
    """Return the pixels of the largest patches that are expected to fit the memory."""
    side = _LARGEST_SIDE
    needed = 0
    while side >= _SMALLEST_SIDE:
        # As even as they can be.
        shape = tuple(math.ceil(n / math.ceil(n / side)) for n in grid.shape)
        most = 0
        for row in (0, grid.shape[0] - 1):
            start = [row // shape[0] * shape[0], grid.shape[1] // 2 // shape[1] * shape[1]]
            window = grid.window(*(slice(a, a + n) for a, n in zip(start, shape, strict=True)))
            seen = sight.sees(window)
            if seen.any():
                count, length = sight.survey.extent(seen, *sight.ranges_m(window))
                most = max(most, count * length)
        # Lines are upsampled and stages held on the device: about as much again, and half.
        needed = _host_bytes(1, most, shape[0] * shape[1]) + 12 * most + (64 << 20)
        if needed <= memory_bytes:
            return shape
        side //= 2
    raise ValueError(
        f"memory_bytes must be at least {needed / 2**20:.0f} MiB to choose patches by it, of "
        f"{shape[0]} x {shape[1]} pixels, got {memory_bytes / 2**20:.3g} MiB: give patches"
    )


def patch_shape_of(patches: tuple[int, int], grid: Grid) -> tuple[int, int]:
    """Return the pixels of a patch where a grid is divided into so many."""
    try:
        counts = tuple(validate.count("every entry of patches", n) for n in patches)
    except TypeError:
        raise TypeError(f"patches must be (rows, columns) of patches, got {patches!r}") from None
    if len(counts) != 2:
        raise ValueError(f"patches must be (rows, columns) of patches, got {patches!r}")
    shape = []
    for count, pixels in zip(counts, grid.shape, strict=True):
        side = math.ceil(pixels / count)
        if math.ceil(pixels / side) != count:
            less = math.ceil(pixels / side)
            raise ValueError(
                f"patches must leave each some of {pixels} pixels: {count} patches of {side} are "
                f"too many, {less} are enough"
            )
        shape.append(side)
    return shape[0], shape[1]


def _box(grid: Grid) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the middle of a box around a grid, and halves of its sides as vectors [n, 3]."""
    if grid.points_m is not None:
        low, high = (edge(grid.points_m, axis=(0, 1)) for edge in (np.min, np.max))
        return (low + high) / 2, np.diag((high - low) / 2)
    rows, columns = grid.shape
    half_m = np.array([grid.row_step_m * (rows - 1), grid.column_step_m * (columns - 1)]) / 2
    centre_m = grid.origin_m + half_m.sum(axis=0)
    if grid.height_m is None:
        return centre_m, half_m
    low, high = grid.height_m.min(), grid.height_m.max()
    up = np.array([0.0, 0.0, 1.0])
    return centre_m + up * (low + high) / 2, np.concatenate([half_m, [up * (high - low) / 2]])


def _without_directions(chosen: Plan) -> Plan:
    """Return a plan whose beam follows the track: directions of all channels are long."""
    if chosen.beam is None:
        return chosen
    return replace(chosen, beam=replace(chosen.beam, along=None))


def _files(survey: Survey) -> tuple[tuple[Path, tuple[int, int]], ...]:
    pairs = zip(survey.parts, survey.stamps, strict=True)
    return tuple((part, stamp) for part, stamp in pairs if isinstance(part, Path))


def _wait_for_first(source: Path, follow_s: float) -> None:
    start = time.monotonic()
    while not files_of(source):
        if has_ended(source) or time.monotonic() - start > follow_s:
            raise ValueError(f"source must hold range lines: {source} has no file *.h5")
        time.sleep(_POLL_S)


_CLAIMING = threading.Lock()


def _side_by_side() -> list[DeviceInfo]:
    """Return what works unless a device is asked for: every GPU of several, else what is chosen."""
    first, _ = choose()
    alike = [info for info in list_devices() if info.kind == first.kind == "gpu"]
    return [first] if len(alike) < 2 or os.environ.get(ENVIRONMENT_VARIABLE) else alike


def _devices(wish: Any) -> tuple[Device, ...]:
    """Return the devices to work on side by side."""
    if isinstance(wish, Sequence) and not isinstance(wish, (str, bytes)):
        if not wish:
            raise ValueError("device must name at least one device, got an empty sequence")
        found = tuple(open_device(each) for each in wish)
    elif wish is not None:
        found = (open_device(wish),)
    else:
        found = tuple(open_device(info.index) for info in _side_by_side())
    names = {device.info.index for device in found}
    if len(names) < len(found):
        named = ", ".join(device.info.label for device in found)
        raise ValueError(f"device must name each device once, got {named}")
    return found


def _this_device(job: _Job) -> Device:
    """Return the device of this thread, or of this worker's process, whose threads share it."""
    if job.sight_here is not None:
        return _LOCAL.device
    with _CLAIMING:
        return open_device(_claimed()[0].index)


@lru_cache(maxsize=1)
def _claimed() -> tuple[DeviceInfo, int | None]:
    """Return a device for this process, and the locked file that tells others on this machine.

    Of several devices each worker takes the next; where there are more workers, they share.
    """
    import fcntl

    devices = _side_by_side()
    for slot in range(_MOST_WORKERS):
        path = Path(tempfile.gettempdir()) / f"clsas-{os.getuid()}-worker-{slot}"
        with contextlib.suppress(OSError):  # another worker's, or another user's
            lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o600)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                os.close(lock)
                raise
            return devices[slot % len(devices)], lock
    return devices[0], None
