"""The scene of THESIS chapter 6 (Odegaard 2004), and what its figures' scripts share.

A wreck beside a track of 80 m, simulated in place of the thesis's recording (clsas.wreck), imaged
as a whole and, with the same pixels, the part of it round the wreck.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import product
from pathlib import Path

import numpy as np
from range_errors import range_errors_m
from scipy.spatial.distance import cdist

import clsas
from clsas.aperture import nearest
from clsas.opencl.device import Device, open_device
from clsas.simulation import seabeds
from clsas.sonar.visibility import BeamTrack, Boxes, sines
from clsas.trials import wreck

PIXELS = 1024
NEAR_M = 53.0  # where the part round the wreck begins, across the track
BEAM = clsas.BeamWindow(5.0, "hann")
FIXED_BEAM = replace(BEAM, along=(1.0, 0.0, 0.0))  # as clsas.wavenumber has it
ACCURACY_DB = -60.0  # of plain backprojection
STAGES = [(2, 2)]  # the thesis's Ns = 2: one stage, and the final backprojection
WAVELENGTH_M = 12e-3
SPACING_M = 0.1001  # of an array's phase centres
VISIBLE_DB = -2.0  # a shadow that is less dark does not count
_FLAT_M = 0.3  # height of what counts as sand
_BESIDE_M = 1.5, 4.0  # of the mast's shadow: sand that it is compared to
_PIXELS_LOOKED_AT = 200  # of a patch, for its range errors


@dataclass(frozen=True, eq=False)
class Scene:
    """The wreck's lines and grids.

    Attributes
    ----------
    device : Device
    lines : RangeLines
    pixels : int
        Along either side of the whole scene; the part round the wreck has half as many.
    """

    device: Device
    lines: clsas.RangeLines
    pixels: int = PIXELS

    @cached_property
    def thinned(self) -> Scene:
        """The same with one line for each place along the track, as the thesis's data had it.

        There pings overlap by a third; its data had been put on a regular grid.
        """
        along_m = self.lines.phase_centres_m[:, 0]
        order = np.argsort(along_m, kind="stable")
        kept = np.zeros(len(order), bool)
        kept[order] = np.append(True, np.diff(along_m[order]) > SPACING_M / 2)
        return self if kept.all() else replace(self, lines=self.lines.select(kept))

    @cached_property
    def fine(self) -> clsas.Grid:
        """All of the scene, in 16 times the pixels."""
        return wreck.grid(4 * self.pixels)

    @cached_property
    def whole(self) -> clsas.Grid:
        """All of the scene."""
        return wreck.grid(self.pixels)

    @cached_property
    def part(self) -> clsas.Grid:
        """Its part round the wreck."""
        first, half = round((NEAR_M - wreck.Y_M[0]) / np.ptp(wreck.Y_M) * self.pixels), self.pixels
        return self.whole.window(
            slice(first, first + half // 2), slice(half // 4, half // 4 + half // 2)
        )

    def backproject(
        self,
        grid: clsas.Grid,
        accuracy_db: float = ACCURACY_DB,
        beam: clsas.BeamWindow | None = BEAM,
    ) -> clsas.Image:
        """Form an exact image."""
        return clsas.backproject(
            self.lines, grid, accuracy_db=accuracy_db, beam=beam, device=self.device
        )

    def mosaic(self, grid: clsas.Grid, **wish: object) -> tuple[clsas.Image, list[clsas.Patch]]:
        """Form a mosaic by `stages` or `tolerance_db`."""
        patches: list[clsas.Patch] = []
        wanted = clsas.mosaic(self.lines, grid, beam=BEAM, device=self.device, **wish)
        return wanted.image(patches.append), patches

    def wavenumber(self, grid: clsas.Grid, strips: int = 1) -> clsas.Image:
        """Form a wavenumber image, each of some strips of rows for its own middle range."""
        rows = np.array_split(np.arange(grid.shape[0]), strips)
        windows = [grid.window(slice(some[0], some[-1] + 1)) for some in rows]
        pixels = [clsas.wavenumber(self.lines, each, beam=BEAM).pixels for each in windows]
        return clsas.Image(np.concatenate(pixels), grid)

    def formula_m(self, patch: clsas.Patch) -> float:
        """Return the largest range error of a patch by [45]."""
        grid = patch.grid
        edges_m = grid.positions_m(slice(None, None, grid.shape[0] - 1)).reshape(-1, 3)
        nearest_m = cdist(edges_m, self.lines.phase_centres_m).min()
        steps_m = np.linalg.norm([grid.row_step_m, grid.column_step_m], axis=1)
        side_m = float(np.max(steps_m * grid.shape))
        return sum(nearest.stage_errors_m(STAGES, SPACING_M, side_m, nearest_m))

    def measured_m(self, patch: clsas.Patch) -> float:
        """Return the largest range error of a patch by its plan, of channels that see the pixel."""
        grid, along = patch.grid, BEAM.directions(self.lines)
        half_m = (np.array(grid.shape)[:, None] - 1) / 2 * [grid.row_step_m, grid.column_step_m]
        # What the patch was formed from.
        centre_m = grid.origin_m + half_m.sum(axis=0)
        track = BeamTrack(BEAM.limits, self.lines.phase_centres_m, along)
        seen = track.touching(Boxes.equal(centre_m[None], half_m))[0]
        lines, along = self.lines.select(seen), along[seen]
        plan = clsas.Plan.from_json(json.dumps(patch.record.plan))
        random = np.random.default_rng(1)
        pixels = random.integers(0, grid.shape, (_PIXELS_LOOKED_AT, 2))
        ends = ([0, count // 2 - 1, count // 2, count - 1] for count in grid.shape)
        pixels = np.concatenate([pixels, list(product(*ends))])
        errors_m = range_errors_m(plan, lines, grid, pixels)
        # There channels are in the order of the track.
        order = np.argsort(lines.tx_m[:, 0] + lines.rx_m[:, 0], kind="stable")
        points_m = grid.positions_m()[tuple(pixels.T)]
        weight = BEAM.weights(sines(points_m, self.lines.phase_centres_m[seen], along))[order].T
        return float(np.abs(errors_m[weight > 0]).max())


@lru_cache(maxsize=4)
def mast_shadow(grid: clsas.Grid) -> tuple[np.ndarray, np.ndarray]:
    """Return which pixels' sand the mast alone hides from broadside, and lit ones beside them."""
    seabed, track = wreck.scene().need("targets", "track")
    without = seabeds.wreck(wreck.X_M, wreck.Y_M, mast_m=0.0)
    eye_m = track.positions_m.mean(axis=0)
    x_m, y_m = grid.axes_m
    hidden, light = np.zeros(grid.shape, bool), np.zeros(grid.shape, bool)
    for column in np.flatnonzero(np.abs(x_m) < _BESIDE_M[1] + 1):
        x = np.full(len(y_m), x_m[column])
        points_m = np.stack([x, y_m, seabed.height_m(x, y_m)], axis=-1)
        eye_m[0] = x_m[column]
        sand = points_m[:, 2] < _FLAT_M
        light[:, column] = seabed.lit(points_m, eye_m) & sand
        hidden[:, column] = without.lit(points_m, eye_m) & sand & ~light[:, column]
    away_m = np.abs(x_m - x_m[np.nonzero(hidden)[1]].mean())
    beside = (away_m > _BESIDE_M[0]) & (away_m < _BESIDE_M[1])
    return hidden, light & beside & hidden.any(axis=1)[:, None]


def mast_db(image: clsas.Image) -> float:
    """Return the mean power of the mast's shadow over that of the sand beside it, dB."""
    hidden, light = mast_shadow(image.grid)
    power = np.abs(image.pixels) ** 2
    return float(10 * np.log10(power[hidden].mean() / power[light].mean()))


def arguments(description: str, repeats: int) -> tuple[argparse.Namespace, Scene]:
    """Return what the command line says, and the scene for it."""
    parser = argparse.ArgumentParser(description=description.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("thesis"), help="folder for CSV and PNG")
    parser.add_argument("--device", help="as `clsas devices` lists it; the fastest unless given")
    parser.add_argument(
        "--pixels", type=int, default=PIXELS, help="along either side of the scene (%(default)s)"
    )
    parser.add_argument("--lines", type=Path, help="range lines; simulated and kept unless given")
    parser.add_argument(
        "--repeats", type=int, default=repeats, help="timed runs of each (%(default)s)"
    )
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    lines = wreck.lines() if given.lines is None else clsas.load(given.lines)
    found = Scene(open_device(given.device), lines, given.pixels)
    print(
        f"{found.device.info.label}: {lines.channels} lines of {lines.length} samples, "
        f"{given.pixels} x {given.pixels} pixels of the whole scene"
    )
    return given, found


def fraction(error_m: float) -> str:
    """Write an error as a part of the wavelength."""
    return f"λ/{WAVELENGTH_M / error_m:.3g}"


def levels(image: clsas.Image, together: int, reference: float) -> np.ndarray:
    """Return the mean power of so many pixels squared, dB over a reference power."""
    rows, columns = (count // together * together for count in image.grid.shape)
    power = np.abs(image.pixels[:rows, :columns]) ** 2
    power = power.reshape(rows // together, together, columns // together, together)
    return 10 * np.log10(np.maximum(power.mean(axis=(1, 3)) / reference, 1e-20))


def extent_m(grid: clsas.Grid) -> Sequence[float]:
    """Return the outer edges of a grid: left, right, bottom, top."""
    ends = []
    for axis in grid.axes_m:
        half_m = (axis[1] - axis[0]) / 2
        ends += [axis[0] - half_m, axis[-1] + half_m]
    return ends
