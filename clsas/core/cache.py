"""The folder of what is kept from run to run."""

from __future__ import annotations

import os
from pathlib import Path

from platformdirs import user_cache_path


def cache_folder() -> Path:
    """Return the folder of what is kept from run to run: CLSAS_CACHE, or else the user's cache."""
    return Path(os.environ.get("CLSAS_CACHE") or user_cache_path("clsas"))
