"""Scene of THESIS chapter 6 (Odegaard 2004), and functions that its figures share.

A wreck beside a track of 80 m, simulated in place of the thesis's recording (clsas.selftest.wreck).
Images show the whole scene or, with pixels of the same size, the part around the wreck.
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
from chapter5 import Output, add_output
from range_errors import range_errors_m
from scipy.spatial.distance import cdist

import clsas
from clsas.engine.data.visibility import BeamTrack, Boxes, sines
from clsas.engine.device.device import Device, open_device
from clsas.engine.factorized.virtual_channels import stage_errors_m
from clsas.selftest import wreck
from clsas.simulation import seabeds

PIXELS = 1024
NEAR_M = 53.0  # near edge, across the track, of the part around the wreck
BEAM = clsas.BeamWindow(5.0, "hann")
FIXED_BEAM = replace(BEAM, along=(1.0, 0.0, 0.0))  # the direction that clsas.wavenumber assumes
ACCURACY_DB = -60.0  # of plain backprojection
STAGES = [(2, 2)]  # Ns = 2 of the thesis: one stage and the final backprojection
WAVELENGTH_M = 12e-3
SPACING_M = 0.1001  # of the phase centres of the array
VISIBLE_DB = -2.0  # largest level of a shadow that counts as visible
_FLAT_M = 0.3  # largest height of a point that counts as sand
_BESIDE_M = 1.5, 4.0  # distances from the mast's shadow of the sand that it is compared with
_SAMPLE_PIXELS = 200  # of a patch, at which range errors are evaluated


@dataclass(frozen=True, eq=False)
class Scene:
    """The wreck's lines and grids.

    Attributes
    ----------
    device : Device
    lines : RangeLines
    pixels : int
        Number along each side of the whole scene; the part around the wreck has half as many.
    """

    device: Device
    lines: clsas.RangeLines
    pixels: int = PIXELS

    @cached_property
    def thinned(self) -> Scene:
        """The same scene with one line per position along the track, like the thesis's data.

        In this scene pings overlap by a third, while the data of the thesis had been resampled to a
        regular grid.
        """
        along_m = self.lines.phase_centres_m[:, 0]
        order = np.argsort(along_m, kind="stable")
        kept = np.zeros(len(order), bool)
        kept[order] = np.append(True, np.diff(along_m[order]) > SPACING_M / 2)
        return self if kept.all() else replace(self, lines=self.lines.select(kept))

    @cached_property
    def fine(self) -> clsas.Grid:
        """Grid of the whole scene with 16 times as many pixels."""
        return wreck.grid(4 * self.pixels)

    @cached_property
    def whole(self) -> clsas.Grid:
        """Grid of the whole scene."""
        return wreck.grid(self.pixels)

    @cached_property
    def part(self) -> clsas.Grid:
        """Grid of the part around the wreck."""
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
        """Return an exact image."""
        return clsas.backproject(
            self.lines, grid, accuracy_db=accuracy_db, beam=beam, device=self.device
        )

    def mosaic(self, grid: clsas.Grid, **request: object) -> tuple[clsas.Image, list[clsas.Patch]]:
        """Return the image and the patches of a mosaic for `stages` or `tolerance_db`."""
        patches: list[clsas.Patch] = []
        mosaic = clsas.mosaic(self.lines, grid, beam=BEAM, device=self.device, **request)
        return mosaic.image(patches.append), patches

    def wavenumber(self, grid: clsas.Grid, strips: int = 1) -> clsas.Image:
        """Return a wavenumber image, formed in strips of rows with a middle range for each."""
        rows = np.array_split(np.arange(grid.shape[0]), strips)
        windows = [grid.window(slice(some[0], some[-1] + 1)) for some in rows]
        pixels = [clsas.wavenumber(self.lines, each, beam=BEAM).pixels for each in windows]
        return clsas.Image(np.concatenate(pixels), grid)

    def formula_m(self, patch: clsas.Patch) -> float:
        """Return the largest range error of a patch according to [45], metres."""
        grid = patch.grid
        edges_m = grid.positions_m(slice(None, None, grid.shape[0] - 1)).reshape(-1, 3)
        nearest_m = cdist(edges_m, self.lines.phase_centres_m).min()
        steps_m = np.linalg.norm([grid.row_step_m, grid.column_step_m], axis=1)
        side_m = float(np.max(steps_m * grid.shape))
        return sum(stage_errors_m(STAGES, SPACING_M, side_m, nearest_m))

    def measured_m(self, patch: clsas.Patch) -> float:
        """Return the largest range error of a patch over visible channels, metres."""
        grid, along = patch.grid, BEAM.directions(self.lines)
        half_m = (np.array(grid.shape)[:, None] - 1) / 2 * [grid.row_step_m, grid.column_step_m]
        # Select the channels from which the patch was formed.
        centre_m = grid.origin_m + half_m.sum(axis=0)
        track = BeamTrack(BEAM.limits, self.lines.phase_centres_m, along)
        seen = track.touching(Boxes.equal(centre_m[None], half_m))[0]
        lines, along = self.lines.select(seen), along[seen]
        plan = clsas.Plan.from_json(json.dumps(patch.record.plan))
        random = np.random.default_rng(1)
        pixels = random.integers(0, grid.shape, (_SAMPLE_PIXELS, 2))
        ends = ([0, count // 2 - 1, count // 2, count - 1] for count in grid.shape)
        pixels = np.concatenate([pixels, list(product(*ends))])
        errors_m = range_errors_m(plan, lines, grid, pixels)
        # The channels of `errors_m` are in the order of the track.
        order = np.argsort(lines.tx_m[:, 0] + lines.rx_m[:, 0], kind="stable")
        points_m = grid.positions_m()[tuple(pixels.T)]
        weight = BEAM.weights(sines(points_m, self.lines.phase_centres_m[seen], along))[order].T
        return float(np.abs(errors_m[weight > 0]).max())


@lru_cache(maxsize=4)
def mast_shadow(grid: clsas.Grid) -> tuple[np.ndarray, np.ndarray]:
    """Return which pixels of sand only the mast hides from broadside, and lit ones beside them."""
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
    """Return the arguments of the command line, and their scene."""
    parser = argparse.ArgumentParser(description=description.splitlines()[0])
    add_output(parser)
    parser.add_argument(
        "--pixels",
        type=int,
        default=PIXELS,
        help="pixels along each side of the scene [default: %(default)s]",
    )
    parser.add_argument(
        "--lines", type=Path, help="file of range lines; by default they are simulated and kept"
    )
    parser.add_argument(
        "--repeats",
        type=int,
        default=repeats,
        help="timed runs of each image [default: %(default)s]",
    )
    given = parser.parse_args()
    lines = wreck.lines() if given.lines is None else clsas.load(given.lines)
    found = Scene(open_device(given.device), lines, given.pixels)
    given.out = Output.of(given, found.device)
    print(
        f"{found.device.info.label}: {lines.channels} lines of {lines.length} samples, "
        f"{given.pixels} x {given.pixels} pixels of the whole scene"
    )
    return given, found


def fraction(error_m: float) -> str:
    """Return an error as a fraction of the wavelength, in words."""
    return f"λ/{WAVELENGTH_M / error_m:.3g}"


def levels(image: clsas.Image, together: int, reference: float) -> np.ndarray:
    """Return the mean power of blocks of pixels, `together` a side, dB over a reference."""
    rows, columns = (count // together * together for count in image.grid.shape)
    power = np.abs(image.pixels[:rows, :columns]) ** 2
    power = power.reshape(rows // together, together, columns // together, together)
    return 10 * np.log10(np.maximum(power.mean(axis=(1, 3)) / reference, 1e-20))


def extent_m(grid: clsas.Grid) -> Sequence[float]:
    """Return the outer edges of a grid, metres: left, right, bottom, top."""
    ends = []
    for axis in grid.axes_m:
        half_m = (axis[1] - axis[0]) / 2
        ends += [axis[0] - half_m, axis[-1] + half_m]
    return ends
