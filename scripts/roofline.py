"""Main loops of the kernels compared with the limits of a CPU: `scripts/bench roofline`.

A separate process forms small images of the cases with PoCL, which stores its machine code in a
cache. The main loop of a kernel is the innermost loop with the most multiply-adds. objdump
(binutils) disassembles it, and llvm-mca (Debian: llvm) schedules it on the ports of a processor.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from peers import scenes
from studies import tables

import clsas
from clsas.engine.device.device import open_device
from clsas.selftest import cases

PROCESSORS = ("haswell", "znver3", "icelake-server")
ITERATIONS = 200
REPEATS = 5
KERNELS = ("backproject_tiles", "backproject_points", "stage")
IMAGES = {"bp-2k": (-50.0, -80.0), "ffbp-2k": (-50.0,), "ffbp-relief": (-50.0,)}
PIXELS = 384  # along each side of the part of bp-2k that is formed


class RooflineError(Exception):
    """A tool that reads machine code is missing, or the device does not store machine code."""


@dataclass(frozen=True)
class Loop:
    """A kernel's main loop, as lines of assembly without addresses."""

    lines: tuple[str, ...]

    def count(self, pattern: str) -> int:
        """Return the number of instructions that match a pattern."""
        return sum(bool(re.search(pattern, line)) for line in self.lines)

    @property
    def multiply_adds(self) -> int:
        """Number of fused multiply-adds of vectors."""
        return self.count(r"^vfn?m(add|sub)\w+p[sd] ")


def main_loop(library: Path) -> Loop:
    """Return the innermost loop with the most multiply-adds of a shared library."""
    text = _output("objdump", "-d", "--no-show-raw-insn", str(library))
    found = re.findall(r"^\s+([0-9a-f]+):\t([^#\n]*)", text, re.MULTILINE)
    number = {int(address, 16): index for index, (address, _) in enumerate(found)}
    loops = []
    for index, (_, line) in enumerate(found):
        jump = re.match(r"j[a-z]+\s+([0-9a-f]+)\b", line)
        start = number.get(int(jump[1], 16), index) if jump else index
        if start < index:
            loops.append((start, index))
    inner = [
        loop
        for loop in loops
        if not any(loop != other and loop[0] <= other[0] <= other[1] <= loop[1] for other in loops)
    ]
    bodies = [Loop(tuple(line.strip() for _, line in found[a : b + 1])) for a, b in inner]
    if not bodies:
        raise RooflineError(f"{library.name} has no loop")
    return max(bodies, key=lambda loop: loop.multiply_adds)


def counts(loop: Loop) -> dict[str, int]:
    """Return the number of instructions in a loop, and the number of each kind."""
    return {
        "instructions": len(loop.lines),
        "multiply-adds": loop.multiply_adds,
        "permutes": loop.count(r"^vperm|^vblendv|^vshuf|^vunpck|^vp?align"),
        "memory operands": loop.count(r"^v.*\("),
        "on the stack": loop.count(r"^v.*\(%r[sb]p"),
    }


def scheduled(loop: Loop, processor: str) -> tuple[str, str]:
    """Return the cycles of an iteration on a processor, and its busiest port with its cycles.

    Both are "-" if the processor lacks instructions of the loop.
    """
    lines = [re.sub(r"^(j[a-z]+)\s.*", r"\1 .L0", line) for line in loop.lines]
    lines = [re.sub(r"0x[0-9a-f]+\(%rip\)|<.*>", ".LC0(%rip)", line) for line in lines]
    with tempfile.NamedTemporaryFile("w", suffix=".s") as file:
        file.write("\n".join([".L0:", *lines, ""]))
        file.flush()
        try:
            text = _output(
                "llvm-mca", f"-mcpu={processor}", f"-iterations={ITERATIONS}", "-json", file.name
            )
        except RooflineError:
            return "-", "-"
    report = json.loads(text[text.index("{") :])
    region = report["CodeRegions"][0]
    cycles = region["SummaryView"]["TotalCycles"] / ITERATIONS
    names = report["TargetInfo"]["Resources"]
    usage = region["ResourcePressureView"]["ResourcePressureInfo"]
    whole = max(each["InstructionIndex"] for each in usage)  # the entry with the sum of all
    busy = {
        names[each["ResourceIndex"]]: each["ResourceUsage"]
        for each in usage
        if each["InstructionIndex"] == whole
    }
    port = max(busy, key=lambda name: busy[name])
    return f"{cycles:.0f}", f"{port} {busy[port]:.0f}"


def table(device: str | None) -> None:
    """Print the main loops of the kernels that form the images of the cases."""
    for tool, package in (("objdump", "binutils"), ("llvm-mca", "llvm")):
        if not shutil.which(tool):
            raise RooflineError(f"{tool} is not installed (Debian: apt install {package})")
    info = open_device(device or "portable").info
    rows = []
    for case, accuracies_db in IMAGES.items():
        for accuracy_db in accuracies_db:
            with tempfile.TemporaryDirectory() as cache:
                times = _formed(case, accuracy_db, info.index, cache)
                for library in sorted(Path(cache).rglob("*.so")):
                    if library.stem in KERNELS:
                        row = [case, f"{accuracy_db:g}", library.stem]
                        rows.append(row + _row(main_loop(library), times[library.stem]))
    print(f"{info.name}, {info.driver}, vectors of {info.width}; cycles by llvm-mca\n")
    header = ["case", "dB", "kernel", "ms", *counts(Loop(()))]
    for processor in PROCESSORS:
        header += [f"{processor}: cycles", "busiest port"]
    tables.table(header, rows)


def _row(loop: Loop, milliseconds: float) -> list[str]:
    row = [f"{milliseconds:.1f}", *map(str, counts(loop).values())]
    for processor in PROCESSORS:
        row += scheduled(loop, processor)
    return row


def _formed(case: str, accuracy_db: float, device: int, cache: str) -> dict[str, float]:
    """Return the least milliseconds of every kernel, from images with an empty kernel cache."""
    environment = dict(os.environ, POCL_CACHE_DIR=cache)
    words = [sys.executable, __file__, case, str(accuracy_db), str(device)]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RooflineError(done.stderr.strip().splitlines()[-1])
    times = json.loads(done.stdout.splitlines()[-1])
    if not any(Path(cache).rglob("*.so")):
        raise RooflineError("this device stores no machine code; the table needs PoCL on a CPU")
    return times


def _form(case: str, accuracy_db: float, index: int) -> dict[str, float]:
    device = open_device(index)
    factorized = case in cases.FACTORIZED_CASES
    scene = cases.FACTORIZED_CASES[case] if factorized else scenes.straight(PIXELS)
    lines, grid = scene.lines(), scene.grid
    found: dict[str, float] = {}
    plan = None
    if factorized:
        plan = clsas.plan(lines, grid, tolerance_db=accuracy_db, beam=scene.beam, device=device)
    for _ in range(REPEATS):
        with device.profile() as times:
            if plan:
                clsas.factorize(lines, grid, plan, device=device)
            else:
                clsas.backproject(lines, grid, accuracy_db=accuracy_db, device=device)
        for name, time in times.items():
            found[name] = min(found.get(name, 1e30), 1e3 * time.total_s)
    return found


def _output(*words: str) -> str:
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RooflineError(f"{words[0]} failed: {done.stderr.strip().splitlines()[-1]}")
    return done.stdout


if __name__ == "__main__":
    print(json.dumps(_form(sys.argv[1], float(sys.argv[2]), int(sys.argv[3]))))
