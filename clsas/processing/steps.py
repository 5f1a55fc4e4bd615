"""Steps of a processing. Each takes lines and writes its results into the folder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from clsas import plot
from clsas.engine.data import validate
from clsas.engine.data.atomic import replacing, staging
from clsas.engine.data.digests import digest
from clsas.engine.data.extras import install_command, is_installed
from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Image
from clsas.engine.data.lines import RangeLines, banks_of, first_two_banks
from clsas.engine.data.validate import ArgumentError
from clsas.engine.device.device import Device
from clsas.engine.factorized.planner import TOLERANCE_DB
from clsas.engine.imaging import backproject, factorize, plan
from clsas.files.hdf5 import save
from clsas.files.scene_files import SceneFile
from clsas.files.scene_tables import CORRECTIONS, EXACT_KEYS
from clsas.files.tables import located
from clsas.inspection.inspection import inspect
from clsas.interferometry.heights import heights
from clsas.interferometry.pair_errors import pair_errors
from clsas.interferometry.pair_errors_result import with_bank
from clsas.interferometry.result import Heights
from clsas.mosaics.document import OtherInputsError, stored_digest
from clsas.mosaics.height_mosaic import mosaic_heights
from clsas.mosaics.mosaic import Mosaic, mosaic
from clsas.mosaics.store import Store
from clsas.navigation.autofocus import autofocus
from clsas.navigation.calibration import calibrate_track
from clsas.navigation.micronavigation import micronavigate
from clsas.processing import numbers
from clsas.processing.record import StepRecord
from clsas.processing.tracks import csv_of_track

_Begun = TypeVar("_Begun", Mosaic, Store)

Progress = Callable[[int, int], None] | None


@dataclass(frozen=True, eq=False)
class Job:
    """Inputs of a step.

    Attributes
    ----------
    scene : SceneFile
    folder : Path
        Folder for the step's files, from which they are moved once the step is done.
    store : Path
        Store of a mosaic of images or heights, which is continued if it exists.
    is_store_inside : bool
        True if it has its default place in the folder of the processing.
    given : Callable
        Returns the uncorrected lines of the recording.
    lines : RangeLines
        Lines with the corrections so far.
    corrections : tuple of str
        Steps that corrected the lines.
    device : Device
    progress : Progress
    former : StepRecord or None
        Record of the last run of the step.
    """

    scene: SceneFile
    folder: Path
    store: Path
    is_store_inside: bool
    given: Callable[[], RangeLines]
    lines: RangeLines
    corrections: tuple[str, ...]
    device: Device
    progress: Progress
    former: StepRecord | None

    def options(self, step: str) -> dict[str, Any]:
        """Return the scene's options of a step."""
        return dict(self.scene.process.get(step, {}))

    def of_bank(self, lines: RangeLines) -> RangeLines:
        """Return the lines of the receiver bank that is imaged: the scene's, or else the first."""
        banks = banks_of(lines.bank_numbers)
        with located("[process]"):
            chosen = validate.one_of("bank", self.scene.process.get("bank", banks[0]), banks)
        return lines.bank(chosen)

    @property
    def title(self) -> str:
        """Title of pictures, with the steps that corrected the lines.

        The folder may still have lines of steps that the scene now leaves out.
        """
        if not self.corrections:
            return "Uncorrected recording"
        return f"After {', '.join(self.corrections)}"

    def draw(self, name: str, draw: Callable[[], Any]) -> list[str]:
        """Write a picture and return a list of its name; the list is empty without matplotlib."""
        if not is_installed("matplotlib"):
            return []
        plot.save(draw(), self.folder / name)
        return [name]


@dataclass(frozen=True, eq=False)
class Outcome:
    """Results of a step.

    Attributes
    ----------
    numbers : dict
        Numbers that the step found, as JSON types.
    files : list of str
        Names of the files that the step wrote.
    lines : RangeLines or None
        Corrected lines, if the step corrects them.
    """

    numbers: dict[str, Any]
    files: list[str] = field(default_factory=list)
    lines: RangeLines | None = None


def options_of(step: str, scene: SceneFile) -> dict[str, Any]:
    """Return all options of a scene that a step depends on, as JSON types or arrays."""
    options = dict(scene.process.get(step, {}))
    if step in ("inspect", "focus", "pair_errors", "image", "heights", "mosaic"):
        options["grid"] = None if scene.grid is None else digest(scene.grid)
        options["beam"] = scene.image.get("beam")
    if step == "pair_errors":
        options["heights"] = scene.process["heights"]
    if step == "inspect":
        options["element_length_m"] = None if scene.sonar is None else scene.sonar.element_length_m
    if step in ("image", "mosaic"):
        options["request"] = request_of(scene)
        if "bank" in scene.process:
            options["bank"] = scene.process["bank"]
    if step == "mosaic":
        options |= scene.mosaic
    return options


def is_mosaic(step: str, scene: SceneFile) -> bool:
    """Return whether a step fills a store, which has records of its own, patch by patch."""
    if step == "heights":
        return not {"patch_m", "store"}.isdisjoint(scene.process.get("heights", {}))
    return step == "mosaic"


def store_of(step: str, scene: SceneFile) -> Path | None:
    """Return the store that a scene demands for a step, or None if it may lie in the folder."""
    options = scene.process.get("heights", {}) if step == "heights" else scene.mosaic
    return options.get("store")


def request_of(scene: SceneFile) -> dict[str, Any]:
    """Return the scene's request for an image, or the default tolerance."""
    return scene.request or {"tolerance_db": TOLERANCE_DB}


def inspected(job: Job) -> Outcome:
    """Inspect the recording, and write the table of findings."""
    scene = job.scene
    found = inspect(
        job.given(), scene.grid, device=job.device, beam=scene.image.get("beam"),
        element_length_m=None if scene.sonar is None else scene.sonar.element_length_m,
    )  # fmt: skip
    for finding in found.findings:
        validate.warn(f"{finding.name}: {finding.message}")
    _write(job.folder / "inspect.txt", found.describe() + "\n")
    files = ["inspect.txt", *job.draw("inspect.png", lambda: plot.inspection(found, scene.grid))]
    findings = [{"name": each.name, "message": each.message} for each in found.findings]
    return Outcome({"geometry": found.geometry, "pings": found.pings, "findings": findings}, files)


def calibrated(job: Job) -> Outcome:
    """Find time offset, sound speed and lever arm from known points."""
    options = job.options("calibrate")
    found = calibrate_track(job.lines, options.pop("points_m"), **options, progress=job.progress)
    return Outcome(found.figures, lines=found.lines)


def navigated(job: Job) -> Outcome:
    """Correct the track with displaced phase centres (micronavigation)."""
    found = micronavigate(job.lines, **job.options("navigate"), progress=job.progress)
    _write(job.folder / "navigate.csv", csv_of_track(found))
    files = ["navigate.csv"]
    files += job.draw("navigate-track.png", lambda: plot.corrections(found))
    range_m = job.options("navigate").get("range_m")
    files += job.draw("navigate-coherence.png", lambda: plot.coherence(found, range_m=range_m))
    return Outcome(numbers.of_navigation(found), files, found.lines)


def focused(job: Job) -> Outcome:
    """Correct the track with the bright responses of an image (autofocus)."""
    (grid,) = job.scene.need("grid")
    found = autofocus(
        job.lines, grid, beam=job.scene.image.get("beam"), **job.options("focus"),
        device=job.device, progress=job.progress,
    )  # fmt: skip
    _write(job.folder / "focus.csv", csv_of_track(found))
    files = ["focus.csv"]
    files += job.draw("focus-track.png", lambda: plot.corrections(found))
    files += job.draw("focus-sharpness.png", lambda: plot.sharpness(found))
    return Outcome(numbers.of_focus(found), files, found.lines)


def imaged(job: Job) -> Outcome:
    """Form the image and, if the lines were corrected, also the image without corrections."""
    (grid,) = job.scene.need("grid")
    given, lines = job.of_bank(job.given()), job.of_bank(job.lines)
    corrected = bool(job.corrections)
    shares = (0, 2), (1, 2)
    if not corrected:
        image, error_db = _formed(job, lines, grid, (0, 1))
    else:
        before, _ = _formed(job, given, grid, shares[0])
        image, error_db = _formed(job, lines, grid, shares[1])
    save(job.folder / "image.h5", image)
    files = ["image.h5"]
    files += job.draw("image.png", lambda: plot.image_db(image, title=job.title))
    found = numbers.of_image(image) | {"predicted_error_db": error_db}
    if corrected:
        save(job.folder / "before.h5", before)
        found["before"] = numbers.of_image(before)
        both = job.draw("before-and-after.png", lambda: plot.before_and_after(before, image))
        files += ["before.h5", *both]
    return Outcome(found, files)


def paired(job: Job) -> Outcome:
    """Find phase, delay and roll of the second receiver bank from heights of the first two."""
    first, second = check_banks(job.lines)
    if is_mosaic("heights", job.scene):
        with staging(job.folder) as temporary:
            found = _height_mosaic(job, temporary / "heights.zarr").sampled_heights()
    else:
        found = _heights(job)
    errors = pair_errors(
        first, second, found, beam=job.scene.image.get("beam"), **job.options("pair_errors"),
        **_given(job.options("heights"), "tolerance_db"), device=job.device,
    )  # fmt: skip
    number = first_two_banks(job.lines.bank_numbers)[1]
    corrected = with_bank(job.lines, number, errors.corrected(first, second))
    return Outcome(errors.figures, lines=corrected)


def measured(job: Job) -> Outcome:
    """Measure the heights of the seabed from the first two receiver banks."""
    files, described = [], {}
    if is_mosaic("heights", job.scene):
        store = _replacing_own(job, lambda: _height_mosaic(job, job.store))
        found = store.overview_heights()
        described = {"store": str(job.store), "inputs": stored_digest(job.store.resolve())}
    else:
        found = _heights(job)
        save(job.folder / "heights.h5", found)
        files = ["heights.h5"]
    if found.mask.any():
        files += job.draw("heights.png", lambda: plot.heights(found, title=job.title))
    return Outcome(numbers.of_heights(found) | described, files)


def _heights(job: Job) -> Heights:
    """Return the heights that the lines show, in memory."""
    (grid,) = job.scene.need("grid")
    first, second = check_banks(job.lines)
    return heights(
        first, second, grid, beam=job.scene.image.get("beam"), **job.options("heights"),
        device=job.device, progress=job.progress,
    )  # fmt: skip


def _height_mosaic(job: Job, store: Path) -> Store:
    """Return a store with the heights that the lines show, after measuring missing patches."""
    (grid,) = job.scene.need("grid")
    first, second = check_banks(job.lines)
    options = job.options("heights") | {"store": store}
    return mosaic_heights(
        first, second, grid, **options, beam=job.scene.image.get("beam"), device=job.device,
        progress=job.progress,
    )  # fmt: skip


def _given(options: dict[str, Any], *names: str) -> dict[str, Any]:
    return {name: options[name] for name in names if name in options}


def check_banks(lines: RangeLines) -> tuple[RangeLines, RangeLines]:
    """Return the two banks for heights; raise ValueError for a recording of one bank."""
    first, second = first_two_banks(lines.bank_numbers)
    return lines.bank(first), lines.bank(second)


def joined(job: Job) -> Outcome:
    """Form a mosaic in a Zarr store. Finished patches with the same inputs are kept."""
    scene = job.scene
    (grid,) = scene.need("grid")
    request = request_of(scene)
    if ignored := {"taps", "upsampling"} & set(request):
        raise ArgumentError(min(ignored), "be left out for a mosaic, in which it has no effect")
    memory_mib = scene.mosaic.get("memory_mib")
    begin = partial(
        mosaic, job.of_bank(job.lines), grid, job.store, **request, beam=scene.image.get("beam"),
        patches=scene.mosaic.get("patches"), memory_bytes=memory_mib and memory_mib << 20,
        device=job.device,
    )  # fmt: skip
    formed = _replacing_own(job, begin)
    count, errors = formed.shape[0] * formed.shape[1], []
    done = len(formed.finished)
    for patch in formed:
        done += 1
        errors.append(patch.record.predicted_error_db)
        if job.progress is not None:
            job.progress(done, count)
    return Outcome(
        {
            "store": str(job.store),
            "inputs": stored_digest(job.store.resolve()),
            "patches": list(formed.shape),
            "formed": len(errors),
        }
    )


def _replacing_own(job: Job, begin: Callable[[], _Begun]) -> _Begun:
    """Return the mosaic that is begun, after removing one that this step made of other inputs."""
    try:
        return begin()
    except OtherInputsError:
        if not _is_own_store(job):
            raise
        _remove_store(job.store)
        return begin()


def _is_own_store(job: Job) -> bool:
    """Return whether an earlier run of this step made the store, so that it may be replaced.

    For a store in the folder of the processing, the record of the step suffices. A store elsewhere
    must also have the inputs with which the step left it.
    """
    if job.former is None or "store" not in job.former.numbers:
        return False
    recorded = str(job.former.numbers["store"])
    if job.is_store_inside:
        # Compare names only: the folder may have moved, or its path be relative.
        return Path(recorded).name == job.store.name
    if recorded != str(job.store):
        return False
    return job.former.numbers.get("inputs") == stored_digest(job.store.resolve())


def _remove_store(path: Path) -> None:
    """Remove a store in one step, so that a killed process leaves no partial store at its path."""
    real = path.resolve()
    with staging(real.parent) as temporary:
        real.rename(temporary / real.name)


RUN: dict[str, Callable[[Job], Outcome]] = {
    "inspect": inspected,
    "calibrate": calibrated,
    "navigate": navigated,
    "focus": focused,
    "pair_errors": paired,
    "image": imaged,
    "heights": measured,
    "mosaic": joined,
}
"""Function of every step, in the order in which they run."""


FILES: dict[str, tuple[str, ...]] = {
    "inspect": ("inspect.txt", "inspect.png"),
    "calibrate": ("calibrate.h5",),
    "navigate": ("navigate.csv", "navigate-track.png", "navigate-coherence.png", "navigate.h5"),
    "focus": ("focus.csv", "focus-track.png", "focus-sharpness.png", "focus.h5"),
    "pair_errors": ("pair_errors.h5",),
    "image": ("image.h5", "image.png", "before.h5", "before-and-after.png"),
    "heights": ("heights.h5", "heights.png"),
    "mosaic": (),
}
"""Files that every step may write. The store of a mosaic has its own checks."""

TABLES = {name: f"[process.{name}]" for name in CORRECTIONS} | {
    "inspect": "[grid]",
    "image": "[image]",
    "heights": "[process.heights]",
    "mosaic": "[mosaic]",
}
"""Table of the scene file that contains the options of a step, by step."""


def check_pictures() -> None:
    """Warn if no pictures can be written."""
    if not is_installed("matplotlib"):
        validate.warn(
            f"no pictures are written, since they need matplotlib: {install_command('plot')}"
        )


def _formed(
    job: Job, lines: RangeLines, grid: Grid, part: tuple[int, int]
) -> tuple[Image, float | None]:
    """Return the image of lines and its predicted error.

    `part` is the number of this image, from 0, and the number of images, for the progress.
    """
    number, parts = part

    def progress(done: int, total: int) -> None:
        if job.progress is not None:
            job.progress(number * total + done, parts * total)

    request, beam = request_of(job.scene), job.scene.image.get("beam")
    if request.keys() & set(EXACT_KEYS):
        image = backproject(lines, grid, **request, beam=beam, device=job.device, progress=progress)
        return image, None
    chosen = plan(lines, grid, **request, beam=beam, device=job.device)
    image = factorize(lines, grid, chosen, device=job.device, progress=progress)
    return image, chosen.predicted_error_db


def _write(path: Path, text: str) -> None:
    with replacing(path) as temporary:
        temporary.write_text(text)
