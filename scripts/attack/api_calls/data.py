"""Valid calls of grids, lines, images and measures."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

import clsas
from api_calls.scene import EMPTY, Call, axes, fields, scene


def data(folder: Path) -> dict[str, Call]:
    s = scene(folder)
    grid, lines, image = s.grid, s.lines, s.image
    level = dataclasses.replace(lines, first_range_m=np.full(40, 14.0))
    part = slice(2, 10, 2)
    points = clsas.Grid.points(grid.positions_m().reshape(-1, 3))
    axis = (0.0, 1.0, 5)
    numbers = np.arange(40) % 2
    of_channels = {
        "rx_velocity_m_s": np.ones((40, 3)),
        "look_direction": np.ones((40, 3)),
        "bank_numbers": numbers,
    }
    unset = dict.fromkeys((*of_channels, "georeference", "sound_speed"), ("None",))
    profile = clsas.SoundSpeed([0.0, 40.0], [1500.0, 1490.0], 20.0)
    cast = {
        "depth_m": np.array([0.0, 10.0, 50.0]),
        "temperature_c": np.array([15.0, 14.0, 9.0]),
        "salinity": np.full(3, 35.0),
        "surface_z_m": 20.0,
    }
    place = {"georeference": clsas.Georeference.local(60.39, 5.32, heading_deg=217.0)}
    return {
        "Grid": Call(
            clsas.Grid,
            {
                "origin_m": np.array([0.0, 10.0, 0.0]),
                "row_step_m": np.array([0.0, 0.1, 0.0]),
                "column_step_m": np.array([0.1, 0.0, 0.0]),
                "shape": (3, 4),
                "height_m": np.arange(12.0).reshape(3, 4),
                "points_m": None,
                **place,
            },
            accepts={"height_m": ("None",), "georeference": ("None",)},
        ),
        "Grid.plane": Call(clsas.Grid.plane, {"x": axis, "y": (10.0, 12.0, 6), "z": -1.5, **place}),
        "Grid.oriented": Call(
            clsas.Grid.oriented,
            {
                "origin_m": np.array([0.0, 10.0, 0.0]),
                "row_step_m": np.array([0.0, 0.1, 0.0]),
                "column_step_m": np.array([0.1, 0.0, 0.0]),
                "shape": (3, 4),
                **place,
            },
        ),
        "Grid.points": Call(
            clsas.Grid.points, {"points_m": np.arange(12.0).reshape(2, 2, 3), **place}
        ),
        "Grid.with_height": Call(grid.with_height, {"height_m": np.zeros(grid.shape)}),
        "Grid.at": Call(
            grid.at, {"index": np.array([0, 5, 479])}, accepts={"index": ("empty array",)}
        ),
        "Grid.spread": Call(points.spread, {"most": 6}),
        "Grid.positions_m": Call(grid.positions_m, {"rows": part, "columns": slice(1, 3)}),
        "Grid.window": Call(grid.window, {"rows": part, "columns": slice(1, 3)}),
        "RangeLines": Call(
            clsas.RangeLines,
            fields(lines) | of_channels | place | {"sound_speed": profile},
            accepts=unset | {"samples": ("an Image",)},
        ),
        "RangeLines.bank": Call(
            dataclasses.replace(lines, bank_numbers=numbers).bank, {"number": 1}
        ),
        "RangeLines.select": Call(lines.select, {"channels": np.array([1, 5, 30])}),
        "RangeLines.high_passed": Call(lines.high_passed, {"cutoff_hz": 95e3}),
        "RangeLines.tapered_ends": Call(lines.tapered_ends, {"length_m": 0.2}),
        "RangeLines.without_background": Call(
            level.without_background,
            {"statistic": "median", "receivers": 1},
            accepts={"receivers": ("None",)},
        ),
        "RangeLines.without_still_pings": Call(
            lines.without_still_pings,
            {"least_advance_m": 0.01},
            accepts={"least_advance_m": ("None",)},
        ),
        "RangeLines.without_samples": Call(lines.without_samples, {}),
        "RangeLines.weighted": Call(
            lines.weighted,
            {"weights": np.linspace(0.5, 1, 40)},
            accepts={"weights": ("complex array",)},
        ),
        "density_compensated": Call(clsas.density_compensated, {"lines": lines}),
        "density_weights": Call(clsas.density_weights, {"lines": lines}),
        "Image": Call(
            clsas.Image,
            {"pixels": np.array(image.pixels), "grid": grid, "formed": image.formed},
            accepts={"pixels": ("an Image",), "formed": ("None",)},
        ),
        "Image.db": Call(image.db, {"reference": 2.0}, accepts={"reference": ("None",)}),
        "Image.plot": Call(image.plot, {"axes": axes()}, accepts={"axes": ("None",)}),
        "Image.to_xarray": Call(image.to_xarray, {}),
        "Echoes": Call(
            clsas.Echoes,
            fields(s.echoes) | of_channels | place | {"sound_speed": profile},
            accepts=unset | {"pulse": ("None",), "samples": ("an Image",)},
        ),
        "SoundSpeed": Call(
            clsas.SoundSpeed,
            {
                "depth_m": np.array([0.0, 10.0, 50.0]),
                "speed_m_s": np.array([1500.0, 1499.0, 1490.0]),
                "surface_z_m": 20.0,
            },
        ),
        "SoundSpeed.from_temperature": Call(clsas.SoundSpeed.from_temperature, cast),
        "SoundSpeed.from_teos10": Call(
            clsas.SoundSpeed.from_teos10, {**cast, "longitude_deg": 5.3, "latitude_deg": 60.4}
        ),
        "SoundSpeed.at": Call(profile.at, {"z_m": np.array([0.0, 5.0])}, accepts={"z_m": EMPTY}),
        "SoundSpeed.mean_m_s": Call(profile.mean_m_s, {"one_z_m": 18.0, "other_z_m": -5.0}),
        "Replica": Call(
            clsas.Replica, {"samples": np.exp(1j * np.arange(40.0)), "sample_rate_hz": 4e4}
        ),
        "Replica.spectrum": Call(
            clsas.Replica(np.exp(1j * np.arange(40.0)), 4e4).spectrum,
            {"frequency_hz": np.array([0.0, 1e3, -2e3])},
            accepts={"frequency_hz": EMPTY},
        ),
        "multilook": Call(
            clsas.multilook,
            {"images": [image, image], "window_m": 0.5},
            accepts={"images": ("an Image",), "window_m": ("None",)},
        ),
        "sub_bands": Call(clsas.sub_bands, {"lines": lines, "count": 3}),
        "contrast": Call(clsas.contrast, {"image": image}, accepts={"image": ("list of it",)}),
        "entropy": Call(clsas.entropy, {"image": image}, accepts={"image": ("list of it",)}),
        "relative_error_db": Call(
            clsas.relative_error_db,
            {
                "image": clsas.Image(image.pixels * np.float32(1.01), grid),
                "reference": image,
                "darkest": 0.5,
            },
            accepts={"darkest": ("None",)},
        ),
        "to_xarray": Call(
            clsas.to_xarray, {"obj": image}, accepts={"obj": ("a Grid", "RangeLines")}
        ),
    }
