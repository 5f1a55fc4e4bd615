"""Chain of steps from a recording to a focused image, each of which runs only if it has to."""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Annotated, Any

from clsas.engine.data import reprs, validate
from clsas.engine.data.atomic import staging, sync_folder
from clsas.engine.data.declared import Names
from clsas.engine.data.digests import file_digest
from clsas.engine.data.extras import install_command, is_installed
from clsas.engine.data.image import Image
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.validate import ArgumentError, ClsasWarning
from clsas.engine.device.device import Device, open_device
from clsas.engine.signal.echoes import Echoes
from clsas.files.json_types import json_able
from clsas.files.scene_files import SceneFile, read_scene
from clsas.files.scene_tables import CORRECTIONS, STEP_NAMES, checked_steps
from clsas.files.tables import located
from clsas.interferometry.checks import check_grid
from clsas.interferometry.result import Heights
from clsas.mosaics.store import Store
from clsas.processing.record import (
    NAME,
    RecordingFile,
    StepRecord,
    checked_folder,
    loaded,
    made,
    read_records,
    step_digest,
    write_records,
)
from clsas.processing.steps import STEPS, Job, Step, both_banks, is_mosaic


@dataclass(frozen=True, eq=False)
class Processed:
    """Results of processing a recording, in a folder.

    Attributes
    ----------
    folder : Path
        Folder with the record `process.json` and the files of every step.
    steps : tuple of StepRecord
        Records of the steps, in the order in which they ran.
    repeated : tuple of str
        Steps that were run this time. The others had already been run with the same inputs.
    """

    folder: Path
    steps: tuple[StepRecord, ...]
    repeated: tuple[str, ...]
    _read_lines: Callable[[], RangeLines]

    def __repr__(self) -> str:
        """Return the folder and the names of the steps."""
        names = ", ".join(step.name for step in self.steps)
        return reprs.summary(self, repr(str(self.folder)), names)

    def __getitem__(self, name: str) -> StepRecord:
        """Return the record of a step; raise KeyError if it did not run."""
        return {step.name: step for step in self.steps}[name]

    @property
    def lines(self) -> RangeLines:
        """Lines with the corrections of these steps, read from the folder.

        Raises
        ------
        ValueError
            If the file has changed since it was written.
        """
        return self._read_lines()

    @cached_property
    def image(self) -> Image:
        """Image, read from the folder the first time.

        Raises
        ------
        KeyError
            If the step "image" did not run.
        ValueError
            If the file has changed since it was written.
        """
        return self._result("image", Image)

    @cached_property
    def heights(self) -> Heights:
        """Heights of the seabed, read the first time.

        They are read from the folder or, all of them, from the store of a mosaic.

        Raises
        ------
        KeyError
            If the step "heights" did not run.
        ValueError
            If the file has changed since it was written, or the mosaic is damaged or does not fit
            into memory.
        """
        record = self["heights"]
        if "store" not in record.numbers:
            return self._result("heights", Heights)
        # The folder may have moved, with the store inside.
        elsewhere = record.numbers["store"] if "store" in record.options else None
        return Store.opened(elsewhere or self.folder / "heights.zarr").heights()

    def _result(self, name: str, kind: type) -> Any:
        record = self[name]
        return loaded(self.folder / record.result_file, record.files[record.result_file], kind)


def process(
    scene: str | os.PathLike | SceneFile,
    *,
    lines: RangeLines | Echoes | str | os.PathLike | None = None,
    output: str | os.PathLike | None = None,
    steps: Annotated[
        Sequence[str] | None,
        Names(
            STEP_NAMES,
            help="Bring only this step up to date, and the steps before it that correct its lines.",
        ),
    ] = None,
    device: Device | str | int | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> Processed:
    """Return the results of processing a recording to a focused image.

    The steps are inspect, calibrate, navigate, focus, pair_errors, image, heights and mosaic. Every
    step is recorded in `process.json` in the folder `output`: its inputs and options, the version
    of clsas, its numbers, warnings and files. A step is not run again if it ran before with the
    same inputs, options and version, and its files have not changed. The files of a step appear
    together once it is done, and replace all files that it wrote before. Mosaics of images and of
    heights continue a store instead. `clsas.export` makes maps of the results.

    Parameters
    ----------
    scene : path-like or SceneFile
        Scene with the grid, the image and the table `[process]`. docs/scene-files.md lists its
        keys.
    lines : RangeLines, Echoes or path-like, optional
        Recording to process instead of that of the scene. A path may lead to any file that
        `clsas.load` reads.
    output : path-like, optional
        Folder for the results, created if its parent exists. The default is the folder that the
        scene specifies, or else the path of the scene file without its suffix. Only files that the
        record of this scene names are replaced.
    steps : sequence of str, optional
        Steps to bring up to date instead of all steps of the scene. They always run in the order
        above. The preceding steps of the scene that correct the lines are brought up to date first,
        so that a step always starts from the same lines. Other steps are left alone.
    device : Device, str or int, optional
        See `clsas.engine.device.device.choose`.
    progress : callable, optional
        Called as progress(step, done, total), with the name of a step and its progress.

    Returns
    -------
    Processed

    Raises
    ------
    TypeError, ValueError
        If an argument is of the wrong kind, if the scene lacks something that a step needs, if the
        folder contains the results of another scene or files that clsas did not write and would
        replace, if a step refuses the lines, or if the recording changes while it is processed.
        The results of finished steps are kept.
    OSError
        If a file cannot be read or written, or another process is using the folder
        (BlockingIOError).
    DeviceError
        If there is no such device.

    Warns
    -----
    ClsasWarning
        If a step warns; its record contains the warning too. Also if files of steps that were left
        alone belong to other lines or options.

    See Also
    --------
    Processed : The results.

    Examples
    --------
    >>> import clsas
    >>> found = clsas.process("scene.toml", steps=["inspect", "image"])  # doctest: +SKIP
    >>> found["image"].numbers["contrast"]  # doctest: +SKIP
    """
    if not isinstance(scene, SceneFile):
        scene = read_scene(validate.path("scene", scene))
    validate.progress(progress)
    of_scene = checked_steps(scene.process.get("steps"), scene.process)
    chosen = of_scene if steps is None else checked_steps(steps, scene.process)
    # Every step but an inspection starts from lines with the scene's corrections before it.
    last = max((STEP_NAMES.index(name) for name in chosen if name != "inspect"), default=0)
    before = [name for name in STEP_NAMES[:last] if name in CORRECTIONS and name in of_scene]
    names = tuple(name for name in STEP_NAMES if name in (*chosen, *before))

    # Mistakes are found before any step, since steps may take hours.
    if {"focus", "pair_errors", "image", "heights", "mosaic"} & set(names):
        (grid,) = scene.need("grid")
        if "image" in names:
            validate.memory("[grid]", 16 * grid.size)  # two images
    of_banks = [name for name in ("pair_errors", "heights") if name in names]
    if of_banks:
        with _naming(scene, STEPS[of_banks[0]]):
            check_grid(grid)
    recording = RecordingFile.of(scene, lines)
    folder = checked_folder(scene, output, recording)
    if not is_installed("matplotlib"):
        validate.warn(
            f"no pictures are written, since they need matplotlib: {install_command('plot')}"
        )
    with made(folder):
        records = _checked_records(scene, folder, names)
        if not set(of_banks) <= records.keys():
            uncorrected = recording.read()  # which stays in memory for the first step
            if uncorrected.banks < 2:  # the step itself warns of more than two
                with _naming(scene, STEPS[of_banks[0]]):
                    both_banks(uncorrected)
        return _run_steps(
            names, of_scene, scene, folder, recording, records, open_device(device), progress
        )


def _checked_records(
    scene: SceneFile, folder: Path, names: tuple[str, ...]
) -> dict[str, StepRecord]:
    """Return the records of the folder after checking that steps replace only their own files.

    A damaged record is replaced by one without inputs, so that its step runs again and may replace
    the files that it may have written.
    """
    records, is_damaged = read_records(folder, scene)
    if is_damaged:
        lost = [step for step in STEPS.values() if step.name not in records]
        for step in lost:
            if found := [file for file in step.files if os.path.lexists(folder / file)]:
                records[step.name] = StepRecord(step.name, "", files=dict.fromkeys(found, ""))
        again = [step.name for step in lost if step.name in (*records, *names)]
        validate.warn(f"{folder / NAME} is damaged; these steps are run again: {', '.join(again)}")
    own = {file for record in records.values() for file in record.files}
    for name in names:
        for file in STEPS[name].files:
            if file not in own and os.path.lexists(folder / file):
                raise ArgumentError(
                    "output",
                    f"not contain {file}, which {name} would replace and clsas did not write",
                    repr(str(folder)),
                    "choose another folder, or remove the file",
                )
    return records


def _run_steps(
    names: tuple[str, ...],
    of_scene: tuple[str, ...],
    scene: SceneFile,
    folder: Path,
    recording: RecordingFile,
    records: dict[str, StepRecord],
    device: Device,
    progress: Callable[[str, int, int], None] | None,
) -> Processed:
    """Run the named steps unless they ran before with the same inputs; leave the others alone."""
    read, lines_digest = recording.read, recording.digest  # with the corrections so far
    corrections: tuple[str, ...] = ()
    done: list[StepRecord] = []
    repeated: list[str] = []
    for name, step in STEPS.items():
        record = records.get(name)
        if name not in (*names, *of_scene):
            _warn_if_outdated(folder, record, "since the scene leaves it out")
            continue
        options = step.options(scene)
        inputs = step_digest(name, options, recording.digest, lines_digest)
        is_same = record is not None and record.inputs == inputs
        if name not in names:
            if not is_same:
                _warn_if_outdated(folder, record, "since its lines or options have changed")
            if name in CORRECTIONS:
                lines_digest = inputs
            continue

        # A mosaic always runs: it has its own records, and forms only the missing patches.
        messages: tuple[str, ...] = ()
        if record is None or not is_same or is_mosaic(name, scene) or not record.is_intact(folder):
            lines = read()  # raises for a damaged recording, before anything is written
            with staging(folder) as staged:
                job = Job(
                    scene=scene,
                    staged=staged,
                    output=folder,
                    given=recording.read,
                    lines=lines,
                    corrections=corrections,
                    device=device,
                    progress=None if progress is None else partial(progress, name),
                    former=record,
                )
                new = _run_step(step, job, options, inputs, lines_digest)
                # After a crash in between, the record names files that are missing or old, so that
                # the step runs again.
                for file in set(() if record is None else record.files) - set(new.files):
                    (folder / file).unlink(missing_ok=True)
                records[name] = record = new
                ordered = [records[each] for each in STEPS if each in records]
                write_records(folder, scene, recording.described, ordered)
                for file in record.files:
                    (staged / file).replace(folder / file)
                sync_folder(folder)
            messages = record.warnings
            repeated.append(name)
        done.append(record)
        if name in CORRECTIONS:
            lines_digest, corrections = inputs, (*corrections, name)
            file = record.result_file
            read = partial(loaded, folder / file, record.files[file], RangeLines)
        for message in messages:
            validate.warn(f"{name}: {message}")
    return Processed(folder, tuple(done), tuple(repeated), read)


def _run_step(
    step: Step, job: Job, options: dict[str, Any], inputs: str, lines_digest: str
) -> StepRecord:
    """Run a step, and return its record with its ClsasWarnings; other warnings are issued."""
    start = time.perf_counter()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", append=True)  # after the caller's filters
        with _naming(job.scene, step):
            numbers = step.run(job)
    messages = []
    for each in caught:
        if issubclass(each.category, ClsasWarning):
            messages.append(str(each.message))
        else:
            warnings.warn_explicit(each.message, each.category, each.filename, each.lineno)
    files = [file for file in step.files if (job.staged / file).exists()]
    return StepRecord(
        name=step.name,
        inputs=inputs,
        lines=lines_digest,
        corrections=job.corrections,
        options=json_able(options),
        numbers=json_able(numbers),
        files={file: file_digest(job.staged / file) for file in files},
        warnings=tuple(dict.fromkeys(messages)),  # images before and after share theirs
        seconds=time.perf_counter() - start,
        device=job.device.info.label,
    )


def _warn_if_outdated(folder: Path, record: StepRecord | None, why: str) -> None:
    """Warn if the folder contains files of a step that no longer belong to the others."""
    if record is None:
        return
    if found := [file for file in record.files if (folder / file).exists()]:
        validate.warn(
            f"the results of {record.name} in {str(folder)!r} are out of date, {why}: "
            f"{', '.join(found)}"
        )


def _naming(scene: SceneFile, step: Step) -> AbstractContextManager[None]:
    """Put the scene, a step and its table in front of errors."""
    return located(f"{scene.name or 'scene'}: {step.name} ({step.table}):")
