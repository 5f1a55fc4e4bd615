"""Valid calls of readers, writers, stores and results."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import clsas
from api_calls.scene import Call, nothing, scene
from clsas.engine.data.digests import grid_digest
from clsas.engine.factorized.costs import Costs
from clsas.mosaics.document import Record


def files(folder: Path) -> dict[str, Call]:
    s = scene(folder)
    optional = ("None",)
    (folder / "cast.csv").write_text("depth_m,speed_m_s\n0,1500\n40,1490\n")
    common = {"window": "hann", "oversampling": 2.0}
    store = clsas.mosaic(
        s.lines.select(slice(0, 20)),
        s.grid,
        folder / "store.zarr",
        accuracy_db=-50.0,
        patches=(2, 1),
    )
    store.image()
    opened = clsas.Store.opened(folder / "store.zarr")
    document = opened.document
    inputs, patch_shape = document.inputs, document.patch_shape
    record = opened.records()[0, 0]
    of_heights = store_of_heights(folder, inputs, record)
    return {
        "load": Call(clsas.load, {"path": folder / "lines.h5"}),
        "save": Call(
            clsas.save,
            {"path": folder / "out.h5", "obj": s.lines},
            accepts={"obj": ("a Grid", "an Image", "list of it")},
        ),
        "read_airsas": Call(
            clsas.read_airsas,
            {
                "path": folder / "scenes" / "a.h5",
                "channels": (1,),
                "shared": folder / "characterization data",
                **common,
            },
            accepts={"channels": optional, "shared": optional},
        ),
        "read_cphd": Call(
            clsas.read_cphd, {"path": folder / "lines.cphd", "channel": None, **common}
        ),
        "write_cphd": Call(clsas.write_cphd, {"path": folder / "out.cphd", "lines": s.lines}),
        "read_sound_speed": Call(
            clsas.read_sound_speed, {"path": folder / "cast.csv", "surface_z_m": 20.0}
        ),
        "read_full_matrix": Call(
            clsas.read_full_matrix,
            {"path": folder / "capture.mat", "sound_speed_m_s": 6000.0, **common},
            accepts={"sound_speed_m_s": optional},
        ),
        "read_phase_history": Call(
            clsas.read_phase_history, {"path": folder / "pass.mat", **common}
        ),
        "process": Call(
            clsas.process,
            {
                "scene": folder / "scene.toml",
                "lines": folder / "lines.h5",
                "output": folder / "out",
                "steps": ("image",),
                "device": 0,
                "progress": nothing,
            },
            kinds={"device": "device"},
            accepts=dict.fromkeys(("output", "steps", "progress"), optional)
            | {"lines": ("None", "RangeLines")},
        ),
        # Neither checks whether the path exists.
        "Store": Call(clsas.Store, {"path": folder / "store.zarr"}, accepts={"path": ("long",)}),
        "Store.at": Call(
            clsas.Store.at,
            {"path": folder / "store.zarr"},
            names={"path": ("store",)},
            accepts={"path": ("long",)},
        ),
        "Store.opened": Call(
            clsas.Store.opened, {"path": folder / "store.zarr"}, names={"path": ("store",)}
        ),
        "Store.read": Call(opened.read, {"rows": slice(0, 4), "columns": slice(1, 5)}),
        "Store.image": Call(opened.image, {"rows": slice(0, 4), "columns": slice(1, 5)}),
        "Store.overview": Call(
            opened.overview, {"most": 8, "rows": slice(0, 4), "columns": slice(1, 5)}
        ),
        "Store.records": Call(opened.records, {}),
        "Store.certificate": Call(opened.certificate, {}),
        "Store.array_damage": Call(opened.array_damage, {}),
        "Store.damage": Call(opened.damage, {"progress": nothing}, accepts={"progress": optional}),
        "Store.begin": Call(
            opened.begin,
            {
                "inputs": inputs,
                "grid": s.grid,
                "patch_shape": tuple(patch_shape),
                "window_shape": (3, 3),
            },
            accepts={"inputs": ("dict",), "window_shape": optional},
        ),
        "Store.grow": Call(opened.grow, {"inputs": inputs}),
        "Store.read_level": Call(
            store_with_levels(folder, inputs, record).read_level,
            {"factor": 2, "rows": slice(0, 1), "columns": slice(1, 5), "coherent": True},
        ),
        "Store.complete_levels": Call(
            opened.complete_levels, {"progress": nothing}, accepts={"progress": optional}
        ),
        "Store.write": Call(
            of_heights.write,
            {
                "row": 0,
                "column": 0,
                "rows": slice(0, 4),
                "columns": slice(0, 6),
                "pixels": np.ones((4, 6), np.complex64),
                "record": record,
                "layers": _layers((4, 6)),
            },
        ),
        "Store.undamaged_records": Call(opened.undamaged_records, {}),
        "Store.read_layer": Call(
            of_heights.read_layer,
            {"name": "sd_m", "rows": slice(0, 4), "columns": slice(1, 5), "factor": 1},
            may_be_nan=True,
        ),
        "Store.heights": Call(
            of_heights.heights, {"rows": slice(0, 4), "columns": slice(1, 5)}, may_be_nan=True
        ),
        "Store.sampled_heights": Call(
            of_heights.sampled_heights, {"per_window": 2}, may_be_nan=True
        ),
        "Store.overview_heights": Call(
            of_heights.overview_heights,
            {"most": 2, "rows": slice(0, 4), "columns": slice(1, 5)},
            may_be_nan=True,
        ),
    }


def store_of_heights(folder: Path, inputs: dict[str, Any], record: Record) -> clsas.Store:
    """Return a small store of heights."""
    grid = clsas.Grid.plane((0, 1, 6), (20, 21, 4))
    store = clsas.Store.at(folder / "of-heights.zarr")
    own = {"grid": grid_digest(grid), "pixels": [4, 6], "window_m": 0.5, "georeference": None}
    store.begin(inputs | own, grid, grid.shape, (3, 3))
    pixels = np.ones(grid.shape, np.complex64)
    store.write(0, 0, slice(0, 4), slice(0, 6), pixels, record, _layers(grid.shape))
    return store


def _layers(shape: tuple[int, ...]) -> dict[str, np.ndarray]:
    names = ("height_m", "sd_m", "coherence", "looks", "m_per_rad")
    layers = {name: np.full(shape, 0.5, np.float32) for name in names}
    shadows = ("shadow_height_m", "shadow_sd_m")
    return layers | {name: np.full(shape, np.nan, np.float32) for name in shadows}


def store_with_levels(folder: Path, inputs: dict[str, Any], record: Record) -> clsas.Store:
    """Return a store that is so wide that it has a level."""
    grid = clsas.Grid.plane((0, 1, 1030), (20, 21, 2))
    store = clsas.Store.at(folder / "wide.zarr")
    store.begin(inputs | {"grid": grid_digest(grid), "pixels": [2, 1030]}, grid, grid.shape)
    whole = slice(0, 2), slice(0, 1030)
    store.write(0, 0, *whole, np.ones(grid.shape, np.complex64), record)
    return store


def results(folder: Path) -> dict[str, Call]:
    s = scene(folder)
    assessed = clsas.assess(s.lines, s.grid, costs=Costs(), ends=False)
    traded = measured(folder)
    found = clsas.calibrate_track(
        s.lines, s.targets.positions_m, unknowns=("time_offset",), search_m=0.2
    )
    return {
        "Assessment.describe": Call(assessed.describe, {}),
        "Calibration.describe": Call(found.describe, {}),
        "Limits.describe": Call(clsas.limits(s.sonar, s.track, s.grid).describe, {}),
        "Inspection.describe": Call(clsas.inspect(s.lines, s.grid).describe, {}),
        "Tradeoff.describe": Call(traded.describe, {}),
        "Tradeoff.save_csv": Call(traded.save_csv, {"path": folder / "out.csv"}),
        "Tradeoff.save_png": Call(
            traded.save_png,
            {"path": folder / "out.png", "title": "A title"},
            kinds={"title": "text"},
        ),
    }


@cache
def measured(folder: Path) -> clsas.Tradeoff:
    s = scene(folder)
    return clsas.tradeoff(s.lines, s.grid, tolerances_db=(-30.0,), repeats=1)
