"""Folder of the recordings, and the command line of the programs that image them."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path

_ROOT = Path(__file__).parents[2]


def folder() -> Path:
    """Return the folder of the recordings: CLSAS_DATA, or shared/data beside the repository."""
    return Path(os.environ.get("CLSAS_DATA") or _ROOT.parent / "shared" / "data")


def parse_arguments(description: str | None, default: Sequence[str]) -> argparse.Namespace:
    """Return the arguments `recording` (paths), `out` (a folder, created here) and `device`.

    Parameters
    ----------
    description : str, optional
        Description of the program.
    default : sequence of str
        Recordings, relative to `folder()`, that are imaged by default.
    """
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument(
        "recording",
        nargs="*",
        type=Path,
        default=[folder() / name for name in default],
        help=f"file to image (default: {' '.join(default)} in the folder CLSAS_DATA, "
        "or else in ../shared/data beside the repository)",
    )
    parser.add_argument(
        "--out", type=Path, default=Path("out"), help="folder for the pictures (default: out)"
    )
    parser.add_argument("--device", help="part of an OpenCL device's name, or its index")
    arguments = parser.parse_args()
    for path in arguments.recording:
        if not path.is_file():
            parser.error(f"there is no recording {path}")
    arguments.out.mkdir(parents=True, exist_ok=True)
    return arguments
