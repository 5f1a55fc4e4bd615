"""Valid calls of clsas.plot."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import clsas
from api_calls.files import measured
from api_calls.imaging import navigation
from api_calls.scene import Call, axes, scene


def pictures(folder: Path) -> dict[str, Call]:
    s = scene(folder)
    plot, image = clsas.plot, s.image
    clsas.mosaic(s.lines, s.grid, folder / "picture.zarr", accuracy_db=-50.0).image()
    title = {"title": "A title"}
    text = {"title": "text"}
    optional = ("None",)
    levels = {"dynamic_range_db": 40.0, "percentiles": None}
    chosen = {"reference": 1.0, "colour_map": "sonar", "colour_bar": True}
    marks = {"north_arrow": False, "scale_bar": True, "caption": False}
    between = {"colour_map": "gray"}
    accepts = dict.fromkeys(("dynamic_range_db", "percentiles", "reference", "axes"), optional)
    micro = navigation(folder)["micronavigate"]
    moved = clsas.micronavigate(**micro.arguments | {"progress": None})
    focused = clsas.autofocus(s.lines, s.grid)
    response = clsas.measure_point(image, (0.1, 15.0), search_m=0.2, extent_m=0.3)
    box = clsas.Grid.points(
        np.stack(
            np.meshgrid(np.arange(4.0), np.arange(5.0), np.arange(3.0), indexing="ij"), axis=-1
        )[..., ::-1]
    )
    volume = clsas.Image(np.arange(60.0).reshape(box.shape) + 1j, box)
    figure = plot.image_db(image)
    one = np.ones(image.shape)
    fringes = clsas.interferogram(image, image, window_m=0.5)
    relief = clsas.Heights(one, 0.1 * one, 0.9 * one, one > 0, 25 * one, one, image, 0.3)
    return {
        "plot.image": Call(
            plot.image,
            {"image": image, "axes": axes(), **levels, **chosen, **marks, **title},
            kinds=text,
            accepts=accepts,
        ),
        "plot.image:percentiles": Call(
            plot.image,
            {"image": image, "axes": axes(), "percentiles": (1.0, 99.0)},
            accepts={"axes": optional, "percentiles": optional},
        ),
        "plot.image_db": Call(
            plot.image_db,
            {"image": image, **levels, **chosen, **title},
            kinds=text,
            accepts=accepts,
        ),
        "plot.interferogram": Call(
            plot.interferogram, {"interferogram": fringes, **title}, kinds=text
        ),
        "plot.heights": Call(
            plot.heights,
            {"heights": relief, "colour_map": "gray", **title},
            kinds=text | {"colour_map": "text"},
        ),
        "plot.image_html": Call(plot.image_html, {"image": image}),
        "plot.before_and_after": Call(
            plot.before_and_after,
            {"before": image, "after": image, **levels, **between},
            accepts=accepts,
        ),
        "plot.range_lines": Call(
            plot.range_lines,
            {"lines": s.lines, **levels, "reference": 1.0, "colour_map": "gray", **title},
            kinds=text,
            accepts=accepts,
        ),
        "plot.echoes": Call(
            plot.echoes,
            {"echoes": s.echoes, **levels, "reference": 1.0, "colour_map": "gray", **title},
            kinds=text,
            accepts=accepts,
        ),
        "plot.points": Call(
            plot.points,
            {"image": volume, **levels, "reference": 1.0, "colour_map": "gray", **title},
            kinds=text,
            accepts=accepts,
        ),
        "plot.plan": Call(plot.plan, {"plan": s.plan, **title}, kinds=text),
        "plot.volume": Call(
            plot.volume,
            {"image": volume, "kind": "slices", "at": (1.0, 2.0, 1.0), **title},
            kinds=text,
            accepts={"at": optional},
        ),
        "plot.cuts": Call(plot.cuts, {"response": response, "floor_db": -50.0, "resolutions": 8.0}),
        "plot.geometry": Call(
            plot.geometry, {"lines": s.lines, "grid": s.grid}, accepts={"grid": optional}
        ),
        "plot.inspection": Call(
            plot.inspection,
            {"found": clsas.inspect(s.lines), "grid": s.grid},
            accepts={"grid": optional},
        ),
        "plot.coherence": Call(
            plot.coherence, {"found": moved, "range_m": (14.2, 15.0)}, accepts={"range_m": optional}
        ),
        "plot.corrections": Call(plot.corrections, {"found": moved}),
        "plot.sharpness": Call(plot.sharpness, {"found": focused}),
        "plot.tradeoff": Call(plot.tradeoff, {"measured": measured(folder), **title}, kinds=text),
        "plot.mosaic": Call(
            plot.mosaic, {"store": folder / "picture.zarr", "most": 16, "borders": True}
        ),
        "plot.patch_borders": Call(
            plot.patch_borders, {"axes": axes(), "grid": s.grid, "patch_shape": (12, 10)}
        ),
        "plot.save": Call(
            plot.save,
            {"figure": figure, "path": folder / "out.png", "dpi": 20.0},
            accepts={"dpi": optional},
        ),
        "plot.save_png": Call(
            plot.save_png, {"figure": figure, "path": folder / "out.png", "dpi": 20.0}
        ),
    }
