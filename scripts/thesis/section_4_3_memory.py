#!/usr/bin/env python3
"""THESIS section 4.3, memory: exact, nearest-beam and interpolated images beside the final image.

Banks (2002, quoted in the thesis) needs about the memory of the final image. All buffers that the
device holds at once while an image is formed are added up. CPUs write into the image itself, which
is then one of these buffers.
"""

from __future__ import annotations

import argparse
import re
import warnings
import weakref
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from unittest import mock

import chapter5
import pyopencl as cl
from section_7_1 import EXACT_IS_SLOW, SYSTEMS

import clsas
from clsas.engine.device.device import Device, open_device

TOLERANCE_DB = -40.0
STAGES = ((8, 8), (2, 2))
SIZES = (256, 512, 1024, 2048)  # of the scene of chapter 5


@dataclass
class Held:
    """Bytes that OpenCL buffers hold, now and at most."""

    now: int = 0
    most: int = 0

    def add(self, buffer: cl.Buffer) -> None:
        """Count a buffer until it is released."""
        self.now += buffer.size
        self.most = max(self.most, self.now)
        weakref.finalize(buffer, self._release, buffer.size)

    def _release(self, size: int) -> None:
        self.now -= size


def peak_bytes(form: Callable[[], clsas.Image]) -> int:
    """Return the most bytes that buffers hold at once while an image is formed.

    The image itself is among them if the device writes into it.
    """
    held = Held()

    class Buffer(cl.Buffer):
        def __init__(self, *arguments: object, **options: object) -> None:
            super().__init__(*arguments, **options)
            held.add(self)

    with mock.patch.object(cl, "Buffer", Buffer):
        form()
    return held.most


def cases(
    device: Device, pixels: int | None
) -> Iterator[tuple[str, clsas.RangeLines, clsas.Grid, clsas.BeamWindow | None]]:
    """Yield the name, lines, grid and beam of every case."""
    for size in SIZES if pixels is None else (pixels,):
        scene = chapter5.Scene(device, size, points=50)
        yield "chapter 5", scene.lines, scene.grid, None
    for system in SYSTEMS:
        if pixels is not None:
            system = replace(system, pixels=pixels)
        yield system.name, system.lines, system.grid, system.beam


def least_mib(request: Callable[..., clsas.Plan]) -> str:
    """Return the least memory within which an image can be formed, however slowly, MiB."""
    try:
        request(memory_bytes=1)
    except ValueError as error:
        stated = re.search(r"at least ([0-9.]+) MiB", str(error))
        if stated is None:
            raise
        return stated[1]
    raise AssertionError("no image is formed within a byte")


def row_of(
    name: str,
    lines: clsas.RangeLines,
    grid: clsas.Grid,
    beam: clsas.BeamWindow | None,
    device: Device,
) -> dict[str, object]:
    """Return a row of the table."""
    asked = partial(clsas.plan, lines, grid, beam=beam, device=device)
    tolerated = partial(asked, tolerance_db=TOLERANCE_DB, costs=EXACT_IS_SLOW)
    plans = {
        "exact": asked(stages=[]),
        "nearest": asked(stages=STAGES),
        "interpolated": tolerated(),
    }
    image_bytes = 8 * grid.size
    row: dict[str, object] = {
        "scene": name,
        "channels": lines.channels,
        "pixels": f"{grid.shape[0]} x {grid.shape[1]}",
        "image MiB": f"{image_bytes / 2**20:.1f}",
        "lines MiB": f"{lines.samples.nbytes / 2**20:.1f}",
    }
    for method, plan in plans.items():
        if plan.is_exact and method != "exact":
            row |= {f"{method}, MiB": "", f"{method} over image": ""}
            continue
        held = peak_bytes(partial(clsas.factorize, lines, grid, plan, device=device))
        row[f"{method}, MiB"] = f"{held / 2**20:.1f}"
        row[f"{method} over image"] = f"{held / image_bytes:.1f}"
    return row | {"least, MiB": "" if plans["interpolated"].is_exact else least_mib(tolerated)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    chapter5.add_output(parser)
    parser.add_argument("--pixels", type=int, help="pixels along each side of every scene")
    given = parser.parse_args()
    device = open_device(given.device)
    out = chapter5.Output.of(given, device)
    rows = []
    for case in cases(device, given.pixels):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", clsas.ClsasWarning)
            rows.append(row_of(*case, device))
        print(*rows[-1].values(), sep=" | ", flush=True)
    chapter5.report(out, "section_4_3_memory", rows)


if __name__ == "__main__":
    main()
