"""The chain from a recording to a focused image, step by step, each run only if it has to."""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from clsas.core import reprs, validate
from clsas.core.image import Image
from clsas.core.json_types import json_able
from clsas.core.lines import RangeLines
from clsas.core.validate import ClsasWarning
from clsas.files.formats import load
from clsas.files.hdf5 import save
from clsas.files.process_tables import checked_steps
from clsas.files.scene_files import SceneFile, read_scene
from clsas.opencl.device import Device, open_device
from clsas.processing.record import (
    StepRecord,
    contents_digest,
    file_digest,
    read_records,
    step_digest,
    write_records,
)
from clsas.processing.steps import RUN, Job, check_pictures, options_of
from clsas.signal.compression import compress
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
        """The lines as far as they are corrected, read from the folder."""
        return self._lines()

    @property
    def image(self) -> Image:
        """The image, read from the folder; raises KeyError without the step "image"."""
        self["image"]
        image = load(self.folder / "image.h5")
        validate.instance("image.h5", image, Image)
        assert isinstance(image, Image)  # for type checkers
        return image


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
    options and version, and whose files are as they were written, is not run again.

    Parameters
    ----------
    scene : path-like or SceneFile
        Grid, image and the table `[process]`: docs/scene-files.md lists its keys.
    lines : RangeLines, Echoes or path-like, optional
        The recording, instead of the scene's. A path is any that `clsas.load` reads.
    output : path-like, optional
        Folder for the results, created if its parent is there. By default the scene's, else the
        name of the scene's file without its suffix.
    steps : sequence of str, optional
        Steps to run, instead of the scene's. They always run in the order above.
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
        If an argument is of the wrong kind, the scene lacks what a step needs, or a step refuses
        the lines. What was finished before is kept.
    OSError
        If a file cannot be read or written.
    DeviceError
        If there is no such device.

    Warns
    -----
    ClsasWarning
        What the steps warn of. The record holds it too.
    """
    if not isinstance(scene, SceneFile):
        scene = read_scene(validate.path("scene", scene))
    validate.progress(progress)
    chosen = steps if steps is not None else scene.process.get("steps")
    names = checked_steps(chosen, scene.process)
    if {"focus", "image", "mosaic"} & set(names):
        (grid,) = scene.need("grid")
        if "image" in names:
            validate.memory("[grid]", 16 * grid.size)  # two images
    recording = _Recording.of(scene, lines)
    folder = _folder(scene, output)
    _check_apart(recording, folder)
    folder.mkdir(exist_ok=True)
    check_pictures()
    chain = _Chain(scene, folder, recording, open_device(device))
    for name in names:
        chain.step(name, None if progress is None else partial(progress, name))
    return Processed(folder, tuple(chain.records), tuple(chain.repeated), chain.lines)


class _Chain:
    """A processing on its way."""

    def __init__(
        self, scene: SceneFile, folder: Path, recording: _Recording, device: Device
    ) -> None:
        self.scene, self.folder, self.recording, self.device = scene, folder, recording, device
        self.before = read_records(folder)
        self.records: list[StepRecord] = []
        self.repeated: list[str] = []
        self.digest = recording.digest
        self.lines: Callable[[], RangeLines] = lambda: recording.lines

    def step(self, name: str, progress: Callable[[int, int], None] | None) -> None:
        """Run a step, unless it ran before with the same inputs."""
        options = options_of(name, self.scene)
        digest = step_digest(name, options, self.recording.digest, self.digest)
        record = self.before.get(name)
        # A mosaic has records of its own, patch by patch.
        kept = record is not None and record.digest == digest and name != "mosaic"
        messages: tuple[str, ...] = ()
        if record is None or not kept or not record.is_intact(self.folder):
            record = self._run(name, digest, options, progress)
            self.repeated.append(name)
            messages = record.warnings
        self.records.append(record)
        if (corrected := f"{name}.h5") in record.files and name != "image":
            self.digest, path = digest, self.folder / corrected
            self.lines = lambda: _loaded(path)
        write_records(self.folder, self.scene.name, self.recording.described, self.records)
        for message in messages:
            validate.warn(f"{name}: {message}")

    def _run(
        self,
        name: str,
        digest: str,
        options: dict[str, Any],
        progress: Callable[[int, int], None] | None,
    ) -> StepRecord:
        job = Job(
            self.scene, self.folder, lambda: self.recording.lines, self.lines, self.device, progress
        )
        start = time.perf_counter()
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            outcome = RUN[name](job)
        messages = []
        for each in caught:
            if issubclass(each.category, ClsasWarning):
                messages.append(str(each.message))
            else:
                warnings.warn_explicit(each.message, each.category, each.filename, each.lineno)
        files = list(outcome.files)
        if outcome.lines is not None:
            save(self.folder / f"{name}.h5", outcome.lines)
            files.append(f"{name}.h5")
        return StepRecord(
            name=name,
            digest=digest,
            options=json_able(options),
            numbers=json_able(outcome.numbers),
            files={each: file_digest(self.folder / each) for each in files},
            warnings=tuple(messages),
            seconds=time.perf_counter() - start,
            device=self.device.info.label,
        )


@dataclass(frozen=True, eq=False)
class _Recording:
    """The lines to begin with, read when they are needed.

    Attributes
    ----------
    described : dict
        What the record says of them.
    digest : str
        Of their contents, and how echoes are compressed.
    """

    described: dict[str, Any]
    digest: str
    _read: Callable[[], RangeLines | Echoes]
    _compression: dict[str, Any]

    @classmethod
    def of(
        cls, scene: SceneFile, given: RangeLines | Echoes | str | os.PathLike | None
    ) -> _Recording:
        """Return the recording given, or that of the scene."""
        options = scene.compress
        if isinstance(given, Echoes):
            given = compress(given, **options)
        if isinstance(given, RangeLines):
            lines, digest = given, contents_digest(given)
            return cls({"file": None, "digest": digest}, digest, lambda: lines, options)
        path = scene.process.get("lines") if given is None else validate.path("lines", given)
        if path is None:
            raise ValueError(
                f"{scene.name}: missing key 'lines' in [process], the recording to process"
            )
        digest = file_digest(path)
        of_both = step_digest("recording", options, digest)
        return cls({"file": str(path), "digest": digest}, of_both, partial(_any, path), options)

    @cached_property
    def lines(self) -> RangeLines:
        """The lines; those of echoes are compressed."""
        read = self._read()
        return compress(read, **self._compression) if isinstance(read, Echoes) else read


def _any(path: Path) -> RangeLines | Echoes:
    found = load(path)
    if not isinstance(found, (RangeLines, Echoes)):
        raise ValueError(f"{path} must hold RangeLines or Echoes, got {type(found).__name__}")
    return found


def _loaded(path: Path) -> RangeLines:
    lines = _any(path)
    validate.instance(str(path), lines, RangeLines)
    assert isinstance(lines, RangeLines)  # for type checkers
    return lines


def _folder(scene: SceneFile, output: str | os.PathLike | None) -> Path:
    if output is not None:
        return validate.path("output", output)
    if "output" in scene.process:
        return scene.process["output"]
    if not Path(scene.name).suffix:
        raise ValueError("output must be given: the scene has no file that names a folder")
    return Path(scene.name).with_suffix("")


def _check_apart(recording: _Recording, folder: Path) -> None:
    """Refuse a recording that a step could overwrite."""
    file = recording.described["file"]
    if file is not None and Path(file).parent.resolve() == folder.resolve():
        raise ValueError(f"output must not be the folder of the recording, got {str(folder)!r}")
