"""Wide-beam case of the thesis (Ødegaard 2004, chapter 5), from simulation to measured image."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsas.core.grid import Grid
from clsas.exact.backprojection import form_exactly
from clsas.files.hdf5 import save
from clsas.files.scene_files import built_in_scene, read_scene
from clsas.opencl.device import open_device
from clsas.products import plot
from clsas.products.quality import measure_point
from clsas.signal.compression import compress
from clsas.simulation.simulator import simulate
from clsas.sonar.sampling import check_sampling
from clsas.sonar.system import Sonar, element_pattern
from clsas.sonar.track import Track, channels

Progress = Callable[[int, int], None] | None

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
    """Simulate, compress, image, measure and draw the case.

    Parameters
    ----------
    out : Path
        Folder for the files; it is made if it does not exist.
    device : str or int, optional
        See `clsas.opencl.device.choose`.
    say : callable
        Called with every line of the report.
    progress : callable
        Called with the name of a step. Returns a context manager that yields the progress callback
        of the step, or None.

    Returns
    -------
    dict
        "seconds" of every step, "device", "driver", "point" (the PointResponse of the scene's first
        target), "expected" (its theoretical resolutions) and "files".

    Raises
    ------
    DeviceError
        If there is no such device.
    FileExistsError
        If the folder holds files with the demo's names that another program made.
    ImportError
        If matplotlib is not installed.
    OSError
        If a file cannot be written.
    """
    opened = open_device(device)
    text, file = built_in_scene("thesis_wide_beam"), out / "scene.toml"
    taken = [name for name in _FILES if (out / name).exists()]
    if taken and not (file.is_file() and file.read_bytes() == text):
        raise FileExistsError(
            f"out must be a new folder or that of a demo whose scene.toml is as it was made: in "
            f"{out} this would write over {', '.join(taken)}"
        )
    out.mkdir(parents=True, exist_ok=True)
    file.write_bytes(text)
    scene = read_scene(file)
    sonar, track, targets, grid = scene.need("sonar", "track", "targets", "grid")
    seconds: dict[str, float] = {}

    def timed(step: str, work: Callable[[Progress], Any]) -> Any:
        with progress(step) as callback:
            start = time.perf_counter()
            result = work(callback)
            seconds[step] = time.perf_counter() - start
        return result

    def keep(name: str, obj: Any, figure: Any) -> None:
        save(out / f"{name}.h5", obj)
        plot.save_png(figure, out / f"{name}.png")

    def form(step: str, on: Grid) -> Any:
        def work(callback: Progress) -> Any:
            return form_exactly(lines, on, device=opened, **scene.image, progress=callback)

        image = timed(step, work)
        say(
            f"{step:<10} {' x '.join(map(str, on.shape))} pixels from {lines.channels} lines in "
            f"{seconds[step]:.2f} s, with building the kernel"
        )
        return image

    pulse = sonar.pulse
    say(
        f"{'scene':<10} {targets.points} points, {track.pings} pings of {sonar.receivers} "
        f"receivers, {pulse.carrier_hz / 1e6:g} MHz, {pulse.bandwidth_hz / 1e3:g} kHz"
    )
    for finding in check_sampling(sonar, track, grid):
        say(f"{'':<10} note: {finding.message}")

    echoes = timed(
        "simulate", lambda p: simulate(sonar, track, targets, **scene.simulate, progress=p)
    )
    keep("echoes", echoes, plot.geometry(echoes, grid))
    say(
        f"{'simulate':<10} {echoes.channels} echoes of {echoes.length} samples in "
        f"{seconds['simulate']:.2f} s"
    )

    lines = timed("compress", lambda p: compress(echoes, **scene.compress, progress=p))
    keep("lines", lines, plot.range_lines(lines))
    say(
        f"{'compress':<10} {lines.channels} lines of {lines.length} samples in "
        f"{seconds['compress']:.2f} s"
    )

    info = opened.info
    say(f"{'device':<10} {info.label}, driver {info.driver}")
    image = form("image", grid)
    keep("image", image, plot.image_db(image, title="whole scene"))

    x, y, _ = point = targets.positions_m[0]
    reach = _CLOSE_UP_M
    around = Grid.plane(
        x=(x - reach, x + reach, _CLOSE_UP_PIXELS), y=(y - reach, y + reach, _CLOSE_UP_PIXELS)
    )
    close_up = form("close-up", around)
    keep("point", close_up, plot.image_db(close_up, title="the point in the middle"))

    response = measure_point(close_up, near=(x, y))
    plot.save_png(plot.cuts(response), out / "cuts.png")
    azimuth_m, range_m = expected_resolution_m(sonar, track, point)
    say(
        f"{'measure':<10} peak at x = {response.x_m:.5f} m, y = {response.y_m:.5f} m; the point is "
        f"at {x:g}, {y:g} m"
    )
    for name, cut, expected, rule in (
        ("azimuth", response.azimuth, azimuth_m, f"L/2 = {500 * sonar.element_length_m:.2f}"),
        ("range", response.range, range_m,
         f"c/2B = {500 * sonar.sound_speed_m_s / pulse.bandwidth_hz:.2f}"),
    ):  # fmt: skip
        say(
            f"{'':<10} {name:<7} {1e3 * cut.resolution_m:.2f} mm wide at -3 dB (theory "
            f"{1e3 * expected:.2f} mm; {rule} mm), PSLR {max(cut.pslr_db):.1f} dB, "
            f"ISLR {cut.islr_db:.1f} dB"
        )
    say(f"{'files':<10} {out}: {', '.join(_FILES)}")
    return {
        "seconds": seconds,
        "device": info.label,
        "driver": info.driver,
        "point": response,
        "expected": {"azimuth_resolution_m": azimuth_m, "range_resolution_m": range_m},
        "files": [out / name for name in _FILES],
    }


def expected_resolution_m(
    sonar: Sonar, track: Track, point_m: NDArray[np.float64]
) -> tuple[float, float]:
    """Return the theoretical -3 dB widths of a point in azimuth and range.

    The response along an axis is the Fourier transform of the spectrum along it. In azimuth this is
    the two-way element pattern at the spatial frequency (sin theta_tx + sin theta_rx)/lambda of
    every channel; in range it is |P(f)|^2 of the matched pulse at 2 f/c.
    """
    tx, rx, _ = channels(sonar, track)
    sines = [(point_m - end)[:, 0] / np.linalg.norm(point_m - end, axis=1) for end in (tx, rx)]
    gain = np.ones(len(tx))
    for size, sine in zip((sonar.tx_length_m, sonar.rx_length_m), sines, strict=True):
        if size is not None:
            gain *= element_pattern(size, sine, sonar.pulse.carrier_hz, sonar.sound_speed_m_s)
    pulse = sonar.pulse
    frequency = np.linspace(-0.5, 0.5, 4001) * pulse.bandwidth_hz
    return (
        _width(sum(sines) / sonar.wavelength_m, gain),
        _width(2 * frequency / sonar.sound_speed_m_s, np.abs(pulse.spectrum(frequency)) ** 2),
    )


def _width(cycles_per_m: NDArray[np.float64], weight: NDArray[np.float64]) -> float:
    """Full width at half power of |sum weight exp(j 2 pi cycles_per_m u)| around u = 0."""
    offset = np.linspace(0, 1 / np.ptp(cycles_per_m), 2001)
    response = np.abs(np.exp(2j * np.pi * np.multiply.outer(offset, cycles_per_m)) @ weight)
    return 2 * float(np.interp(-0.5, -((response / response[0]) ** 2), offset))
