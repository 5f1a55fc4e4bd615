"""Optional packages: the extra that brings each, and the error if one is missing."""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Iterator
from contextlib import contextmanager

_FILES = ("h5py>=3.16", "pydantic>=2.6")
_XARRAY = ("xarray>=2024.11",)
_MOSAIC = (*_FILES, *_XARRAY, "zarr>=3.1.3", "numcodecs>=0.16.6,!=0.17.0")

PACKAGES = {
    "pocl": ("pyopencl[pocl]>=2024.2.7",),
    "files": _FILES,
    "plot": ("matplotlib>=3.10",),
    "xarray": _XARRAY,
    "cli": (*_FILES, "click>=8.1", "rich>=13.0"),
    "mosaic": _MOSAIC,
    "workers": (*_MOSAIC, "distributed>=2024.1", "cryptography>=42.0"),
    "maps": (*_FILES, *_XARRAY, "rasterio>=1.4", "pyproj>=3.6", "h5netcdf>=1.3"),
    "radar": (*_FILES, "sarkit>=1.8", "lxml>=5.1"),
    "water": ("gsw>=3.6",),
}
"""Requirements of every extra, as `pyproject.toml` has them. Extras that others include come first:
a message about a missing package names the first extra that requires it."""


@contextmanager
def needed(purpose: str, extra: str | None = None) -> Iterator[None]:
    """Replace Python's error by a clear one if an import in the `with` block finds no package.

    Parameters
    ----------
    purpose : str
        What the imported packages are needed for, such as "pictures".
    extra : str, optional
        The extra to install if it brings the missing package. By default the smallest that does.

    Raises
    ------
    ImportError
        If a package of `PACKAGES` is missing. The message names it, the purpose, and the command
        that installs the extra.

    Examples
    --------
    >>> with needed("pictures"):
    ...     from matplotlib.figure import Figure
    """
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if (found := _extra_of(package, extra)) is None:
            raise
        raise _missing(package, found, purpose) from None


def check_installed(package: str, purpose: str) -> None:
    """Raise the error of `needed` if a package of `PACKAGES` is missing, without importing it."""
    extra = _extra_of(package)
    assert extra is not None, package
    if not is_installed(package):
        raise _missing(package, extra, purpose)


def install_command(extra: str) -> str:
    """Return the command that installs the packages of an extra.

    The command names the packages, because pip would look for `clsas[extra]` on a package index
    even if clsas runs from a checkout.
    """
    return "pip install " + " ".join(f"'{package}'" for package in PACKAGES[extra])


def is_installed(package: str) -> bool:
    """Return whether a package can be imported, without importing it."""
    return importlib.util.find_spec(package) is not None


def _extra_of(package: str, preferred: str | None = None) -> str | None:
    """Return the preferred extra if it requires a package, else the first that does, or None."""
    for extra in (preferred, *PACKAGES):
        requirements = PACKAGES.get(extra or "", ())
        if package in (re.split(r"[^\w-]", requirement)[0] for requirement in requirements):
            return extra
    return None


def _missing(package: str, extra: str, purpose: str) -> ImportError:
    return ImportError(
        f"{package} is not installed, and is needed for {purpose}: {install_command(extra)}",
        name=package,
    )
