"""Comparison of other codes with clsas: `scripts/bench peers`.

All codes form the same images, in turns. Each code runs in a separate process. Other codes have
environments of their own in the cache folder. FastSAR comes from PyPI, torchbp from a checkout.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from peers import scenes
from peers.codes import Code, Method, installed, methods
from peers.workers import worker
from studies import tables

from clsas.selftest import reference

ERROR_PIXELS = 1000
_LONG_S = 60.0  # an image that takes longer is formed only once
SIZES = (256, 512, 1024, 2048)
COLUMNS = ("image", "code", "settings", "seconds: median (min to max)", "planning s", "GBP/s")


@dataclass
class Measured:
    """Times and error of a method on a number of cores, or the reason why it refused."""

    method: Method
    cores: int | None
    planning: float = 0.0
    seconds: list[float] = field(default_factory=list)
    error_db: float = np.nan
    refused: str = ""

    @property
    def median(self) -> float:
        """Median of the seconds."""
        return statistics.median(self.seconds)


def error_db(
    pixels: NDArray[np.complex64], chosen: NDArray[np.int64], ideal: NDArray[np.complex128]
) -> float:
    """Return the rms error at some pixels over the rms of the image, dB.

    The best common complex factor is removed first, since other codes scale images by their windows
    and transforms. The level is that of all pixels, since few pixels of an image of points are
    bright.
    """
    found = pixels.ravel()[chosen].astype(np.complex128)
    factor = np.vdot(found, ideal) / np.vdot(found, found)
    error = np.linalg.norm(factor * found - ideal) / np.sqrt(len(chosen))
    level = np.abs(factor) * np.linalg.norm(pixels) / np.sqrt(pixels.size)
    return float(20 * np.log10(max(error / level, np.finfo(float).tiny)))


def measure(
    scene: scenes.Scene,
    codes: dict[str, Code],
    chosen: Iterable[Method],
    cores: Sequence[int | None] = (None,),
    repeats: int = 3,
) -> list[Measured]:
    """Return times and errors of methods for a scene, measured in turns.

    The first image of each method is not timed, unless it takes more than a minute. The method then
    forms no further image.
    """
    lines, grid = scene.lines(), scene.grid
    count = min(ERROR_PIXELS, grid.size)
    pixels = np.random.default_rng(0).choice(grid.size, count, replace=False)
    ideal = reference.ideal(lines, grid.at(pixels))
    here = [method for method in chosen if method.code in codes]
    found = [Measured(method, each) for method in here for each in cores]
    with ExitStack() as opened:
        folder = Path(opened.enter_context(tempfile.TemporaryDirectory()))
        image_file = folder / "image.npy"
        scenes.write(folder / "scene.npz", scene, lines)
        asks = {
            (name, each): opened.enter_context(
                worker(codes[name].python, codes[name].program, folder / "scene.npz", each)
            )
            for name in {method.code for method in here}
            for each in cores
        }
        for turn in range(1 + repeats):
            for one in found:
                if one.refused or any(seconds > _LONG_S for seconds in one.seconds):
                    continue
                ask = asks[one.method.code, one.cores]
                answer = ask(image_file=str(image_file), **one.method.settings)
                if "refused" in answer:
                    one.refused = answer["refused"]
                    continue
                if turn == 0:
                    one.planning = answer["planning"]
                    one.error_db = error_db(np.load(image_file), pixels, ideal)
                if turn > 0 or answer["seconds"] > _LONG_S:
                    one.seconds.append(answer["seconds"])
    return found


def row(one: Measured, pairs: int) -> list[str]:
    """Return the row of a method in the table of a track."""
    method = one.method
    name = [method.kind, method.code, method.words]
    if one.refused:
        return [*name, f"refused: {one.refused}", "", "", ""]
    return [
        *name,
        f"{one.median:.3f} ({min(one.seconds):.3f} to {max(one.seconds):.3f})",
        f"{one.planning:.2f}",
        f"{pairs / one.median / 1e9:.2f}",
        f"{one.error_db:.1f}",
    ]


def _in_words(one: Measured) -> str:
    return "refused" if one.refused else f"{one.median:.3f} s, {one.error_db:.0f} dB"


def _print_absent(absent: dict[str, str]) -> None:
    for name, reason in absent.items():
        print(f"\n{name} is not measured: {reason}")


def _describe(track: str, scene: scenes.Scene, pixels: int) -> None:
    print(f"\n{track}: {scene.channels} channels, {pixels} x {pixels} pixels,", end=" ")
    print("every channel in every pixel\n")


def peers(
    devices: list[str], tracks: Iterable[str], pixels: int | None, torchbp: Path | None
) -> None:
    """Print times and true errors of exact and factorized images by all codes, for each track."""
    codes, absent = installed(torchbp)
    for track in tracks:
        side = pixels or scenes.PIXELS[track]
        scene = scenes.TRACKS[track](side)
        pairs = scene.channels * scene.grid.size
        _describe(track, scene, side)
        found = measure(scene, codes, methods(devices))
        tables.table([*COLUMNS, "true error dB"], [row(one, pairs) for one in found])
    _print_absent(absent)


def peers_scaling(
    devices: list[str], tracks: Iterable[str], largest: int, torchbp: Path | None
) -> None:
    """Print times and errors with the codes' best settings, by the number of pixels."""
    codes, absent = installed(torchbp)
    best = [method for method in methods(devices) if method.best]
    sizes = [size for size in SIZES if size <= largest]
    for track in tracks:
        found = []
        for size in sizes:
            print(f"{track}, {size} x {size} pixels", file=sys.stderr, flush=True)
            found.append(measure(scenes.TRACKS[track](size), codes, best))
        print(f"\n{track}: median of 3 images (of 1 that takes over a minute), and error\n")
        rows = []
        for several in zip(*found, strict=True):
            method = several[0].method
            grows = ""
            if not any(one.refused for one in several):
                fitted = tables.growth(sizes, [one.median for one in several])
                grows = f"N^{fitted.exponent:.2f}"
            name = f"{method.code}, {method.words}"
            rows.append([method.kind, name, *map(_in_words, several), grows])
        tables.table(["image", "code, settings", *(f"N = {n}" for n in sizes), "for large N"], rows)
    _print_absent(absent)


def peers_cores(
    devices: list[str],
    tracks: Iterable[str],
    pixels: int | None,
    cores: Sequence[int],
    torchbp: Path | None,
) -> None:
    """Print times with the codes' best settings, by the number of cores."""
    codes, absent = installed(torchbp)
    best = [method for method in methods(devices) if method.best]
    for track in tracks:
        side = pixels or scenes.PIXELS[track]
        scene = scenes.TRACKS[track](side)
        _describe(track, scene, side)
        found = measure(scene, codes, best, cores)
        rows = []
        for begin in range(0, len(found), len(cores)):
            several = found[begin : begin + len(cores)]
            method = several[0].method
            gain = ""
            if not any(one.refused for one in several):
                gain = f"{several[0].median / several[-1].median:.2f}"
            name = f"{method.code}, {method.words}"
            rows.append([method.kind, name, *map(_in_words, several), gain])
        counts = [f"{each} core{'s' * (each > 1)}" for each in cores]
        tables.table(["image", "code, settings", *counts, "gain"], rows)
    _print_absent(absent)
