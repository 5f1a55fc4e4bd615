"""Narrow-beam case: a wreck and its shadow, after chapter 6 of the thesis (Ødegaard 2004).

The scene is `scenes/wreck.toml`, or `scenes/wreck_two_banks.toml`, which has two receiver banks.
Their range lines take minutes to simulate and are cached. The benchmarks and scripts/thesis use
these lines and the contrast of the shadow.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.cache import private_folder
from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Image
from clsas.engine.data.lines import RangeLines
from clsas.engine.signal.compression import compress
from clsas.files.hdf5 import FileFormatError, load, save
from clsas.files.scene_files import SceneFile, built_in_scene, parse_scene, simulation_digest
from clsas.simulation.simulator import simulate

X_M, Y_M = (-32.0, 32.0), (36.0, 92.0)

_FOOTPRINT_M = 2.5  # more than half the length of track from which a pixel is visible
_SPACING_M = 0.25  # of points that are classified as lit or in shadow
_FLAT_M = 0.3  # largest height of a point that counts as sand
_LEFT_OUT_M = 2.0  # half the side of the square that is left out around a position
_SURROUNDINGS_M = (12.0, 30.0)  # distances along and across within which lit sand counts


def grid(pixels: int) -> Grid:
    """Return a grid of the whole scene, 64 m x 56 m, with `pixels` along either side."""
    return Grid.plane((*X_M, pixels), (*Y_M, pixels))


def scene(name: str = "wreck") -> SceneFile:
    """Return a built-in scene of the wreck: "wreck" or "wreck_two_banks"."""
    return parse_scene(built_in_scene(name), name=f"{name}.toml", folder=Path())


def lines(progress: Callable[[int, int], None] | None = None, *, name: str = "wreck") -> RangeLines:
    """Return the range lines of a scene. The first call simulates them, which takes minutes.

    Later calls read them from the cache (`clsas.engine.data.cache.private_folder`).
    """
    digest = simulation_digest(built_in_scene(name), Path())
    path = private_folder() / f"{name.replace('_', '-')}-{digest}.h5"
    try:
        kept = load(path)
        if isinstance(kept, RangeLines):
            return kept
    except (FileFormatError, OSError):
        pass  # missing or incomplete
    described = scene(name)
    sonar, track, targets = described.need("sonar", "track", "targets")
    echoes = simulate(sonar, track, targets, **described.simulate, progress=progress)
    made = compress(echoes, **described.compress)
    save(path, made)
    return made


@dataclass(frozen=True, eq=False)
class Shadow:
    """Sand around the wreck, classified as lit or in shadow.

    Attributes
    ----------
    scene : SceneFile
    """

    scene: SceneFile

    @cached_property
    def masks(self) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_]]:
        """Positions [n, 2] of sand around the wreck, and which are in shadow and which lit, [n].

        A position counts as in shadow, or as lit, if it is so from the whole part of the track from
        which it is visible.
        """
        seabed, track = self.scene.need("targets", "track")
        x_m, y_m = (
            np.arange(low + _FOOTPRINT_M, high - _FOOTPRINT_M, _SPACING_M)
            for low, high in (X_M, Y_M)
        )
        ground = np.stack(np.meshgrid(x_m, y_m), axis=-1)
        height_m = seabed.height_m(ground[..., 0], ground[..., 1])
        points_m = np.concatenate([ground, height_m[..., None]], axis=-1)
        dark, light = np.ones(height_m.shape, bool), np.ones(height_m.shape, bool)
        middle_m = track.positions_m.mean(axis=0)
        for column, x in enumerate(x_m):
            for offset_m in (-_FOOTPRINT_M, 0.0, _FOOTPRINT_M):
                eye_m = np.array([x + offset_m, middle_m[1], middle_m[2]])
                lit = seabed.lit(points_m[:, column], eye_m)
                dark[:, column] &= ~lit
                light[:, column] &= lit
        sand = height_m < _FLAT_M
        rows, columns = np.nonzero(dark & sand)
        along_m, across_m = _SURROUNDINGS_M
        near = np.abs(ground[..., 0] - x_m[columns].mean()) < along_m + np.ptp(x_m[columns]) / 2
        near &= np.abs(ground[..., 1] - y_m[rows].mean()) < across_m
        chosen = sand & near & (dark | light)
        return ground[chosen], dark[chosen], light[chosen]

    def contrast_db(self, image: Image, without_m: tuple[float, float] | None = None) -> float:
        """Return the mean power of lit sand over that of the shadow, dB.

        Sand within 2 m of the position `without_m`, along and across, is left out.
        """
        ground, dark, light = self.masks
        if without_m is not None:
            away = (np.abs(ground - without_m) > _LEFT_OUT_M).any(axis=1)
            ground, dark, light = ground[away], dark[away], light[away]
        x_m, y_m = image.grid.axes_m
        column = np.rint((ground[:, 0] - x_m[0]) / (x_m[1] - x_m[0])).astype(int)
        row = np.rint((ground[:, 1] - y_m[0]) / (y_m[1] - y_m[0])).astype(int)
        inside = (row >= 0) & (row < len(y_m)) & (column >= 0) & (column < len(x_m))
        power = np.full(len(ground), np.nan)
        power[inside] = np.abs(image.pixels[row[inside], column[inside]]) ** 2
        return float(10 * np.log10(np.nanmean(power[light]) / np.nanmean(power[dark])))
