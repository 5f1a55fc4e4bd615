"""Steps of a processing. Each takes lines, writes its files and returns the numbers that it found.

The table `STEPS` at the end says what each step is. Which of them a scene file runs, and what they
need there, is said by `checked_steps` in `clsas/files/scene_tables.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from clsas import plot
from clsas.engine.data import validate
from clsas.engine.data.atomic import replacing, staging
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.contrast import contrast, entropy
from clsas.engine.data.digests import digest
from clsas.engine.data.extras import is_installed
from clsas.engine.data.findings import warn_of
from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Image
from clsas.engine.data.lines import RangeLines, banks_of, first_two_banks
from clsas.engine.data.validate import ArgumentError
from clsas.engine.device.device import Device
from clsas.engine.factorized.planner import DEFAULT_REQUEST
from clsas.engine.imaging import backproject, factorize, plan
from clsas.files.hdf5 import save
from clsas.files.scene_files import SceneFile
from clsas.files.scene_tables import EXACT_KEYS
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
from clsas.processing.record import StepRecord

_Begun = TypeVar("_Begun", Mosaic, Store)


@dataclass(frozen=True, eq=False)
class Job:
    """Inputs of a step.

    Attributes
    ----------
    scene : SceneFile
    staged : Path
        Folder for the step's files, from which they are moved once the step is done.
    output : Path
        Folder of the processing.
    given : Callable
        Returns the uncorrected lines of the recording.
    lines : RangeLines
        Lines with the corrections so far.
    corrections : tuple of str
        Steps that corrected the lines.
    device : Device
    progress : Callable or None
        Called as progress(done, total).
    former : StepRecord or None
        Record of the last run of the step.
    """

    scene: SceneFile
    staged: Path
    output: Path
    given: Callable[[], RangeLines]
    lines: RangeLines
    corrections: tuple[str, ...]
    device: Device
    progress: Callable[[int, int], None] | None
    former: StepRecord | None

    @property
    def grid(self) -> Grid:
        """Grid of the scene; raise ValueError if it has none."""
        (grid,) = self.scene.need("grid")
        return grid

    @property
    def beam(self) -> BeamWindow | None:
        """Beam of the scene, if it has one."""
        return self.scene.image.get("beam")

    @property
    def title(self) -> str:
        """Title of pictures, with the steps that corrected the lines."""
        if not self.corrections:
            return "Uncorrected recording"
        return f"After {', '.join(self.corrections)}"

    def of_bank(self, lines: RangeLines) -> RangeLines:
        """Return the lines of the receiver bank that is imaged: the scene's, or else the first."""
        banks = banks_of(lines.bank_numbers)
        with located("[process]"):
            chosen = validate.one_of("bank", self.scene.process.get("bank", banks[0]), banks)
        return lines.bank(chosen)

    def draw(self, name: str, draw: Callable[[], Any]) -> None:
        """Write a picture, if matplotlib is installed."""
        if is_installed("matplotlib"):
            plot.save(draw(), self.staged / name)


@dataclass(frozen=True, eq=False)
class Step:
    """A step of the chain.

    Attributes
    ----------
    name : str
    run : Callable
        Function that runs the step, and returns the numbers that it found.
    table : str
        Table of the scene file that messages about the step name.
    files : tuple of str
        Files that the step may write. The store of a mosaic has its own checks.
    uses : tuple of str
        Other options of the scene on which its results depend, beside those of its own table.
    """

    name: str
    run: Callable[[Job], dict[str, Any]]
    table: str
    files: tuple[str, ...]
    uses: tuple[str, ...] = ()

    def options(self, scene: SceneFile) -> dict[str, Any]:
        """Return all options of a scene that the step depends on, as JSON types or arrays."""
        found = own_options(self.name, scene)
        if "grid" in self.uses:
            found["grid"] = None if scene.grid is None else digest(scene.grid)
        if "beam" in self.uses:
            found["beam"] = scene.image.get("beam")
        if "heights" in self.uses:
            found["heights"] = scene.process["heights"]
        if "element_length_m" in self.uses:
            sonar = scene.sonar
            found["element_length_m"] = None if sonar is None else sonar.element_length_m
        if "request" in self.uses:
            found["request"] = request_of(scene) | scene.promise
        if "bank" in self.uses and "bank" in scene.process:
            found["bank"] = scene.process["bank"]
        return found


def own_options(step: str, scene: SceneFile) -> dict[str, Any]:
    """Return the options in a step's own table of the scene."""
    return dict(scene.mosaic if step == "mosaic" else scene.process.get(step, {}))


def is_mosaic(step: str, scene: SceneFile) -> bool:
    """Return whether a step fills a store, which has records of its own, patch by patch."""
    if step == "heights":
        return not {"patch_m", "store"}.isdisjoint(own_options(step, scene))
    return step == "mosaic"


def request_of(scene: SceneFile) -> dict[str, Any]:
    """Return the scene's request for an image, or the default tolerance."""
    return scene.request or DEFAULT_REQUEST


def inspect_step(job: Job) -> dict[str, Any]:
    """Inspect the recording, and write the table of findings."""
    scene = job.scene
    found = inspect(
        job.given(), scene.grid, device=job.device, beam=job.beam,
        element_length_m=None if scene.sonar is None else scene.sonar.element_length_m,
    )  # fmt: skip
    for finding in found.findings:
        warn_of([finding], f"{finding.name}: ")
    with replacing(job.staged / "inspect.txt") as temporary:
        temporary.write_text(found.describe() + "\n")
    job.draw("inspect.png", lambda: plot.inspection(found, scene.grid))
    findings = [{"name": each.name, "message": each.message} for each in found.findings]
    return {"geometry": found.geometry, "pings": found.pings, "findings": findings}


def calibrate_step(job: Job) -> dict[str, Any]:
    """Find time offset, sound speed and lever arm from known points."""
    options = own_options("calibrate", job.scene)
    found = calibrate_track(job.lines, options.pop("points_m"), **options, progress=job.progress)
    save(job.staged / "calibrate.h5", found.lines)
    return found.figures


def navigate_step(job: Job) -> dict[str, Any]:
    """Correct the track with displaced phase centres (micronavigation)."""
    options = own_options("navigate", job.scene)
    found = micronavigate(job.lines, **options, progress=job.progress)
    corrections = (
        "sway_m", "sway_sd_m", "shape_sd_m", "yaw_rad", "yaw_sd_rad", "surge_m", "surge_sd_m",
    )  # fmt: skip
    columns = {name: getattr(found, name) for name in corrections}
    _write_track(
        job.staged / "navigate.csv", found.lines, {"heading_rad": found.track.yaw_rad} | columns
    )
    job.draw("navigate-track.png", lambda: plot.corrections(found))
    range_m = options.get("range_m")
    job.draw("navigate-coherence.png", lambda: plot.coherence(found, range_m=range_m))
    save(job.staged / "navigate.h5", found.lines)
    return found.figures


def focus_step(job: Job) -> dict[str, Any]:
    """Correct the track with the bright responses of an image (autofocus)."""
    found = autofocus(
        job.lines, job.grid, beam=job.beam, **own_options("focus", job.scene), device=job.device,
        progress=job.progress,
    )  # fmt: skip
    starts = found.lines.ping_starts
    columns = {
        f"correction_{name}_m": found.correction_m[starts, axis] for axis, name in enumerate("xyz")
    }
    columns["correction_sd_m"] = found.correction_sd_m[starts]
    _write_track(job.staged / "focus.csv", found.lines, columns)
    job.draw("focus-track.png", lambda: plot.corrections(found))
    job.draw("focus-sharpness.png", lambda: plot.sharpness(found))
    save(job.staged / "focus.h5", found.lines)
    return found.figures


def _write_track(path: Path, lines: RangeLines, corrections: dict[str, NDArray]) -> None:
    """Write the corrected track and the corrections, ping by ping, as CSV for other programs."""
    at_m = lines.ping_centres_m
    columns = {
        "ping": np.arange(len(at_m)),
        "x_m": at_m[:, 0],
        "y_m": at_m[:, 1],
        "z_m": at_m[:, 2],
    }
    columns |= corrections
    rows = np.column_stack([*columns.values()])
    with replacing(path) as temporary:
        np.savetxt(temporary, rows, "%.9g", ",", header=",".join(columns), comments="")


def pair_errors_step(job: Job) -> dict[str, Any]:
    """Find phase, delay and roll of the second receiver bank from heights of the first two."""
    first, second = both_banks(job.lines)
    options, of_heights = (own_options(each, job.scene) for each in ("pair_errors", "heights"))
    if is_mosaic("heights", job.scene):
        with staging(job.staged) as temporary:
            found = _height_mosaic(job, temporary / "heights.zarr").sampled_heights()
    else:
        found = _heights(job)
    if "tolerance_db" in of_heights:
        options["tolerance_db"] = of_heights["tolerance_db"]
    errors = pair_errors(first, second, found, beam=job.beam, **options, device=job.device)
    number = first_two_banks(job.lines.bank_numbers)[1]
    corrected = with_bank(job.lines, number, errors.corrected(first, second))
    save(job.staged / "pair_errors.h5", corrected)
    return errors.figures


def image_step(job: Job) -> dict[str, Any]:
    """Form the image and, if the lines were corrected, also the image without corrections."""
    if not job.corrections:
        image = _formed(job, job.lines, 0, 1)
    else:
        before = _formed(job, job.given(), 0, 2)
        image = _formed(job, job.lines, 1, 2)
    save(job.staged / "image.h5", image)
    job.draw("image.png", lambda: plot.image_db(image, title=job.title))
    numbers = _figures(image)
    if job.corrections:
        save(job.staged / "before.h5", before)
        job.draw("before-and-after.png", lambda: plot.before_and_after(before, image))
        numbers["before"] = _figures(before)
    return numbers


def _formed(job: Job, lines: RangeLines, number: int, images: int) -> Image:
    """Return the image of lines; for the progress, it is image `number`, from 0, of several."""

    def progress(done: int, total: int) -> None:
        if job.progress is not None:
            job.progress(number * total + done, images * total)

    lines, grid, beam, request = job.of_bank(lines), job.grid, job.beam, request_of(job.scene)
    how = {"device": job.device, "progress": progress, **job.scene.promise}
    if request.keys() & set(EXACT_KEYS):
        return backproject(lines, grid, **request, beam=beam, **how)
    if "tolerance_db" in request:
        return factorize(lines, grid, request["tolerance_db"], beam=beam, **how)
    return factorize(lines, grid, plan(lines, grid, **request, beam=beam, device=job.device), **how)


def _figures(image: Image) -> dict[str, Any]:
    """Return errors and measures of a whole image; measures are None if every pixel is zero."""
    peak, formed = float(np.abs(image.pixels).max()), image.formed
    assert formed is not None
    certificate = formed.certificate
    errors = {
        "predicted_error_db": formed.predicted_error_db,
        "error": None if certificate is None else certificate.describe(formed.tolerance_db),
        "certificate": None if certificate is None else certificate.figures,
        "misses": list(formed.misses),
    }
    if peak == 0:
        return errors | {"peak_db": None, "contrast": None, "entropy": None}
    return errors | {
        "peak_db": 20 * float(np.log10(peak)),
        "contrast": contrast(image),
        "entropy": entropy(image),
    }


def heights_step(job: Job) -> dict[str, Any]:
    """Measure the heights of the seabed from the first two receiver banks."""
    described = {}
    if is_mosaic("heights", job.scene):
        path, store = _begun(job, "heights", partial(_height_mosaic, job))
        found = store.overview_heights()
        described = {"store": str(path), "inputs": stored_digest(path.resolve())}
    else:
        found = _heights(job)
        save(job.staged / "heights.h5", found)
    if found.mask.any():
        job.draw("heights.png", lambda: plot.heights(found, title=job.title))
    return found.figures | described


def _heights(job: Job) -> Heights:
    """Return the heights that the lines show, in memory."""
    first, second = both_banks(job.lines)
    return heights(
        first, second, job.grid, beam=job.beam, **own_options("heights", job.scene),
        device=job.device, progress=job.progress,
    )  # fmt: skip


def _height_mosaic(job: Job, store: Path) -> Store:
    """Return a store with the heights that the lines show, after measuring missing patches."""
    first, second = both_banks(job.lines)
    options = own_options("heights", job.scene) | {"store": store}
    return mosaic_heights(
        first, second, job.grid, beam=job.beam, **options, device=job.device, progress=job.progress
    )


def both_banks(lines: RangeLines) -> tuple[RangeLines, RangeLines]:
    """Return the two banks for heights; raise ValueError for a recording of one bank."""
    first, second = first_two_banks(lines.bank_numbers)
    return lines.bank(first), lines.bank(second)


def mosaic_step(job: Job) -> dict[str, Any]:
    """Form a mosaic in a Zarr store. Finished patches with the same inputs are kept."""
    request, grid = request_of(job.scene), job.grid
    if ignored := {"taps", "upsampling"} & set(request):
        raise ArgumentError(min(ignored), "be left out for a mosaic, in which it has no effect")
    lines = job.of_bank(job.lines)
    patches, memory_mib = (job.scene.mosaic.get(name) for name in ("patches", "memory_mib"))

    def begin(store: Path) -> Mosaic:
        return mosaic(
            lines, grid, store, **request, beam=job.beam, patches=patches,
            memory_bytes=memory_mib and memory_mib << 20, device=job.device, **job.scene.promise,
        )  # fmt: skip

    path, formed = _begun(job, "mosaic", begin)
    count, before = formed.shape[0] * formed.shape[1], len(formed.finished)
    done = before
    for _ in formed:
        done += 1
        if job.progress is not None:
            job.progress(done, count)
    return {
        "store": str(path),
        "inputs": stored_digest(path.resolve()),
        "patches": list(formed.shape),
        "formed": done - before,
    }


def _begun(job: Job, step: str, begin: Callable[[Path], _Begun]) -> tuple[Path, _Begun]:
    """Return the path of a step's store, and the mosaic that is begun or continued there.

    A store of other inputs is removed first if an earlier run of this step made it. For one in the
    folder of the processing, the record of the step suffices. A store elsewhere must also have the
    inputs with which the step left it.
    """
    elsewhere = own_options(step, job.scene).get("store")
    path = elsewhere or job.output / f"{step}.zarr"
    try:
        return path, begin(path)
    except OtherInputsError:
        former = {} if job.former is None else job.former.numbers
        recorded = str(former.get("store", ""))
        if elsewhere is None:
            # Compare names only: the folder may have moved, or its path be relative.
            is_own = Path(recorded).name == path.name
        else:
            is_own = recorded == str(path) and former.get("inputs") == stored_digest(path.resolve())
        if not is_own:
            raise
    # In one step, so that a killed process leaves no partial store at the path.
    real = path.resolve()
    with staging(real.parent) as temporary:
        real.rename(temporary / real.name)
    return path, begin(path)


_IMAGING = "grid", "beam", "request", "bank"

STEPS = {
    step.name: step
    for step in (
        Step(
            "inspect", inspect_step, "[grid]", ("inspect.txt", "inspect.png"),
            uses=("grid", "beam", "element_length_m"),
        ),
        Step("calibrate", calibrate_step, "[process.calibrate]", ("calibrate.h5",)),
        Step(
            "navigate", navigate_step, "[process.navigate]",
            ("navigate.csv", "navigate-track.png", "navigate-coherence.png", "navigate.h5"),
        ),
        Step(
            "focus", focus_step, "[process.focus]",
            ("focus.csv", "focus-track.png", "focus-sharpness.png", "focus.h5"),
            uses=("grid", "beam"),
        ),
        Step(
            "pair_errors", pair_errors_step, "[process.pair_errors]", ("pair_errors.h5",),
            uses=("grid", "beam", "heights"),
        ),
        Step(
            "image", image_step, "[image]",
            ("image.h5", "image.png", "before.h5", "before-and-after.png"), uses=_IMAGING,
        ),
        Step(
            "heights", heights_step, "[process.heights]", ("heights.h5", "heights.png"),
            uses=("grid", "beam"),
        ),
        Step("mosaic", mosaic_step, "[mosaic]", (), uses=_IMAGING),
    )
}  # fmt: skip
"""Steps by name, in the order in which they run."""
