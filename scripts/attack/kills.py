"""Kill mosaics with SIGKILL over and over, and check that finished patches stay intact.

    python scripts/attack/kills.py --kills 200 --workers 0 2 --exports 100

Every run is killed at a random moment: while it starts, or after some patches. Either all of its
processes are killed, or only the main process, or one worker. After every kill the finished patches
and their levels must equal those of a mosaic of as many workers that was never killed. After 10
kills the run may finish. The store must then equal the other bit by bit, with all levels, and there
must be no temporary files. Exports of the finished mosaic as GeoTIFF and as a viewer, and of a
radar image as SICD, are killed too: the file or folder before must still be there, or the whole new
one. In all other cases the exit code is 1.
"""

from __future__ import annotations

import argparse
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
from case import PATCHES, command, write_scene

import clsas
from clsas import Store

KILLS_PER_STORE = 10
ORPHANS_S = 60  # after which workers whose main process was killed must have ended
DEADLINE_S = 600  # for one run
WRITTEN = re.compile(rb"20\d\d-?\d\d-?\d\dT?\d\d:?\d\d:?\d\d")


class Miss(Exception):
    """A state that a kill must not leave behind."""


def run_and_kill(arguments: list[str], chance: random.Random, start_s: float, log: Path) -> str:
    """Start a run and kill it; return what was killed, or "nothing" if it finished before."""
    after = chance.randrange(12) if chance.random() < 0.7 else None
    wait_s = chance.uniform(0, 0.3) if after is not None else chance.uniform(0, start_s)
    with log.open("w") as output:
        process = subprocess.Popen(
            arguments, stderr=output, stdout=subprocess.DEVNULL, start_new_session=True
        )
    deadline = time.monotonic() + DEADLINE_S
    while after and process.poll() is None and log.read_text().count("\npatch ") < after:
        if time.monotonic() > deadline:
            raise Miss(f"a run takes more than {DEADLINE_S} s")
        time.sleep(0.01)
    time.sleep(wait_s)
    workers = [p for p in family(process.pid) if "--multiprocessing-fork" in " ".join(p.cmdline())]
    kinds = ["all"] + (["main", "worker"] if workers else [])
    kind = chance.choice(kinds)
    if process.poll() is not None:
        kind = "nothing"
    elif kind == "worker":
        chance.choice(workers).kill()
        # The others take over its work. If it was still starting, the run ends with one error.
        if process.wait(DEADLINE_S) and "while it started" not in log.read_text().split("\n")[-2]:
            raise Miss(f"a run did not survive the loss of a worker:\n{log.read_text()[-2000:]}")
    elif kind == "main":
        process.kill()
    else:
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    until = time.monotonic() + ORPHANS_S
    while orphans := in_session(process.pid):
        if time.monotonic() > until:
            raise Miss(f"{len(orphans)} processes outlive their run by {ORPHANS_S} s")
        time.sleep(0.05)
    if kind == "nothing" and process.returncode:
        raise Miss(f"a run failed with {process.returncode}:\n{log.read_text()[-2000:]}")
    return kind


def family(pid: int) -> list[psutil.Process]:
    """Return the processes that a process started."""
    try:
        return psutil.Process(pid).children(recursive=True)
    except psutil.NoSuchProcess:
        return []


def in_session(leader: int) -> list[int]:
    """Return the ids of the live processes in a session."""
    found = []
    for pid in psutil.pids():
        try:
            if os.getsid(pid) == leader and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE:
                found.append(pid)
        except (ProcessLookupError, psutil.NoSuchProcess):
            pass
    return found


def check_finished(path: Path, reference: Store) -> int:
    """Compare the finished patches with the reference, and return their number."""
    if not path.exists():
        return 0
    store = Store.opened(path)
    if damage := store.damage():
        raise Miss(f"damaged: {damage}")
    records = store.records()
    for index in records:
        for array in store.document.of_patches:
            for row, column in array.chunks(index):
                check_file(path, reference, f"{array.name}/c/{row}/{column}")
    return len(records)


def check_all(path: Path, reference: Store) -> None:
    """Compare all chunks, and the record of the levels that mix patches, with the reference."""
    names = [
        {str(each.relative_to(folder)) for each in folder.rglob("c/**/*") if each.is_file()}
        for folder in (path, reference.path)
    ]
    for name in names[0] | names[1] | {"levels/zarr.json"}:
        check_file(path, reference, name)
    if Store.opened(path).levels != reference.levels:
        raise Miss("levels are missing")


def check_file(path: Path, reference: Store, name: str) -> None:
    """Compare a file with that of the reference, bit by bit."""
    ours, theirs = (
        (each / name).read_bytes() if (each / name).exists() else None
        for each in (path, reference.path)
    )
    if ours != theirs:
        raise Miss(f"{name} differs")


def main() -> None:
    """Kill runs, check what they leave, and report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--kills", type=int, default=200, help="number of kills for each number of workers"
    )
    parser.add_argument(
        "--workers",
        type=int,
        nargs="+",
        default=[0, 2],
        help="numbers of workers; 0 for a single process",
    )
    parser.add_argument(
        "--exports", type=int, default=100, help="number of kills of exports of each kind"
    )
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    chance = random.Random(options.seed)
    try:
        with tempfile.TemporaryDirectory(prefix="kills-") as folder:
            for workers in options.workers:
                attack(Path(folder), workers, options.kills, chance)
            if options.exports:
                attack_exports(Path(folder), options.exports, chance)
    except Miss as miss:
        sys.exit(f"MISS: {miss}")
    print("no miss")


def attack(folder: Path, workers: int, kills: int, chance: random.Random) -> None:
    """Kill runs with a number of workers until there have been `kills` kills."""
    scene, log = write_scene(folder), folder / "log"
    reference = folder / f"reference-{workers}.zarr"
    # The first run, in one process, also simulates the lines.
    subprocess.run(command(scene, folder / "first.zarr"), check=True, capture_output=True)
    start = time.monotonic()
    subprocess.run(command(scene, reference, workers), check=True, capture_output=True)
    usual_s = time.monotonic() - start
    first = Store.opened(reference)
    done, stores, tally = 0, 0, {}
    while done < kills:
        path = folder / f"{workers}-{stores}.zarr"
        finished = 0
        for _ in range(min(KILLS_PER_STORE, kills - done)):
            kind = run_and_kill(command(scene, path, workers), chance, usual_s, log)
            tally[kind] = tally.get(kind, 0) + 1
            done += kind != "nothing"
            finished = check_finished(path, first)
            if finished == PATCHES:
                break
        subprocess.run(command(scene, path, workers), check=True, capture_output=True)
        if check_finished(path, first) != PATCHES:
            raise Miss(f"{path.name} is not finished")
        check_all(path, first)
        if left := [str(each) for each in folder.rglob("*.part")]:
            raise Miss(f"temporary files are left: {left}")
        stores += 1
    kinds = ", ".join(f"{kind} {count}" for kind, count in sorted(tally.items()))
    print(
        f"{workers or 'no'} workers: {done} kills ({kinds}), {stores} stores of {PATCHES} patches, "
        "all bit-identical, no temporary file left",
        flush=True,
    )


def attack_exports(folder: Path, kills: int, chance: random.Random) -> None:
    """Kill exports of each kind until there have been `kills` kills of it."""
    scene, store = write_scene(folder), folder / "exported.zarr"
    subprocess.run(command(scene, store), check=True, capture_output=True)
    image, lines = write_radar_image(folder)
    attack_export(store, folder / "map.tif", ["--crs", "EPSG:32632"], kills, chance)
    attack_export(store, folder / "viewer", [], kills, chance)
    attack_export(image, folder / "radar.nitf", ["--lines", str(lines)], kills, chance)


def attack_export(
    source: Path, name: Path, options: list[str], kills: int, chance: random.Random
) -> None:
    """Kill exports to one file or folder at random moments."""
    maps = name.parent / f"{name.name}-alone"
    maps.mkdir()
    made = maps / name.name
    arguments = [sys.executable, "-m", "clsas", "export", str(source), str(made), *options]
    others = ["--colour-map", "gray"] if not made.suffix else []
    subprocess.run([*arguments, *others], check=True, capture_output=True)
    if made.suffix:
        made.write_bytes(b"the file before")
    old = contents(made)
    kept = maps.parent / f"{name.name}-before"
    made.rename(kept)
    start = time.monotonic()
    subprocess.run(arguments, check=True, capture_output=True)
    usual_s = time.monotonic() - start
    whole = contents(made)
    done = finished = 0
    while done < kills:
        if made.is_dir():
            shutil.rmtree(made)
            shutil.copytree(kept, made)
        else:
            shutil.copyfile(kept, made)
        process = subprocess.Popen(
            arguments, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
        )
        time.sleep(chance.uniform(0, 1.1 * usual_s))
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            done += 1
        else:
            finished += 1
        process.wait()
        if contents(made) not in (old, whole):
            raise Miss(f"a killed export left {name.name} neither as it was nor as it should be")
    subprocess.run(arguments, check=True, capture_output=True)
    if contents(made) != whole or [each.name for each in maps.iterdir()] != [made.name]:
        raise Miss(f"an export of {name.name} after the kills differs, or leaves files behind")
    print(
        f"exports of {name.name}: {done} kills, {finished} finished before, each whole, "
        "none left over",
        flush=True,
    )


def contents(path: Path) -> dict[str, bytes]:
    """Return the contents of a file, or of the files in a folder, by their names.

    The times at which a SICD file was written are left out.
    """
    files = [each for each in path.rglob("*") if each.is_file()] if path.is_dir() else [path]
    read = {str(each.relative_to(path)): each.read_bytes() for each in files}
    return {name: WRITTEN.sub(b"", each) for name, each in read.items()}


def write_radar_image(folder: Path) -> tuple[Path, Path]:
    """Write an image of a radar, 8 MB, and its lines; return their paths."""
    along_m = np.linspace(-30, 30, 61)
    track_m = np.stack([along_m, np.full(61, 4000.0), np.full(61, 3000.0)], axis=1)
    place = clsas.Georeference.local(60.39, 5.32, heading_deg=217)
    lines = clsas.simulate_lines(
        track_m, track_m, clsas.PointTargets([[0, 0, 0]]), carrier_hz=9.6e9, bandwidth_hz=100e6,
        sound_speed_m_s=299_792_458.0,
    )  # fmt: skip
    pixels = np.random.default_rng(1).normal(size=(1000, 1000, 2)) @ [1, 1j]
    grid = clsas.Grid.plane((-450, 450, 1000), (-625, 625, 1000), georeference=place)
    paths = folder / "radar.h5", folder / "radar-lines.h5"
    clsas.save(paths[0], clsas.Image(pixels, grid))
    clsas.save(paths[1], replace(lines, georeference=place))
    return paths


if __name__ == "__main__":
    main()
