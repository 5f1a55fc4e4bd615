"""Valid calls of georeferences, and of what depends on them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

import clsas
from api_calls.scene import EMPTY, Call, nothing, scene


def maps(folder: Path) -> dict[str, Call]:
    s = scene(folder)
    place = clsas.Georeference.local(60.39, 5.32, -12.0, heading_deg=217.0)
    names = {"latitude_deg": 60.39, "longitude_deg": 5.32, "height_m": -12.0, "heading_deg": 217.0}
    at_m = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    geographic = {
        "latitude_deg": np.array([60.39, 60.391]),
        "longitude_deg": np.array([5.32, 5.33]),
    }
    course = np.linspace(0, 1e-4, 6)
    optional = ("None",)
    text = {"crs": "text", "vertical_datum": "text"}
    clsas.save(folder / "image.h5", s.image)
    one = np.ones(s.image.shape)
    relief = clsas.Heights(one, 0.1 * one, 0.9 * one, one > 0, 25 * one, one, s.image, 0.3)
    clsas.save(folder / "heights.h5", relief)
    exported = {
        "source": folder / "image.h5",
        "kind": "8bit",
        "dynamic_range_db": 40.0,
        "reference": 2.0,
        "colour_map": "gray",
        "north_up": True,
        "pixel_m": 0.2,
        "georeference": place,
        "plan": s.plan,
        "lines": s.lines,
        "beam": None,
        "progress": nothing,
    }
    unset = dict.fromkeys(
        (
            "kind", "dynamic_range_db", "reference", "colour_map", "pixel_m", "plan", "lines",
            "beam", "progress", "north_arrow", "scale_bar",
        ),
        optional,
    )  # fmt: skip
    phase_centres_m = s.lines.phase_centres_m
    light_m_s = 299_792_458.0
    radar = replace(
        s.lines,
        tx_m=phase_centres_m,
        rx_m=phase_centres_m,
        carrier_hz=s.lines.carrier_hz * light_m_s / s.lines.sound_speed_m_s,
        sound_speed_m_s=light_m_s,
        rx_velocity_m_s=None,
    )
    pictured = ("source", "dynamic_range_db", "reference", "colour_map", "georeference")
    picture = {name: exported[name] for name in pictured}
    return {
        "Georeference": Call(
            clsas.Georeference,
            {"crs": None, **names, "vertical_datum": "NN2000"},
            kinds=text,
            accepts={"crs": ("None",), "vertical_datum": optional},
            skips={"crs": ("np.str_",)},  # excludes the other arguments
        ),
        "Georeference.projected": Call(
            clsas.Georeference.projected,
            {"crs": "EPSG:32632", "vertical_datum": "NN2000"},
            kinds={"vertical_datum": "text"},
        ),
        "Georeference.local": Call(
            clsas.Georeference.local,
            {**names, "vertical_datum": "NN2000"},
            kinds={"vertical_datum": "text"},
        ),
        "Georeference.wkt": Call(place.wkt, {}),
        "Georeference.map_crs": Call(place.map_crs, {}),
        "Georeference.to_map": Call(
            place.to_map, {"positions_m": at_m}, accepts={"positions_m": EMPTY}
        ),
        "Georeference.from_map": Call(
            place.from_map, {"places_m": at_m}, accepts={"places_m": EMPTY}
        ),
        "Georeference.to_geographic": Call(
            place.to_geographic, {"positions_m": at_m}, accepts={"positions_m": EMPTY}
        ),
        "Georeference.from_geographic": Call(
            place.from_geographic,
            {**geographic, "height_m": np.array([1.0, 2.0])},
            accepts=dict.fromkeys((*geographic, "height_m"), EMPTY),
        ),
        "Georeference.convergence_deg": Call(
            place.convergence_deg, geographic, accepts=dict.fromkeys(geographic, EMPTY)
        ),
        "Georeference.north_up": Call(place.north_up, {"grid": s.grid, "pixel_m": 0.2}),
        "Georeference.affine": Call(place.affine, {"grid": s.grid}),
        "Track.from_geographic": Call(
            clsas.Track.from_geographic,
            {
                "latitude_deg": 60.39 + course,
                "longitude_deg": 5.32 + course,
                "height_m": np.full(6, -12.0),
                "heading_deg": np.full(6, 26.0),
                "time_s": np.arange(6.0),
                "pitch_deg": np.full(6, 1.0),
                "roll_deg": np.full(6, 2.0),
                "georeference": place,
            },
            accepts={"georeference": optional},
        ),
        "export": Call(
            clsas.export,
            {
                **exported,
                "path": folder / "map.tif",
                "north_arrow": False,
                "scale_bar": False,
                "caption": False,
            },
            kinds={"colour_map": "text"},
            accepts=unset | {"source": ("an Image",)},
        ),
        "export:heights": Call(
            clsas.export,
            {
                "source": folder / "heights.h5",
                "path": folder / "heights.tif",
                "north_up": True,
                "pixel_m": 0.2,
                "georeference": place,
                "lines": s.lines,
                "progress": nothing,
            },
            accepts=unset | {"source": ("an Image",)},
        ),
        "export:sicd": Call(
            clsas.export,
            {
                "source": folder / "image.h5",
                "path": folder / "map.nitf",
                "georeference": place,
                "plan": s.plan,
                "lines": radar,
                "beam": clsas.BeamWindow(60.0),
                "progress": nothing,
            },
            accepts=unset | {"source": ("an Image",)},
        ),
        "export:picture": Call(
            clsas.export,
            {**picture, "path": folder / "map.png", "north_arrow": True, "scale_bar": True},
            kinds={"colour_map": "text"},
            accepts=unset | {"source": ("an Image",)},
        ),
    }
