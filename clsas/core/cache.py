"""Folder of cached files, such as measured costs and simulated lines."""

from __future__ import annotations

import os
from pathlib import Path

from platformdirs import user_cache_path


def cache_folder() -> Path:
    """Return the cache folder: that of the variable CLSAS_CACHE, or else the user's default."""
    return Path(os.environ.get("CLSAS_CACHE") or user_cache_path("clsas"))
