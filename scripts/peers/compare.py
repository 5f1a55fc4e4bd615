"""Exact images by other codes beside those of clsas: `scripts/bench peers`.

The scene is `bp-2k`, or a part of it with fewer pixels and channels: the same spacings and ranges.
All codes form the same image of it, in turns. Other codes come from PyPI, into an environment of
their own in the cache folder. A program beside this one runs each of them; it reads requests from
its standard input. torchbp is not on PyPI and is not measured.
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import tempfile
import time
import venv
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import clsas
from clsas.core.cache import cache_folder
from clsas.exact import reference
from clsas.trials import cases, tables
from clsas.trials.cases import Case

FASTSAR = "fastsar==0.1.8"
# Interpolator and upsampling: linear is the fastest, cubic on 8 times the samples its default.
FASTSAR_SETTINGS = (("linear", 8), ("cubic", 4), ("cubic", 8))
ACCURACIES_DB = (-50.0, -80.0)
ERROR_PIXELS = 300
PADDING = 64  # zeros at both ends of a line, which keep its echoes from wrapping around
LIGHT_M_S = 299_792_458.0  # the speed of waves in codes for radar


class PeerError(Exception):
    """Another code cannot be installed or run here."""


@dataclass(frozen=True)
class Method:
    """A way to an exact image: `form` returns the seconds that it took, and the image."""

    name: str
    form: Callable[[], tuple[float, NDArray[np.complex64]]]


def scene(pixels: int) -> Case:
    """Return the part of `bp-2k` with so many pixels along either side, and as many channels."""
    whole = cases.EXACT_CASES["bp-2k"]
    (left, right), (near, far) = whole.x_m, whole.y_m
    steps = (pixels - 1) / (whole.pixels - 1)
    half, middle = (right - left) / 2 * steps, (left + right) / 2
    return replace(
        whole,
        channels=whole.channels * pixels // whole.pixels,
        x_m=(middle - half, middle + half),
        y_m=(near, near + (far - near) * steps),
        pixels=pixels,
    )


def as_radar(case: Case, lines: clsas.RangeLines) -> dict[str, object]:
    """Return lines as samples over frequency, as of a radar with the same wavelengths.

    A point of amplitude A at range R gives S[p, k] = A exp(-j 4 pi f_k (R - ref_p) / c) in channel
    p at frequency f_k, with c the speed of light.
    """
    samples = np.pad(lines.samples.astype(np.complex128), ((0, 0), (PADDING, PADDING)))
    count = samples.shape[1]
    first_m = lines.first_range_m - PADDING * lines.range_step_m
    cycles_per_m = np.arange(-(count // 2), count - count // 2) / (count * lines.range_step_m)
    spectrum = np.fft.fftshift(np.fft.fft(samples, axis=1), axes=1)
    ref_m = first_m + count // 2 * lines.range_step_m
    cycles = lines.carrier_cycles_per_m * ref_m[:, None]
    cycles = cycles + cycles_per_m * (ref_m - first_m)[:, None]
    return {
        "history": (spectrum * np.exp(2j * np.pi * cycles)).astype(np.complex64),
        "positions_m": lines.tx_m,
        "ref_m": ref_m,
        "first_hz": (lines.carrier_cycles_per_m + cycles_per_m[0]) * LIGHT_M_S / 2,
        "step_hz": LIGHT_M_S / 2 / (count * lines.range_step_m),
        "pixels": case.pixels,
        "x_m": case.x_m,
        "y_m": case.y_m,
    }


def environment(requirement: str) -> Path:
    """Return the Python of an environment that holds a package from PyPI; make it if needed."""
    folder = cache_folder() / "peers" / requirement
    python = folder / "bin" / "python"
    if not (folder / "ready").exists():
        print(f"installing {requirement} in {folder}", file=sys.stderr)
        venv.create(folder, with_pip=True, clear=True)
        done = subprocess.run(
            [python, "-m", "pip", "install", "--quiet", requirement],
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            last = done.stderr.strip().splitlines()[-1:]
            raise PeerError(f"{requirement} cannot be installed: {''.join(last)}")
        (folder / "ready").touch()
    return python


@contextmanager
def worker(python: Path, program: Path, scene_file: Path) -> Iterator[Callable[..., str]]:
    """Yield a function that sends a request to a program of another code and returns its answer."""
    process = subprocess.Popen(
        [python, program, scene_file], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )

    def ask(*words: object) -> str:
        assert process.stdin is not None
        assert process.stdout is not None
        print(*words, file=process.stdin, flush=True)
        answer = process.stdout.readline().strip()
        if not answer:
            raise PeerError(f"{program.name} ended with {process.wait()}, its messages are above")
        return answer

    try:
        yield ask
    finally:
        assert process.stdin is not None
        process.stdin.close()
        process.wait()


def fastsar(ask: Callable[..., str], folder: Path) -> list[Method]:
    """Return FastSAR's exact images."""

    def form(interpolator: str, upsampling: int) -> tuple[float, NDArray[np.complex64]]:
        seconds = float(ask(interpolator, upsampling, folder / "image.npy"))
        return seconds, np.load(folder / "image.npy").T

    return [
        Method(f"FastSAR, {kind} on {factor}-fold upsampled lines", partial(form, kind, factor))
        for kind, factor in FASTSAR_SETTINGS
    ]


def ours(lines: clsas.RangeLines, grid: clsas.Grid, device: str) -> list[Method]:
    """Return the exact images of clsas."""

    def form(accuracy_db: float) -> tuple[float, NDArray[np.complex64]]:
        start = time.perf_counter()
        image = clsas.backproject(lines, grid, accuracy_db=accuracy_db, device=device)
        return time.perf_counter() - start, image.pixels

    return [
        Method(f"clsas, {device}, {level:g} dB asked for", partial(form, level))
        for level in ACCURACIES_DB
    ]


def error_db(
    pixels: NDArray[np.complex64], chosen: NDArray[np.int64], ideal: NDArray[np.complex128]
) -> float:
    """Return the relative rms error at some pixels, after the best common complex factor.

    Other codes scale images by their own windows and transforms.
    """
    found = pixels.ravel()[chosen].astype(np.complex128)
    factor = np.vdot(found, ideal) / np.vdot(found, found)
    return clsas.relative_error_db(factor * found, ideal)


def peers(devices: list[str], pixels: int, repeats: int = 3) -> None:
    """Print speed and true error of exact images by clsas and by other codes."""
    case = scene(pixels)
    lines, grid = case.lines(), case.grid
    chosen = np.random.default_rng(0).choice(grid.size, min(ERROR_PIXELS, grid.size), replace=False)
    ideal = reference.ideal(lines, grid.at(chosen))
    with ExitStack() as opened:
        folder = Path(opened.enter_context(tempfile.TemporaryDirectory()))
        np.savez(folder / "scene.npz", **as_radar(case, lines))
        methods = [method for device in devices for method in ours(lines, grid, device)]
        try:
            program = Path(__file__).with_name("fastsar_exact.py")
            ask = opened.enter_context(worker(environment(FASTSAR), program, folder / "scene.npz"))
            others = fastsar(ask, folder)
            errors_db = [error_db(each.form()[1], chosen, ideal) for each in others]
        except PeerError as error:
            print(f"FastSAR is not measured: {error}", file=sys.stderr)
            others, errors_db = [], []
        errors_db = [error_db(each.form()[1], chosen, ideal) for each in methods] + errors_db
        methods += others
        seconds: list[list[float]] = [[] for _ in methods]
        for _ in range(repeats):
            for method, taken in zip(methods, seconds, strict=True):
                taken.append(method.form()[0])
    pairs = lines.channels * grid.size
    rows = []
    for method, taken, found_db in zip(methods, seconds, errors_db, strict=True):
        middle = statistics.median(taken)
        spread = f"{middle:.3f} ({min(taken):.3f} to {max(taken):.3f})"
        rows.append([method.name, spread, f"{pairs / middle / 1e9:.2f}", f"{found_db:.1f}"])
    print(f"{lines.channels} channels, {pixels} x {pixels} pixels, every channel in every pixel\n")
    tables.table(["exact images", "seconds: median (min to max)", "GBP/s", "true error dB"], rows)
    print("\ntorchbp is not on PyPI and is not measured.", file=sys.stderr)
