"""Demo: the wide-beam case of the thesis (Ødegaard 2004, chapter 5), simulated and imaged."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from clsas import plot
from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Image
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.system import Sonar
from clsas.engine.data.track import Track
from clsas.engine.device.device import Device, open_device
from clsas.engine.forming import form_exactly
from clsas.engine.signal.compression import compress
from clsas.files.hdf5 import save
from clsas.files.scene_files import SceneFile, built_in_scene, read_scene
from clsas.inspection.sampling import check_sampling
from clsas.measures.quality import PointResponse, measure_point
from clsas.measures.resolution import expected_resolution_m
from clsas.simulation.scenes import PointTargets
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


def _silent(step: str) -> AbstractContextManager[Progress]:
    return nullcontext()


def run(
    out: Path,
    *,
    device: str | int | None = None,
    say: Callable[[str], None] = print,
    progress: Callable[[str], AbstractContextManager[Progress]] = _silent,
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
    progress : callable
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
    demo = _Demo(out, scene, opened, say, progress)
    demo.report_scene(sonar, track, targets, grid)
    lines = demo.lines(sonar, track, targets, grid)
    info = opened.info
    demo.report("device", f"{info.label}, driver {info.driver}")
    image = demo.form("image", lines, grid)
    demo.keep("image", image, plot.image_db(image, title="whole scene"))
    point = targets.positions_m[0]
    close_up = demo.form("close-up", lines, _around(point))
    demo.keep("point", close_up, plot.image_db(close_up, title="the point in the middle"))
    response = measure_point(close_up, near=tuple(point[:2]))
    plot.save_png(plot.cuts(response), out / "cuts.png")
    expected_m = expected_resolution_m(sonar, track, point)
    demo.report_point(response, point, expected_m, sonar)
    demo.report("files", f"{out}: {', '.join(_FILES)}")
    return {
        "seconds": demo.seconds,
        "device": info.label,
        "driver": info.driver,
        "point": response,
        "expected": {"azimuth_resolution_m": expected_m[0], "range_resolution_m": expected_m[1]},
        "files": [out / name for name in _FILES],
    }


def _scene_in(out: Path) -> SceneFile:
    """Return the scene after writing its file into a folder."""
    text, file = built_in_scene("thesis_wide_beam"), out / "scene.toml"
    taken = [name for name in _FILES if (out / name).exists()]
    if taken and not (file.is_file() and file.read_bytes() == text):
        raise FileExistsError(
            "`out` must be a new folder, or that of an earlier demo with an unchanged scene.toml: "
            f"in {out} the demo would overwrite {', '.join(taken)}"
        )
    out.mkdir(parents=True, exist_ok=True)
    file.write_bytes(text)
    return read_scene(file)


def _around(point_m: NDArray[np.float64]) -> Grid:
    """Return the grid of a close-up of a point."""
    x, y, _ = point_m
    half_m, count = _CLOSE_UP_M, _CLOSE_UP_PIXELS
    return Grid.plane(x=(x - half_m, x + half_m, count), y=(y - half_m, y + half_m, count))


@dataclass(frozen=True)
class _Demo:
    """Steps of the demo, each of which is timed and reported."""

    out: Path
    scene: SceneFile
    device: Device
    say: Callable[[str], None]
    progress: Callable[[str], AbstractContextManager[Progress]]
    seconds: dict[str, float] = field(default_factory=dict)

    def report(self, label: str, text: str) -> None:
        """Write a line of the report."""
        self.say(f"{label:<10} {text}")

    def timed(self, step: str, work: Callable[[Progress], Result]) -> Result:
        """Return the result of a step, and record its time."""
        with self.progress(step) as callback:
            start = time.perf_counter()
            result = work(callback)
            self.seconds[step] = time.perf_counter() - start
        return result

    def keep(self, name: str, obj: Any, figure: Figure) -> None:
        """Save an object and its picture."""
        save(self.out / f"{name}.h5", obj)
        plot.save_png(figure, self.out / f"{name}.png")

    def lines(self, sonar: Sonar, track: Track, targets: PointTargets, grid: Grid) -> RangeLines:
        """Return range lines of simulated echoes."""
        options = self.scene.simulate
        echoes = self.timed(
            "simulate", lambda p: simulate(sonar, track, targets, **options, progress=p)
        )
        self.keep("echoes", echoes, plot.geometry(echoes, grid))
        self.report(
            "simulate",
            f"{echoes.channels} echoes of {echoes.length} samples in "
            f"{self.seconds['simulate']:.2f} s",
        )
        lines = self.timed(
            "compress", lambda p: compress(echoes, **self.scene.compress, progress=p)
        )
        self.keep("lines", lines, plot.range_lines(lines))
        self.report(
            "compress",
            f"{lines.channels} lines of {lines.length} samples in {self.seconds['compress']:.2f} s",
        )
        return lines

    def form(self, step: str, lines: RangeLines, grid: Grid) -> Image:
        """Return an exact image."""
        options = self.scene.image
        image = self.timed(
            step, lambda p: form_exactly(lines, grid, device=self.device, **options, progress=p)
        )
        self.report(
            step,
            f"{' x '.join(map(str, grid.shape))} pixels from {lines.channels} lines in "
            f"{self.seconds[step]:.2f} s, including the build of the kernel",
        )
        return image

    def report_scene(self, sonar: Sonar, track: Track, targets: PointTargets, grid: Grid) -> None:
        """Report the scene, and how its sampling affects the image."""
        pulse = sonar.pulse
        self.report(
            "scene",
            f"{targets.points} points, {track.pings} pings of {sonar.receivers} receivers, "
            f"{pulse.carrier_hz / 1e6:g} MHz, {pulse.bandwidth_hz / 1e3:g} kHz",
        )
        for finding in check_sampling(sonar, track, grid):
            file = self.out / "scene.toml"
            self.report("", f"note: {finding.message}. See clsas limits {file}")

    def report_point(
        self,
        response: PointResponse,
        point_m: NDArray[np.float64],
        expected_m: tuple[float, float],
        sonar: Sonar,
    ) -> None:
        """Report the measured point and the theoretical resolution."""
        x, y, _ = point_m
        self.report(
            "measure",
            f"peak at x = {response.x_m:.5f} m, y = {response.y_m:.5f} m; the point is at "
            f"{x:g}, {y:g} m",
        )
        rules = (
            "" if sonar.element_length_m is None else f"L/2 = {500 * sonar.element_length_m:.2f}",
            f"c/2B = {500 * sonar.sound_speed_m_s / sonar.pulse.bandwidth_hz:.2f}",
        )
        cuts = (response.azimuth, response.range)
        for name, cut, expected, rule in zip(
            ("azimuth", "range"), cuts, expected_m, rules, strict=True
        ):
            self.report(
                "",
                f"{name:<7} {1e3 * cut.resolution_m:.2f} mm wide at -3 dB (theory "
                f"{1e3 * expected:.2f} mm; {rule} mm), PSLR {max(cut.pslr_db):.1f} dB, "
                f"ISLR {cut.islr_db:.1f} dB",
            )
