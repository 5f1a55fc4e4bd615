"""Demo: the wide-beam case of the thesis (Ødegaard 2004, chapter 5), simulated and imaged."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from clsas import plot
from clsas.engine.data.atomic import replacing
from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Image
from clsas.engine.data.system import Sonar
from clsas.engine.device.device import open_device
from clsas.engine.forming import form_exactly
from clsas.engine.signal.compression import compress
from clsas.files.hdf5 import save
from clsas.files.scene_files import SceneFile, built_in_scene, read_scene
from clsas.inspection.sampling import check_sampling
from clsas.measures.quality import PointResponse, measure_point
from clsas.measures.resolution import expected_resolution_m
from clsas.simulation.simulator import simulate

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Progress = Callable[[int, int], None] | None
Result = TypeVar("Result")

_CLOSE_UP_M = 0.25  # half the side of the close-up around the measured point
_CLOSE_UP_PIXELS = 501
_FILES = (
    "scene.toml", "echoes.h5", "echoes.png", "lines.h5", "lines.png", "image.h5", "image.png",
    "point.h5", "point.png", "cuts.png",
)  # fmt: skip


def run(
    out: Path,
    *,
    device: str | int | None = None,
    say: Callable[[str], None] = print,
    progress: Callable[[str], AbstractContextManager[Progress]] | None = None,
) -> dict[str, Any]:
    """Simulate, compress, image, measure and draw the case; return the results.

    Parameters
    ----------
    out : Path
        Folder for the files, created if it does not exist.
    device : str or int, optional
        See `clsas.engine.device.device.choose`.
    say : callable
        Called with each line of the report.
    progress : callable, optional
        Called with the name of a step; returns a context manager that yields the progress callback
        of the step, or None.

    Returns
    -------
    dict
        "seconds" of each step, "device", "driver", "point" (the PointResponse of the scene's first
        target), "expected" (its theoretical resolutions) and "files".

    Raises
    ------
    DeviceError
        If there is no such device.
    FileExistsError
        If the folder contains files with the names of the demo's that another program wrote.
    ImportError
        If matplotlib is not installed.
    OSError
        If a file cannot be written.
    """
    opened = open_device(device)
    scene = _scene_in(out)
    sonar, track, targets, grid = scene.need("sonar", "track", "targets", "grid")
    seconds: dict[str, float] = {}

    def report(label: str, text: str) -> None:
        say(f"{label:<10} {text}")

    def timed(step: str, work: Callable[[Progress], Result]) -> Result:
        with nullcontext() if progress is None else progress(step) as callback:
            start = time.perf_counter()
            result = work(callback)
            seconds[step] = time.perf_counter() - start
        return result

    def keep(name: str, obj: Any, figure: Figure) -> None:
        save(out / f"{name}.h5", obj)
        plot.save_png(figure, out / f"{name}.png")

    def form(step: str, grid: Grid) -> Image:
        image = timed(
            step, lambda p: form_exactly(lines, grid, device=opened, **scene.image, progress=p)
        )
        report(
            step,
            f"{' x '.join(map(str, grid.shape))} pixels from {lines.channels} lines in "
            f"{seconds[step]:.2f} s, including the build of the kernel",
        )
        return image

    # The scene, and how its sampling affects the image.
    pulse = sonar.pulse
    report(
        "scene",
        f"{targets.points} points, {track.pings} pings of {sonar.receivers} receivers, "
        f"{pulse.carrier_hz / 1e6:g} MHz, {pulse.bandwidth_hz / 1e3:g} kHz",
    )
    for finding in check_sampling(sonar, track, grid):
        report("", f"note: {finding.message}. See clsas limits {out / 'scene.toml'}")

    echoes = timed(
        "simulate", lambda p: simulate(sonar, track, targets, **scene.simulate, progress=p)
    )
    keep("echoes", echoes, plot.geometry(echoes, grid))
    report(
        "simulate",
        f"{echoes.channels} echoes of {echoes.length} samples in {seconds['simulate']:.2f} s",
    )
    lines = timed("compress", lambda p: compress(echoes, **scene.compress, progress=p))
    keep("lines", lines, plot.range_lines(lines))
    report(
        "compress",
        f"{lines.channels} lines of {lines.length} samples in {seconds['compress']:.2f} s",
    )

    info = opened.info
    report("device", f"{info.label}, driver {info.driver}")
    image = form("image", grid)
    keep("image", image, plot.image_db(image, title="whole scene"))
    point_m = targets.positions_m[0]
    x, y = ((at_m - _CLOSE_UP_M, at_m + _CLOSE_UP_M, _CLOSE_UP_PIXELS) for at_m in point_m[:2])
    close_up = form("close-up", Grid.plane(x=x, y=y))
    keep("point", close_up, plot.image_db(close_up, title="the point in the middle"))

    response = measure_point(close_up, near=tuple(point_m[:2]))
    plot.save_png(plot.cuts(response), out / "cuts.png")
    expected_m = expected_resolution_m(sonar, track, point_m)
    _report_point(report, response, point_m, expected_m, sonar)
    report("files", f"{out}: {', '.join(_FILES)}")
    return {
        "seconds": seconds,
        "device": info.label,
        "driver": info.driver,
        "point": response,
        "expected": {"azimuth_resolution_m": expected_m[0], "range_resolution_m": expected_m[1]},
        "files": [out / name for name in _FILES],
    }


def _scene_in(out: Path) -> SceneFile:
    """Return the scene after writing its file into a folder, unless files of others are there."""
    text, file = built_in_scene("thesis_wide_beam"), out / "scene.toml"
    taken = [name for name in _FILES if (out / name).exists()]
    if taken and not (file.is_file() and file.read_bytes() == text):
        raise FileExistsError(
            "`out` must be a new folder, or that of an earlier demo with an unchanged scene.toml: "
            f"in {out} the demo would overwrite {', '.join(taken)}"
        )
    out.mkdir(parents=True, exist_ok=True)
    with replacing(file) as temporary:
        temporary.write_bytes(text)
    return read_scene(file)


def _report_point(
    report: Callable[[str, str], None],
    response: PointResponse,
    point_m: NDArray[np.float64],
    expected_m: tuple[float, float],
    sonar: Sonar,
) -> None:
    """Report the measured point beside the theoretical resolutions."""
    report(
        "measure",
        f"peak at x = {response.x_m:.5f} m, y = {response.y_m:.5f} m; the point is at "
        f"{point_m[0]:g}, {point_m[1]:g} m",
    )
    element_m = sonar.element_length_m
    half_element = "" if element_m is None else f"L/2 = {500 * element_m:.2f}"
    rayleigh = f"c/2B = {500 * sonar.sound_speed_m_s / sonar.pulse.bandwidth_hz:.2f}"
    for name, cut, theory_m, rule in (
        ("azimuth", response.azimuth, expected_m[0], half_element),
        ("range", response.range, expected_m[1], rayleigh),
    ):
        report(
            "",
            f"{name:<7} {1e3 * cut.resolution_m:.2f} mm wide at -3 dB (theory "
            f"{1e3 * theory_m:.2f} mm; {rule} mm), PSLR {max(cut.pslr_db):.1f} dB, "
            f"ISLR {cut.islr_db:.1f} dB",
        )
