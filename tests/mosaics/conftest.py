"""A small store that tests damage."""

import pytest
from stores import GRID, LINES, WISH, files_of, written

import clsas


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """The files of a store."""
    path = tmp_path_factory.mktemp("kept") / "a.zarr"
    list(clsas.mosaic(LINES, GRID, path, **WISH))
    return files_of(path)


@pytest.fixture
def path(kept, tmp_path):
    """A store of its own for a test."""
    return written(tmp_path / "a.zarr", kept)
