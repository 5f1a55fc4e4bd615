"""Files beside a file that programs for maps believe rather than the file itself."""

from __future__ import annotations

from pathlib import Path


def remove_sidecars(path: Path) -> None:
    """Remove files beside a new file that describe the one it replaced.

    GDAL and programs for maps keep statistics, a georeference and overviews in them.

    Raises
    ------
    OSError
        If such a file cannot be removed.
    """
    path.with_name(f"{path.name}.aux.xml").unlink(missing_ok=True)
    suffix = path.suffix.lower()
    if suffix == ".png":
        path.with_suffix(".pgw").unlink(missing_ok=True)
    elif suffix in (".tif", ".tiff"):
        path.with_name(f"{path.name}.ovr").unlink(missing_ok=True)
