"""A small store that tests damage."""

import pytest
from stores import GRID, LINES, REQUEST, files_of, written

import clsas


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """The files of a store."""
    path = tmp_path_factory.mktemp("kept") / "a.zarr"
    list(clsas.mosaic(LINES, GRID, path, **REQUEST))
    return files_of(path)


@pytest.fixture
def path(kept, tmp_path):
    """A copy of the store that a test may damage."""
    return written(tmp_path / "a.zarr", kept)
