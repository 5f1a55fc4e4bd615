"""Order in which patches are formed, also while files are added to the survey."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Executor, Future
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.image import Image
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.threads import uninterrupted, wait
from clsas.engine.data.validate import ArgumentError
from clsas.engine.device.device import Device
from clsas.mosaics.devices import device_threads
from clsas.mosaics.patches import Layout, PatchWindow
from clsas.mosaics.record import PatchIndex, Record
from clsas.mosaics.store import Store
from clsas.mosaics.survey import files_of, has_ended, open_files
from clsas.mosaics.visibility import SurveyVisibility

if TYPE_CHECKING:
    from distributed import Client

POLL_S = 0.5
"""Seconds between searches for new files of a survey: a plain choice."""

_MOST_ON_CLUSTER = 1000  # patches submitted at once: enough for any cluster, few to wait for

Formed = tuple[PatchIndex, Record, Image | None]


@dataclass(frozen=True)
class Growth:
    """Folder to which files of a survey are being added.

    Attributes
    ----------
    folder : Path
    idle_s : float
        Seconds without a new file after which the survey has ended.
    at_end : callable, optional
        Called with the geometry of the survey when it has ended.
    """

    folder: Path
    idle_s: float
    at_end: Callable[[RangeLines], object] | None = None


class PatchJob(Protocol):
    """Settings by which patches are formed: `clsas.mosaics.forming.Job`, or those of heights."""

    @property
    def store(self) -> Path | None:
        """The store."""

    @property
    def beam(self) -> BeamWindow | None:
        """Weights of the channels."""

    def on(self, visibility: SurveyVisibility, in_process: bool) -> PatchJob:
        """Return the settings with the present survey."""

    def form(self, window: PatchWindow) -> tuple[Record, Image | None]:
        """Form a patch and write it to the store."""

    def opened_store(self) -> Store | None:
        """Return the store, or None if there is none."""

    def complete(self) -> None:
        """Compute what depends on several patches, once all are finished."""


@dataclass(frozen=True, eq=False)
class Run:
    """Everything needed to form a mosaic.

    Attributes
    ----------
    layout : Layout
    job : PatchJob
        Settings of the patches, still without the survey.
    inputs : dict
        Inputs of the mosaic, as stored with it.
    visibility : SurveyVisibility
        The survey when the mosaic was requested.
    devices : tuple of Device
        Devices of this process; empty with a client.
    client : distributed.Client or None
    growth : Growth or None
        None if no files are to be added.
    """

    layout: Layout
    job: PatchJob
    inputs: dict[str, Any]
    visibility: SurveyVisibility
    devices: tuple[Device, ...]
    client: Client | None
    growth: Growth | None

    @property
    def workers(self) -> int:
        """Number of threads in this process."""
        return max(min(len(self.devices), len(self.layout)), 1)

    @property
    def most_running(self) -> int:
        """Largest number of patches that are submitted at once.

        In this process it is one more than there are workers, since finished patches stay in memory
        until they are taken. A cluster returns only records.
        """
        return _MOST_ON_CLUSTER if self.client is not None else self.workers + 1

    def executor(self) -> Executor:
        """Return the threads of this process, or the workers of the cluster."""
        if self.client is not None:
            return self.client.get_executor(pure=False)
        return device_threads(self.workers, self.devices)


class _GrowingSurvey:
    """A survey to which files may be added.

    Attributes
    ----------
    visibility : SurveyVisibility
        The survey at present.
    has_ended : bool
        True once no more files will come.
    """

    def __init__(self, run: Run) -> None:
        self._run = run
        self._inputs = run.inputs
        self._latest_s = time.monotonic()
        self.visibility = run.visibility
        self.has_ended = run.growth is None

    @property
    def channels(self) -> int:
        return self.visibility.survey.channels

    def update(self) -> bool:
        """Look for new files; return whether any came or the survey has ended."""
        growth = self._run.growth
        if growth is None or self.has_ended:
            return False
        # Ask before listing the files, since none is added after the end.
        ended = has_ended(growth.folder)
        paths, survey = files_of(growth.folder), self.visibility.survey
        grown = paths != survey.files
        if grown:
            first = len(survey.parts)
            survey = open_files(paths, survey)
            self.visibility = SurveyVisibility.of(survey, self._run.job.beam)
            self._latest_s = time.monotonic()
            store = self._run.job.opened_store()
            if store is not None:
                parts = [*self._inputs["parts"], *survey.digests(first)]
                self._inputs = self._inputs | {"parts": parts}
                store.grow(self._inputs)
        self.has_ended = ended or time.monotonic() - self._latest_s > growth.idle_s
        if self.has_ended and growth.at_end is not None:
            growth.at_end(self.visibility.survey.geometry)
        return grown or self.has_ended

    def ready(self, todo: Iterable[PatchIndex]) -> deque[PatchIndex]:
        """Return the patches whose channels have all been recorded, in the given order."""
        if self.has_ended:
            return deque(todo)
        settled = self.visibility.settled
        if settled < 1:
            return deque()
        layout = self._run.layout
        return deque(i for i in todo if self.visibility.has_passed(layout.window(i).grid, settled))


def form_patches(run: Run, finished: dict[PatchIndex, Record]) -> Generator[Formed, None, None]:
    """Form the patches that are not finished, and yield each with its record and image.

    The image is None if another process formed it. With a store, `finished` is kept up to date. If
    the caller stops early, patches that have been started are still completed in the store.
    """
    survey, layout, store = _GrowingSurvey(run), run.layout, run.job.store
    todo = dict.fromkeys(index for index in layout.indices() if index not in finished)
    # For every patch, the number of channels in the survey when it was last formed or checked.
    known = {index: record.survey_channels for index, record in finished.items()}
    checked = survey.channels  # when all patches were last checked
    executor = run.executor()
    running: dict[Future, PatchIndex] = {}
    try:
        ready = survey.ready(todo)
        while True:
            while ready and len(running) < run.most_running:
                index = ready.popleft()
                del todo[index]
                with uninterrupted():
                    job = run.job.on(survey.visibility, run.client is None)
                    running[executor.submit(job.form, layout.window(index))] = index
                known[index] = survey.channels
            if not running and not todo and survey.has_ended:
                run.job.complete()
                return
            timeout_s = None if survey.has_ended and running else POLL_S
            done = wait(running or [Future()], timeout_s)
            latest = [index for future, index in running.items() if future in done]
            for future in [future for future in running if future in done]:
                with uninterrupted():
                    index = running.pop(future)
                    record, image = future.result()
                if store is not None:
                    finished[index] = record
                yield index, record, image
            news = survey.update()
            # Form patches again if channels that were added later contribute to them. A patch that
            # is running is checked when it is finished.
            busy = set(running.values())
            for index in known if survey.channels > checked else latest:
                if known[index] >= survey.channels or index in busy or index in todo:
                    continue
                if survey.visibility.any_channel_from(known[index], layout.window(index).grid):
                    todo[index] = None
                    news = True
                known[index] = survey.channels
            checked = survey.channels
            if news:
                ready = survey.ready(todo)
    finally:
        with uninterrupted():
            begun = {future for future in running if not future.cancel()}
        # Wait for patches that this process's threads have begun. A cluster may be gone by now.
        left = begun if run.client is None else set()
        while left:
            left = left - wait(left)
        with uninterrupted():
            executor.shutdown(wait=run.client is None)
            if run.client is None and store is not None:
                for future in begun:
                    if future.exception() is None:
                        finished[running[future]] = future.result()[0]


def wait_for_first_file(growth: Growth) -> None:
    """Wait for the first file of a folder; raise ValueError if none comes."""
    start, folder = time.monotonic(), growth.folder
    while not files_of(folder):
        if has_ended(folder) or time.monotonic() - start > growth.idle_s:
            raise ArgumentError(
                "source", "contain range lines", f"{folder}, which has no file *.h5"
            )
        time.sleep(POLL_S)
