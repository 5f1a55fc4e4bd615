"""Times of forming a large mosaic and of exporting it, by the commands that a user would run."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import clsas
from clsas.files.scene_files import built_in_scene
from clsas.selftest import wreck

SIDE, PATCHES = 20_000, "5x5"
PLACE = "[georeference]\nlatitude_deg = 59.4245\nlongitude_deg = 10.4912\nheading_deg = 214.0\n"
COLUMNS = ["what", "seconds", "processor seconds", "peak memory, MiB", "result, MB"]
EXPORTS = {
    "GeoTIFF, 8-bit levels": ("wreck-8bit.tif", "--as", "8bit"),
    "GeoTIFF, dB": ("wreck.tif",),
    "GeoTIFF, complex": ("wreck-complex.tif", "--as", "complex"),
    "web page": ("web",),
}
Row = list[object]


def rows(device: str) -> list[Row]:
    """Return the times for a mosaic of the wreck, of 20 000 x 20 000 pixels in 5 x 5 patches.

    The GeoTIFFs are validated by rio-cogeo.
    """
    from rio_cogeo.cogeo import cog_validate

    x_m, y_m = wreck.X_M, wreck.Y_M
    grid = (f"--x={x_m[0]}:{x_m[1]}:{SIDE}", f"--y={y_m[0]}:{y_m[1]}:{SIDE}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "wreck.toml").write_text(f"{built_in_scene('wreck').decode()}\n{PLACE}")
        clsas.save(folder / "lines.h5", wreck.lines())
        forming: tuple[str, ...] = (
            "mosaic",
            "wreck.toml",
            "--lines",
            "lines.h5",
            "-o",
            "wreck.zarr",
            *grid,
        )
        forming += ("--patches", PATCHES, "--device", device)
        found = [measured("forming the mosaic with its levels", folder, "wreck.zarr", *forming)]
        for what, (made, *options) in EXPORTS.items():
            found.append(measured(what, folder, made, "export", "wreck.zarr", made, *options))
            if made.endswith(".tif"):
                is_valid, errors, warnings = cog_validate(folder / made, strict=True)
                assert is_valid, (errors, warnings)
    return found


def measured(what: str, folder: Path, made: str, *arguments: str) -> Row:
    """Run a command of clsas in a folder; return its name, time and memory, and what it made."""
    command = [sys.executable, "-m", "clsas", *arguments]
    start = time.perf_counter()
    process = subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL, env=environment())
    _, status, used = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - start
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command)
    files = (folder / made).rglob("*") if (folder / made).is_dir() else [folder / made]
    size_bytes = sum(path.stat().st_size for path in files if path.is_file())
    busy = used.ru_utime + used.ru_stime
    return [
        what, f"{seconds:.1f}", f"{busy:.1f}", f"{used.ru_maxrss / 1024:.0f}",
        f"{size_bytes / 1e6:.0f}",
    ]  # fmt: skip


def environment() -> dict[str, str]:
    """Return the variables of this process, with the package where commands find it."""
    root = str(Path(clsas.__file__).parents[1])
    path = os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH")]))
    return {**os.environ, "PYTHONPATH": path}
