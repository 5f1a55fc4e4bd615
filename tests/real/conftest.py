"""The programs of scripts/real become importable, and recordings that are absent skip a test."""

import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parents[2] / "scripts" / "real"))

import recordings


@pytest.fixture(scope="session")
def recording():
    """Return the path of a recording by its name."""

    def find(name):
        path = recordings.folder() / name
        if not path.is_file():
            pytest.skip(f"no recording {path}: CLSAS_DATA may name the folder that holds it")
        return path

    return find
