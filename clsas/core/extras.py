"""Optional packages, and the commands that install them."""

from __future__ import annotations

import importlib.util

PACKAGES = {
    "pocl": ("pyopencl[pocl]>=2024.1",),
    "plot": ("matplotlib>=3.8",),
    "mosaic": (
        "zarr>=3.1.3",
        "numcodecs>=0.16.6,!=0.17.0",
        "distributed>=2024.1",
        "cryptography>=42.0",
        "xarray>=2024.1",
    ),
    "radar": ("sarkit>=1.8",),
}
"""Requirements of every extra, as in `pyproject.toml`."""


def install_command(extra: str) -> str:
    """Return the command that installs the packages of an extra.

    The command names the packages, because pip would look for `clsas[extra]` on a package index
    even if clsas runs from a checkout.
    """
    return "pip install " + " ".join(f"'{package}'" for package in PACKAGES[extra])


def is_installed(package: str) -> bool:
    """Return whether a package can be imported, without importing it."""
    return importlib.util.find_spec(package) is not None
