#!/usr/bin/env python3
"""THESIS section 7.1, range-dependent factorization: one plan for a scene, or one for each patch.

Scenes end at the same range and begin at 1/1.5 to 1/16 of it. Each is imaged with a single plan, as
patches of equal extent in range, and as bands between whose ends ranges grow by the same factor.
The lines of patches and bands are cut to their ranges.
"""

from __future__ import annotations

import argparse
import math
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product

import chapter5
import numpy as np
from section_7_1 import SYSTEMS, System

import clsas
from clsas.engine.device.device import Device, open_device
from clsas.measures.tradeoff import REFERENCE_DB

TOLERANCE_DB = -40.0
RATIOS = (1.5, 2.0, 4.0, 8.0, 16.0)  # of far to near range
COLUMNS = 1024


@dataclass(frozen=True)
class Scene:
    """A strip of a system from a near to a far range.

    Attributes
    ----------
    name : str
    system : System
        Its range is that of the far end.
    column_m, row_m : float
        Size of a pixel.
    columns : int
        Pixels along the track.
    """

    name: str
    system: System
    column_m: float
    row_m: float
    columns: int = COLUMNS

    def coarser(self, factor: float) -> Scene:
        """Return the same scene with larger pixels."""
        return replace(
            self, column_m=self.column_m * factor, row_m=self.row_m * factor,
            columns=round(self.columns / factor),
        )  # fmt: skip

    def grid(self, ratio: float) -> clsas.Grid:
        """Return the pixels between 1/ratio of the far range and the far range."""
        far_m = self.system.range_m
        half_m = self.columns * self.column_m / 2
        rows = max(round(far_m * (1 - 1 / ratio) / self.row_m), 64)
        return clsas.Grid.plane((-half_m, half_m, self.columns), (far_m / ratio, far_m, rows))

    def lines(self, grid: clsas.Grid) -> clsas.RangeLines:
        """Return lines of points scattered over a grid."""
        system = self.system
        x_m = (np.arange(system.channels) - (system.channels - 1) / 2) * system.spacing_m
        track_m = np.pad(x_m[:, None], ((0, 0), (0, 2)))
        random = np.random.default_rng(1)
        (first_x, first_y, _), (last_x, last_y, _) = grid.bounds_m
        places_m = random.uniform([first_x, first_y, 0], [last_x, last_y, 0], (200, 3))
        return clsas.simulate_lines(
            track_m, track_m, clsas.PointTargets(places_m), carrier_hz=system.carrier_hz,
            bandwidth_hz=system.bandwidth_hz, sound_speed_m_s=system.speed_m_s,
            oversampling=1.25,
        )  # fmt: skip


SCENES = (
    # The array of chapter 5 with a narrow band, so that pixels in range are few; every channel
    # receives from every pixel.
    Scene(
        "fixed track",
        replace(SYSTEMS[0], bandwidth_hz=10e3, beam_deg=180.0, range_m=80.0, aperture_m=5.28),
        4.9e-3,
        37.5e-3,
    ),
    # A survey, in which the beam sees a pixel from more channels the farther away it is.
    Scene("strip map", SYSTEMS[3], 25e-3, 25e-3),
)


def bands(grid: clsas.Grid, ratio: float) -> list[clsas.Grid]:
    """Return parts of a grid in range, between whose ends ranges grow by at most about 2."""
    near_m, rows = grid.bounds_m[0][1], grid.shape[0]
    number = parts_of(ratio)
    edges_m = near_m * ratio ** (np.arange(1, number) / number)
    row_m = (grid.bounds_m[1][1] - near_m) / rows
    return cut(grid, (edges_m - near_m) / row_m)


def patches(grid: clsas.Grid, ratio: float) -> list[clsas.Grid]:
    """Return as many parts of equal extent."""
    number = parts_of(ratio)
    return cut(grid, np.arange(1, number) / number * grid.shape[0])


def cut(grid: clsas.Grid, rows: np.ndarray) -> list[clsas.Grid]:
    """Return the parts of a grid between some rows."""
    edges = [0, *np.rint(rows).astype(int).tolist(), grid.shape[0]]
    return [
        grid.window(slice(start, stop), slice(0, grid.shape[1])) for start, stop in pairwise(edges)
    ]


def parts_of(ratio: float) -> int:
    """Return the number of patches, and of bands, of a scene."""
    return max(2, round(math.log2(ratio)))


@dataclass(frozen=True)
class Run:
    """One image of a scene: its patches, and seconds of imaging and of planning."""

    patches: tuple[clsas.Patch, ...]
    seconds: float
    plan_seconds: float

    @classmethod
    def of(cls, mosaics: Sequence[clsas.Mosaic]) -> Run:
        """Form all patches of some mosaics."""
        # A patch that misses its tolerance is formed again; mosaics here have one patch each.
        patches = tuple(list(mosaic)[-1] for mosaic in mosaics)
        records = [patch.record for patch in patches]
        planning = sum(each.plan_seconds for each in records)
        total = sum(each.seconds - each.read_seconds for each in records)
        return cls(patches, total - planning, planning)

    @property
    def pixels(self) -> np.ndarray:
        """The whole image."""
        return np.concatenate([patch.image.pixels for patch in self.patches])

    @property
    def leaves(self) -> str:
        """Leaves of all patches, nearest first."""
        return ", ".join(dict.fromkeys(map(leaf, self.patches)))


def leaf(patch: clsas.Patch) -> str:
    """Return the leaves of a patch in words: rows x columns."""
    plan = patch.record.plan
    sides = plan["method"].get("sides") if plan else None
    return "{}x{}".format(*sides[-1]) if sides else "exact"


def measured(
    scene: Scene, ratio: float, device: Device, repeats: int
) -> Iterator[dict[str, object]]:
    """Yield the rows of a table for one ratio of ranges."""
    grid, beam, number = scene.grid(ratio), scene.system.beam, parts_of(ratio)
    lines = scene.lines(grid)

    def mosaic(part: clsas.Grid) -> clsas.Mosaic:
        return clsas.mosaic(
            lines, part, tolerance_db=TOLERANCE_DB, beam=beam, patches=(1, 1), device=device
        )

    mosaics = {
        "one plan": [mosaic(grid)],
        f"{number} patches": [mosaic(part) for part in patches(grid, ratio)],
        f"{number} bands": [mosaic(part) for part in bands(grid, ratio)],
    }
    runs: dict[str, list[Run]] = {name: [] for name in mosaics}
    for name in [*mosaics, *(repeats * [*mosaics])]:  # in turns, the first ones untimed
        runs[name].append(Run.of(mosaics[name]))
    exact = clsas.backproject(lines, grid, accuracy_db=REFERENCE_DB, beam=beam, device=device)
    one_s = 0.0
    for name, (untimed, *found) in runs.items():
        seconds = min(each.seconds for each in found)
        one_s = one_s or seconds
        yield {
            "scene": scene.name,
            "far/near": f"{ratio:g}",
            "pixels": f"{grid.shape[0]} x {grid.shape[1]}",
            "divided into": name,
            "seconds": f"{seconds:.3f}",
            "gain": f"{one_s / seconds:.2f}",
            "planning s": f"{min(each.plan_seconds for each in found):.2f}",
            "error dB": f"{clsas.relative_error_db(untimed.pixels, exact.pixels):.1f}",
            "leaves, near to far": untimed.leaves,
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    chapter5.add_output(parser)
    parser.add_argument(
        "--pixels", type=int, default=COLUMNS, help="pixels along the track [default: %(default)s]"
    )
    parser.add_argument("--repeats", type=int, default=5, help="timed runs [default: %(default)s]")
    given = parser.parse_args()
    device = open_device(given.device)
    out = chapter5.Output.of(given, device)
    rows = []
    for scene, ratio in product(SCENES, RATIOS):
        scene = scene.coarser(COLUMNS / given.pixels)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", clsas.ClsasWarning)
            for row in measured(scene, ratio, device, given.repeats):
                rows.append(row)
                print(*row.values(), sep=" | ", flush=True)
    chapter5.report(out, "section_7_1_ranges", rows)


if __name__ == "__main__":
    main()
