"""Command that forms an image patch by patch: mosaic."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Annotated, Any

import click
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

import clsas
from clsas.cli import options
from clsas.cli.inputs import (
    check_levels,
    read_beam,
    read_grid,
    read_request,
    read_scene,
    warn_of_sampling,
)
from clsas.cli.outputs import described_flags, printable, progress_bar, report, say
from clsas.cli.parameters import COUNTS, INPUT, File, Store, keep_apart, keep_out
from clsas.cli.wording import command
from clsas.engine.data.declared import Count
from clsas.engine.data.extras import needed
from clsas.engine.data.threads import uninterrupted
from clsas.engine.data.validate import ArgumentError
from clsas.engine.device.device import open_device
from clsas.engine.exact.decide import ACCURACY_DB
from clsas.engine.factorized.plan import ExactImage
from clsas.files.scene_files import SceneFile, simulation_digest
from clsas.files.scene_tables import PLAN_KEYS, MosaicTable
from clsas.mosaics.document import MosaicCertificate, check_place, requested_db
from clsas.mosaics.patches import patch_shape_of

_SCHEDULER_S = 10  # how long a scheduler may take to answer; arbitrary
_IDLE_S = 60.0  # default of --idle-s


@contextmanager
def _cluster(
    workers: Annotated[int | None, Count(help="Number of worker processes.")] = None,
    scheduler: str | None = None,
) -> Iterator[Any]:
    """Yield a client of a Dask cluster, or None if no cluster is requested."""
    if workers is None and scheduler is None:
        yield None
        return
    with needed("--workers and --scheduler"):
        from distributed import Client
        from distributed.scheduler import KilledWorker

        from clsas.mosaics.workers import local_client
    with ExitStack() as opened:
        if scheduler is not None:
            try:
                with uninterrupted():
                    client = opened.enter_context(Client(scheduler, timeout=_SCHEDULER_S))
            except (OSError, ValueError) as error:
                raise click.ClickException(
                    f"--scheduler {scheduler} cannot be reached: {error}"
                ) from None
        elif workers is not None:
            client = opened.enter_context(local_client(workers))
        try:
            yield client
        except KilledWorker as error:
            raise click.ClickException(
                f"workers ended unexpectedly several times on one block of patches: {error}"
            ) from None


@command()
@click.argument("scene", metavar="[SCENE.TOML]", type=INPUT, required=False)
@click.option(
    "--lines", "lines_path", type=File(exists=True),
    help="File of range lines, or folder of such files. [default: simulated from the scene]",
)  # fmt: skip
@click.option(
    "-o", "--output", type=Store(),
    help="Zarr store to write or to continue. [default: SCENE.zarr beside the scene]",
)  # fmt: skip
@options.axes
@options.method
@click.option(
    "--exact", is_flag=True, help="Form exact patches. --accuracy-db implies this option."
)
@options.of(ExactImage, "accuracy_db", into="request")
@options.beam
@options.promise
@options.of(MosaicTable, "patches", "memory_mib", into="divided", types={"patches": COUNTS})
@click.option("--device", multiple=True, help="Device to use; repeat the option to use several.")
@options.of(_cluster, "workers", into="cluster")
@click.option("--scheduler", metavar="ADDRESS", help="Use a Dask cluster, such as tls://host:8786.")
@click.option("--follow", is_flag=True, help="Wait for files to be added to the folder --lines.")
@options.of(
    clsas.mosaic, "follow_s", into="idle", called={"follow_s": ("--idle-s",)}, beside="--follow",
    default=f"{_IDLE_S:g}",
)  # fmt: skip
@click.option(
    "--verify", is_flag=True,
    help="Form nothing; compare the whole store with its checksums.",
)  # fmt: skip
@options.picture("an overview in dB")
@options.levels
@click.option("--borders", is_flag=True, help="Draw the borders between patches into the picture.")
@options.as_json
@options.refusing_unreached
def mosaic(
    scene: Path | None,
    lines_path: Path | None,
    output: Path | None,
    axes: dict[str, Any],
    request: dict[str, Any],
    exact: bool,
    beam: dict[str, Any],
    promise: dict[str, Any],
    divided: dict[str, Any],
    device: tuple[str, ...],
    cluster: dict[str, Any],
    scheduler: str | None,
    follow: bool,
    idle: dict[str, Any],
    verify: bool,
    picture: Path | None,
    levels: dict[str, Any],
    borders: bool,
    as_json: bool,
) -> None:
    """Form an image of any size, patch by patch.

    The patches are written to a Zarr store. Specify grid, method and beam as for `clsas image`.
    Without --lines, the scene is simulated first. Without a scene, --lines, --x, --y and -o are
    required.

    After an interruption, by Ctrl-C or anything else, the same command continues, and forms damaged
    patches again. With --verify it only lists damage; the exit code is then 1 if there is any.

    A store contains the image at 2, 4, 8, ... times the pixel spacing too, which pictures are drawn
    from.

    \b
    Example:  clsas mosaic scene.toml --lines lines.h5 -o image.zarr --picture image.png
    """
    if verify:
        _verify(_existing_store(scene, output), as_json)
        return
    if scene is None:
        _check_without_scene(bool(axes), lines_path, output)
    _check_combination(bool(device), bool(cluster), scheduler, follow, bool(idle))
    check_levels(levels)
    described, grid = read_grid(scene, axes, memory=False)
    request = _read_request(described, request, exact)
    window = read_beam(described, beam)
    warn_of_sampling(described, grid)
    devices = [open_device(name) for name in device] or None
    in_scene = described.mosaic
    output = output or in_scene.get("store") or _store_beside(scene)
    memory_mib = divided.get("memory_mib") or in_scene.get("memory_mib")
    if patches := divided.get("patches") or in_scene.get("patches"):
        patch_shape_of(patches, grid)  # before anything is simulated
    recorded = lines_path or in_scene.get("lines")
    _check_paths(output, picture, recorded, follow)
    check_place(output.resolve())  # before anything is simulated
    lines_path = recorded or _simulated(described, scene, output, picture, quiet=as_json)
    start = time.perf_counter()
    with _cluster(**cluster, scheduler=scheduler) as client:
        formed = clsas.mosaic(
            lines_path, grid, output, **request, beam=window, patches=patches,
            memory_bytes=memory_mib and memory_mib << 20, device=devices,
            client=client, **(described.promise | promise),
            follow_s=idle.get("follow_s", _IDLE_S) if follow else None,
        )  # fmt: skip
        before = len(formed.finished)
        new, pixels = _form(formed, output.name, quiet=as_json)
    seconds = time.perf_counter() - start
    store = clsas.Store.opened(output)
    if picture is not None:
        from clsas import plot

        plot.save(plot.mosaic(store, borders=borders, **levels), picture)
    words, figures = _results(formed, store)
    rate = pixels / seconds
    done = f"{new} formed in {seconds:.2f} s ({rate / 1e6:.3g} Mpixel/s)" if new else "none to form"
    words[0] += f", {done}" + (f", {before} finished before" if before else "")
    figures |= {"formed": new, "before": before, "seconds": seconds, "pixels_per_s": rate}
    report(
        as_json, f"{printable(output)}: {''.join(words)}", file=output, picture=picture, **figures
    )


def _check_without_scene(has_grid: bool, lines_path: Path | None, output: Path | None) -> None:
    """Raise UsageError, with what is missing, unless options replace the scene."""
    wanted = {"--lines": lines_path, "--x and --y": has_grid or None, "-o": output}
    missing = [option for option, value in wanted.items() if value is None]
    if missing:
        raise click.UsageError(f"without SCENE.TOML, give {', '.join(missing)} too")


def _check_combination(
    has_device: bool, has_workers: bool, scheduler: str | None, follow: bool, has_idle: bool
) -> None:
    """Raise UsageError for options that exclude or require each other."""
    if has_workers and scheduler is not None:
        raise click.UsageError("give only one of --workers and --scheduler")
    if has_device and (has_workers or scheduler):
        raise click.UsageError("--device has no effect with --workers or --scheduler")
    if has_idle and not follow:
        raise click.UsageError("--idle-s requires --follow")


def _check_paths(output: Path, picture: Path | None, lines_path: Path | None, follow: bool) -> None:
    """Raise UsageError if files would replace each other, or --follow has no folder."""
    keep_apart("--picture", picture, "the store", output)
    keep_out("--picture", picture, "the store", output)
    keep_apart("the range lines", lines_path, "the store", output)
    if follow and (lines_path is None or not lines_path.is_dir()):
        raise click.UsageError("--follow requires --lines with a folder")


def _read_request(described: SceneFile, given: dict[str, Any], exact: bool) -> dict[str, Any]:
    """Return the request for every block, which is one of `PLAN_KEYS` or an accuracy."""
    request = read_request(described, given, exact)
    if ignored := set(request) - {*PLAN_KEYS, "accuracy_db"}:
        allowed = "be left out for a mosaic, in which it has no effect"
        raise ArgumentError(min(ignored), allowed, where=f"{described.name}: [image]")
    return request or {"accuracy_db": ACCURACY_DB}


def _form(formed: clsas.Mosaic, name: str, *, quiet: bool) -> tuple[int, int]:
    """Form the patches that are not finished; return the number of patches and of their pixels.

    Unless `quiet`, a line is printed for every patch.
    """
    pixels: dict[tuple[int, int], int] = {}  # by patch, since patches may be formed again
    with _patch_progress(name, len(formed), len(formed.finished)) as show_patch:
        for patch in formed:
            pixels[patch.row, patch.column] = patch.grid.size
            if not quiet:
                show_patch(patch, len(pixels))
    return len(pixels), sum(pixels.values())


def _results(formed: clsas.Mosaic, store: clsas.Store) -> tuple[list[str], dict[str, Any]]:
    """Return patches, errors and flags of a mosaic: in words, and in types of JSON.

    The first item of the words describes the patches.
    """
    records = store.records()
    certificate = MosaicCertificate.of(records)
    # Errors are relative to the image, so they are undefined for a patch of zeros.
    errors = [record.predicted_error_db for record in records.values() if record.has_pixels]
    worst = max((error for error in errors if error is not None), default=None)
    zero = bool(records) and not any(record.has_pixels for record in records.values())
    flagged = {index: record.flags for index, record in records.items() if record.flags}
    rows, columns = formed.patch_shape
    words = [f"{' x '.join(map(str, formed.shape))} patches of {rows} x {columns} pixels"]
    if zero:
        words.append("; all pixels are zero")
    elif worst is not None:
        words.append(f"; predicted error at most {worst:.1f} dB")
    if certificate is not None:
        requested = requested_db(store.document.inputs)
        words.append(f"\n  {certificate.describe(requested)}")
    words += [f"\n{line}" for line in described_flags(flagged)]
    return words, {
        "shape": formed.grid.shape,
        "patches": formed.shape,
        "patch_shape": formed.patch_shape,
        "finished": len(records),
        "predicted_error_db": worst,
        "certificate": None if certificate is None else certificate.figures,
        "is_zero": zero,
        "flags": {f"{row},{column}": flags for (row, column), flags in flagged.items()},
        "seconds_of_patches": sum(record.seconds for record in records.values()),
    }


def _store_beside(scene: Path | None) -> Path:
    """Return the default store of a scene; a usage error without a scene."""
    if scene is None:
        raise click.UsageError("a store is required: -o STORE.zarr, or a scene")
    return scene.with_suffix(".zarr")


def _existing_store(scene: Path | None, output: Path | None) -> Path:
    """Return the store to verify: the one given, or that of the scene."""
    if output is not None:
        return output
    if scene is None:
        raise click.UsageError("--verify requires a store: clsas mosaic --verify -o STORE.zarr")
    return read_scene(scene).mosaic.get("store") or _store_beside(scene)


def _verify(path: Path, as_json: bool) -> None:
    """Report which patches and arrays of a store are damaged; exit with code 1 if any is."""
    store = clsas.Store.opened(path)
    arrays = store.array_damage()
    with progress_bar("verifying") as progress:
        damage = store.damage(progress)
    finished = sum(index not in damage for index in store.records())
    damaged = {f"{row},{column}": reason for (row, column), reason in damage.items()}
    summary = f"{len(damage)} damaged" if damage else "none damaged"
    lines = [f"{printable(path)}: {finished} patches match their checksums, {summary}"]
    lines += [f"  {name}: {printable(reason)}" for name, reason in arrays.items()]
    lines += [f"  patch {index}: {printable(reason)}" for index, reason in damaged.items()]
    report(
        as_json, "\n".join(lines), file=path, finished=finished, damaged=damaged,
        damaged_arrays=arrays,
    )  # fmt: skip
    if damage or arrays:
        click.get_current_context().exit(1)


def _beside(output: Path, scene: Path) -> Path:
    """Return the path of a scene's simulated range lines, in the folder of the store."""
    digest = simulation_digest(scene.read_bytes(), scene.parent)
    return output.with_name(f"{output.stem}-{digest}.lines.h5")


def _simulated(
    described: SceneFile, scene: Path | None, output: Path, picture: Path | None, *, quiet: bool
) -> Path:
    """Return the file of a scene's range lines beside the store; simulate it if it is missing.

    Unless `quiet`, a line reports which of the two was done.
    """
    assert scene is not None  # without one, --lines is required
    path = _beside(output, scene)
    keep_apart("--picture", picture, "the simulated range lines", path)
    if path.exists():
        if not quiet:
            say(f"{printable(path)}: range lines, simulated before", err=True)
        return path
    sonar, track, targets = described.need("sonar", "track", "targets")
    with progress_bar("simulating") as progress:
        echoes = clsas.simulate(sonar, track, targets, **described.simulate, progress=progress)
    with progress_bar("compressing") as progress:
        clsas.save(path, clsas.compress(echoes, **described.compress, progress=progress))
    if not quiet:
        say(f"{printable(path)}: range lines, simulated from {printable(scene)}", err=True)
    return path


@contextmanager
def _patch_progress(
    name: str, total: int, done: int
) -> Iterator[Callable[[clsas.Patch, int], None]]:
    """Yield a function that prints a line for a patch and, on a terminal, moves a progress bar."""
    columns = (
        TextColumn("{task.description}", markup=False), BarColumn(),
        TextColumn("{task.completed}/{task.total}"), TaskProgressColumn(), TimeRemainingColumn(),
    )  # fmt: skip
    console = Console(stderr=True, soft_wrap=True, highlight=False)
    with Progress(
        *columns, console=console, transient=True, disable=not console.is_terminal
    ) as bar:
        task = bar.add_task(printable(name), total=total, completed=done)

        def show_patch(patch: clsas.Patch, formed: int) -> None:
            record = patch.record
            parts = [f"{record.seconds:.2f} s", f"{record.channels} channels"]
            if not record.has_pixels:
                parts.append("all pixels are zero")
            elif record.predicted_error_db is not None:
                parts.append(f"predicted error {record.predicted_error_db:.1f} dB")
            line = f"patch {patch.row},{patch.column}: {', '.join((*parts, *record.flags))}"
            console.print(printable(line), markup=False)
            bar.update(task, completed=done + formed)

        yield show_patch
