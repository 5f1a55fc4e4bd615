"""A small store with heights, for tests that damage it."""

import json
import os

import numpy as np
from cases import along_x, lines_over

import clsas
from clsas.engine.data.digests import with_digest
from clsas.engine.data.grid import Grid

PLANE = Grid.plane((-4, 4, 40), (30, 40, 30))
GRID = PLANE.with_height(np.linspace(0, 1, PLANE.size).reshape(PLANE.shape))
LINES = lines_over(GRID, along_x(60, 0.1), carrier_hz=100e3, step_m=0.03)
REQUEST = {"accuracy_db": -50, "beam": clsas.BeamWindow(8.0, "hann"), "patches": (2, 3)}


def files_of(path):
    """Return the contents of the files of a store, by their path in it."""
    return {each.relative_to(path): each.read_bytes() for each in path.rglob("*") if each.is_file()}


def written(path, files):
    """Write files into a store; return its path."""
    for name, content in files.items():
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_bytes(content)
    return path


def change(path, **attributes):
    """Change attributes of a store's document, and its checksum with them; None removes one."""
    document = json.loads((path / "zarr.json").read_text())
    changed = {**document["attributes"], **attributes}
    kept = {name: value for name, value in changed.items() if value is not None}
    document["attributes"] = with_digest(kept)
    (path / "zarr.json").write_text(json.dumps(document))


def change_metadata(path, name, **entries):
    """Change entries of an array's metadata."""
    document = json.loads((path / name / "zarr.json").read_text())
    (path / name / "zarr.json").write_text(json.dumps({**document, **entries}))


class Killed(BaseException):
    """Stands for a signal that ends the process."""


def killed_at(monkeypatch, step, work):
    """Do some work until a file is about to get its name for the `step`-th time; or return."""
    rename, count = os.replace, iter(range(step))

    def replace(source, target):
        if next(count, None) is None:
            raise Killed
        rename(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", replace)
        try:
            work()
        except Killed:
            return True
    return False
