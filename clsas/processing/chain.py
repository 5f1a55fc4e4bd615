"""The chain from a recording to a focused image, step by step, each run only if it has to."""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from clsas.core import reprs, validate
from clsas.core.atomic import staging, sync_folder
from clsas.core.image import Image
from clsas.core.json_types import json_able
from clsas.core.lines import RangeLines
from clsas.core.validate import ClsasWarning
from clsas.files.hdf5 import save
from clsas.files.process_tables import CORRECTIONS, STEPS, checked_steps
from clsas.files.scene_files import SceneFile, read_scene
from clsas.opencl.device import Device, open_device
from clsas.processing.folders import check_folder, checked_records, folder_of, made
from clsas.processing.record import StepRecord, file_digest, step_digest, write_records
from clsas.processing.recording import Recording, loaded
from clsas.processing.steps import RUN, TABLES, Job, Outcome, check_pictures, options_of
from clsas.signal.echoes import Echoes


@dataclass(frozen=True, eq=False)
class Processed:
    """Results of a processing, in its folder.

    Attributes
    ----------
    folder : Path
        Holds the record `process.json`, and the files of every step.
    steps : tuple of StepRecord
        Records of the steps, in the order in which they ran.
    repeated : tuple of str
        Steps that were run; the others had been run before with the same inputs.
    """

    folder: Path
    steps: tuple[StepRecord, ...]
    repeated: tuple[str, ...]
    _lines: Callable[[], RangeLines]

    def __repr__(self) -> str:
        """Return the folder and the steps."""
        names = ", ".join(step.name for step in self.steps)
        return reprs.summary(self, repr(str(self.folder)), names)

    def __getitem__(self, name: str) -> StepRecord:
        """Return the record of a step; raises KeyError if it did not run."""
        return {step.name: step for step in self.steps}[name]

    @property
    def lines(self) -> RangeLines:
        """The lines as far as these steps corrected them, read from the folder.

        Raises ValueError if they changed since.
        """
        return self._lines()

    @property
    def image(self) -> Image:
        """The image, read from the folder.

        Raises KeyError without the step "image", and ValueError if the image changed since.
        """
        record = self["image"]
        return loaded(self.folder / record.result_file, record.files[record.result_file], Image)


def process(
    scene: str | os.PathLike | SceneFile,
    *,
    lines: RangeLines | Echoes | str | os.PathLike | None = None,
    output: str | os.PathLike | None = None,
    steps: Sequence[str] | None = None,
    device: Device | str | int | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> Processed:
    """Take a recording to a focused image: inspect, calibrate, navigate, focus, image, mosaic.

    Every step is recorded in the folder `output`, in `process.json`: its inputs and options, the
    version of clsas, its numbers, warnings and files. A step that ran before with the same inputs,
    options and version, and whose files are as they were written, is not run again. Files of a
    step appear together once it is done, and replace all that it wrote before.

    Parameters
    ----------
    scene : path-like or SceneFile
        Grid, image and the table `[process]`: docs/scene-files.md lists its keys.
    lines : RangeLines, Echoes or path-like, optional
        The recording, instead of the scene's. A path is any that `clsas.load` reads.
    output : path-like, optional
        Folder for the results, created if its parent is there. By default the scene's, else the
        name of the scene's file without its suffix. Only files of this scene's record are
        replaced.
    steps : sequence of str, optional
        Steps to bring up to date, instead of all of the scene's. They always run in the order
        above. Those of the scene that correct the lines before them are brought up to date first,
        so that a step always begins with the same lines; others are left alone.
    device : Device, str or int, optional
        See `clsas.opencl.device.choose`.
    progress : callable, optional
        Called as progress(step, steps done, steps).

    Returns
    -------
    Processed

    Raises
    ------
    TypeError, ValueError
        If an argument is of the wrong kind, the scene lacks what a step needs, the folder holds
        the results of another scene or files that clsas did not write and would replace, or a step
        refuses the lines, or the recording changes while it is processed. What was finished before
        is kept.
    OSError
        If a file cannot be read or written, or another process is at work in the folder
        (BlockingIOError).
    DeviceError
        If there is no such device.

    Warns
    -----
    ClsasWarning
        What the steps warn of. The record holds it too. If files of steps that were left alone
        belong to other lines or options.
    """
    if not isinstance(scene, SceneFile):
        scene = read_scene(validate.path("scene", scene))
    validate.progress(progress)
    of_scene = checked_steps(scene.process.get("steps"), scene.process)
    chosen = of_scene if steps is None else checked_steps(steps, scene.process)
    names = _with_corrections(chosen, of_scene)
    if {"focus", "image", "mosaic"} & set(names):
        (grid,) = scene.need("grid")
        if "image" in names:
            validate.memory("[grid]", 16 * grid.size)  # two images
    recording = Recording.of(scene, lines)
    folder = folder_of(scene, output)
    check_folder(folder, recording)
    check_pictures()
    with made(folder):
        records = checked_records(scene, folder, names)
        chain = _Chain(scene, folder, recording, open_device(device), records)
        for name in STEPS:
            if name in names:
                chain.step(name, None if progress is None else partial(progress, name))
            elif name in of_scene:
                chain.leave(name)
            else:
                chain.tell(name, "the scene leaves it out")
    return Processed(folder, tuple(chain.done), tuple(chain.repeated), chain.lines)


def _with_corrections(chosen: tuple[str, ...], of_scene: tuple[str, ...]) -> tuple[str, ...]:
    """Return steps, with those of the scene that correct the lines they begin with."""
    # An inspection looks at the recording as it came.
    last = max((STEPS.index(name) for name in chosen if name != "inspect"), default=0)
    before = {name for name in of_scene if name in CORRECTIONS and STEPS.index(name) < last}
    return tuple(name for name in STEPS if name in {*chosen, *before})


class _Chain:
    """A processing on its way."""

    def __init__(
        self,
        scene: SceneFile,
        folder: Path,
        recording: Recording,
        device: Device,
        records: dict[str, StepRecord],
    ) -> None:
        self.scene, self.folder, self.recording, self.device = scene, folder, recording, device
        self.records = dict(records)  # of all steps, also of those that are left alone
        self.done: list[StepRecord] = []
        self.repeated: list[str] = []
        self.digest = recording.digest
        self.corrections: tuple[str, ...] = ()
        self.lines = recording.read

    def step(self, name: str, progress: Callable[[int, int], None] | None) -> None:
        """Run a step, unless it ran before with the same inputs."""
        options = options_of(name, self.scene)
        digest = self._digest(name, options)
        record = self.records.get(name)
        # A mosaic has records of its own, patch by patch.
        kept = record is not None and record.digest == digest and name != "mosaic"
        messages: tuple[str, ...] = ()
        if record is None or not kept or not record.is_intact(self.folder):
            record = self._run(name, digest, options, progress)
            self.repeated.append(name)
            messages = record.warnings
        self.done.append(record)
        if name in CORRECTIONS:
            self.digest, self.corrections = digest, (*self.corrections, name)
            file = record.result_file
            self.lines = partial(loaded, self.folder / file, record.files[file], RangeLines)
        for message in messages:
            validate.warn(f"{name}: {message}")

    def leave(self, name: str) -> None:
        """Leave the files of a step of the scene alone."""
        digest, record = self._digest(name, options_of(name, self.scene)), self.records.get(name)
        if record is not None and record.digest != digest:
            self.tell(name, "its lines or options changed since")
        if name in CORRECTIONS:
            self.digest = digest

    def tell(self, name: str, why: str) -> None:
        """Warn of a step's files that are in the folder and do not belong to the other ones."""
        record = self.records.get(name)
        files = () if record is None else record.files
        if found := [each for each in files if (self.folder / each).exists()]:
            validate.warn(
                f"the results of {name} in {str(self.folder)!r} are out of date, {why}: "
                f"{', '.join(found)}"
            )

    def _digest(self, name: str, options: dict[str, Any]) -> str:
        return step_digest(name, options, self.recording.digest, self.digest)

    def _run(
        self,
        name: str,
        digest: str,
        options: dict[str, Any],
        progress: Callable[[int, int], None] | None,
    ) -> StepRecord:
        lines = self.lines()  # a damaged recording is refused before anything is written
        start = time.perf_counter()
        with staging(self.folder) as staged:
            job = Job(
                scene=self.scene,
                folder=staged,
                store=self.scene.mosaic.get("store") or self.folder / "mosaic.zarr",
                given=self.recording.read,
                lines=lines,
                corrections=self.corrections,
                device=self.device,
                progress=progress,
                former=self.records.get(name),
            )
            outcome, messages = _outcome(name, job)
            files = list(outcome.files)
            if outcome.lines is not None:
                save(staged / f"{name}.h5", outcome.lines)
                files.append(f"{name}.h5")
            record = StepRecord(
                name=name,
                digest=digest,
                lines=self.digest,
                corrections=self.corrections,
                options=json_able(options),
                numbers=json_able(outcome.numbers),
                files={each: file_digest(staged / each) for each in files},
                warnings=messages,
                seconds=time.perf_counter() - start,
                device=self.device.info.label,
            )
            self._keep(record, staged)
        return record

    def _keep(self, record: StepRecord, staged: Path) -> None:
        """Put a step's files in the place of all that it wrote before, and record them.

        A crash leaves a record whose files are missing or old: the step then runs again.
        """
        before = self.records.get(record.name)
        for name in set(() if before is None else before.files) - set(record.files):
            (self.folder / name).unlink(missing_ok=True)
        self.records[record.name] = record
        ordered = [self.records[name] for name in STEPS if name in self.records]
        write_records(self.folder, self.scene, self.recording.described, ordered)
        for name in record.files:
            (staged / name).replace(self.folder / name)
        sync_folder(self.folder)


def _outcome(name: str, job: Job) -> tuple[Outcome, tuple[str, ...]]:
    """Return the outcome of a step, and clsas's warnings; its errors get the step's name."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", append=True)  # after filters of the caller's
        try:
            outcome = RUN[name](job)
        except (TypeError, ValueError) as error:
            where = f"{job.scene.name or 'scene'}: {name} ({TABLES[name]})"
            kind = TypeError if isinstance(error, TypeError) else ValueError
            raise kind(f"{where}: {error}") from error
    messages = []
    for each in caught:
        if issubclass(each.category, ClsasWarning):
            messages.append(str(each.message))
        else:
            warnings.warn_explicit(each.message, each.category, each.filename, each.lineno)
    return outcome, tuple(messages)
