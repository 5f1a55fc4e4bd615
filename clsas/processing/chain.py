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
from clsas.engine.data.image import Image
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.validate import ClsasWarning
from clsas.engine.device.device import Device, open_device
from clsas.engine.signal.echoes import Echoes
from clsas.files.hdf5 import save
from clsas.files.json_types import json_able
from clsas.files.scene_files import SceneFile, read_scene
from clsas.files.scene_tables import CORRECTIONS, STEPS, checked_steps
from clsas.files.tables import located
from clsas.interferometry.checks import check_grid
from clsas.interferometry.result import Heights
from clsas.mosaics.store import Store
from clsas.processing.folders import check_folder, checked_records, folder_of, made
from clsas.processing.record import StepRecord, file_digest, step_digest, write_records
from clsas.processing.recording import Recording, loaded
from clsas.processing.steps import (
    RUN,
    TABLES,
    Job,
    Outcome,
    check_banks,
    check_pictures,
    is_mosaic,
    options_of,
    store_of,
)


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
            STEPS,
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
    heights continue a store instead.

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
    names = _with_corrections(chosen, of_scene)
    if {"focus", "pair_errors", "image", "heights", "mosaic"} & set(names):
        (grid,) = scene.need("grid")
        if "image" in names:
            validate.memory("[grid]", 16 * grid.size)  # two images
    of_banks = [name for name in ("pair_errors", "heights") if name in names]
    if of_banks:
        with _naming(scene, of_banks[0]):
            check_grid(grid)
    recording = Recording.of(scene, lines)
    folder = folder_of(scene, output)
    check_folder(folder, recording)
    check_pictures()
    with made(folder):
        records = checked_records(scene, folder, names)
        if not set(of_banks) <= records.keys():
            uncorrected = recording.read()  # which stays in memory for the first step
            if uncorrected.banks < 2:  # the step itself warns of more than two
                with _naming(scene, of_banks[0]):  # before other steps, which may take hours
                    check_banks(uncorrected)
        chain = _Chain(scene, folder, recording, open_device(device), records)
        for name in STEPS:
            if name in names:
                chain.step(name, None if progress is None else partial(progress, name))
            elif name in of_scene:
                chain.leave(name)
            else:
                chain.warn_if_outdated(name, "since the scene leaves it out")
    return Processed(folder, tuple(chain.done), tuple(chain.repeated), chain.lines)


def _with_corrections(chosen: tuple[str, ...], of_scene: tuple[str, ...]) -> tuple[str, ...]:
    """Return steps, with those of the scene that correct the lines before them."""
    # An inspection examines the uncorrected recording.
    last = max((STEPS.index(name) for name in chosen if name != "inspect"), default=0)
    before = {name for name in of_scene if name in CORRECTIONS and STEPS.index(name) < last}
    return tuple(name for name in STEPS if name in {*chosen, *before})


class _Chain:
    """State of a processing: the present lines, and the records of the steps so far."""

    def __init__(
        self,
        scene: SceneFile,
        folder: Path,
        recording: Recording,
        device: Device,
        records: dict[str, StepRecord],
    ) -> None:
        self.scene, self.folder, self.recording, self.device = scene, folder, recording, device
        self.records = dict(records)  # of all steps, including those that are left alone
        self.done: list[StepRecord] = []
        self.repeated: list[str] = []
        self.digest = recording.digest
        self.corrections: tuple[str, ...] = ()
        self.lines = recording.read

    def step(self, name: str, progress: Callable[[int, int], None] | None) -> None:
        """Run a step unless it ran before with the same inputs."""
        options = options_of(name, self.scene)
        digest = self._digest(name, options)
        record = self.records.get(name)
        # A mosaic always runs: it has its own records, and forms only the missing patches.
        kept = record is not None and record.inputs == digest and not is_mosaic(name, self.scene)
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
        """Skip a step of the scene, and warn if its files are out of date."""
        digest, record = self._digest(name, options_of(name, self.scene)), self.records.get(name)
        if record is not None and record.inputs != digest:
            self.warn_if_outdated(name, "since its lines or options have changed")
        if name in CORRECTIONS:
            self.digest = digest

    def warn_if_outdated(self, name: str, why: str) -> None:
        """Warn if the folder contains files of a step that no longer belong to the others."""
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
        lines = self.lines()  # raises for a damaged recording, before anything is written
        start = time.perf_counter()
        store = store_of(name, self.scene)
        with staging(self.folder) as staged:
            job = Job(
                scene=self.scene,
                folder=staged,
                store=store or self.folder / f"{name}.zarr",
                is_store_inside=store is None,
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
                inputs=digest,
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
        """Replace all files that a step wrote before by the new ones, and record them.

        After a crash in between, the record names files that are missing or old, so that the step
        runs again.
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
    """Return the outcome of a step and its ClsasWarnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", append=True)  # after the caller's filters
        with _naming(job.scene, name):
            outcome = RUN[name](job)
    messages = []
    for each in caught:
        if issubclass(each.category, ClsasWarning):
            messages.append(str(each.message))
        else:
            warnings.warn_explicit(each.message, each.category, each.filename, each.lineno)
    return outcome, tuple(dict.fromkeys(messages))  # images before and after share theirs


def _naming(scene: SceneFile, name: str) -> AbstractContextManager[None]:
    """Put the scene, a step and its table in front of errors."""
    return located(f"{scene.name or 'scene'}: {name} ({TABLES[name]}):")
