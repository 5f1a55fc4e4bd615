"""Scene of THESIS chapter 5 (Odegaard 2004), and functions that its figures share.

One point reflector lies in the middle of an area of 5 m x 5 m, which begins at a range of 40 m. Ten
pings of 64 receivers give 640 phase centres over 5.28 m at 1 MHz. The thesis does not state the
bandwidth; 100 kHz is chosen here.
"""

from __future__ import annotations

import argparse
import math
import statistics
import sys
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from pathlib import Path

import numpy as np
from range_errors import range_errors_m

import clsas
from clsas import plot
from clsas.engine.data.system import Sonar, line_array
from clsas.engine.device.device import Device, open_device
from clsas.engine.factorized.virtual_channels import stage_errors_m

sys.path.append(str(Path(__file__).parents[1]))
import stored_tables
from fewer_colours import with_fewer_colours

Stages = Sequence[tuple[int, int]]  # (QR, QI)

WAVELENGTH_M = 1.5e-3
SPACING_M = 8.25e-3
SIDE_M, PIXELS = 5.0, 1024
NEAREST_M = 40.0
ACCURACY_DB = -60.0  # of plain backprojection, more accurate than any plan here
GUARD_M = 25e-3  # distance from the point beyond which a side lobe counts as far
WIDTH, PSLR_DB, LOSS_DB = 1.2, 3.0, 3.0  # how much worse than the exact image a usable one may be


def square(side_m: float, pixels: int, nearest_m: float) -> clsas.Grid:
    """Return the pixels of a square beside the middle of the track, from a range on."""
    half = (side_m - side_m / pixels) / 2
    middle = nearest_m + side_m / 2
    return clsas.Grid.plane((-half, half, pixels), (middle - half, middle + half, pixels))


@dataclass(frozen=True)
class Scene:
    """Reflectors, their lines and their image.

    Attributes
    ----------
    device : Device
    pixels : int
        Number along each side. Pixels always measure 4.9 mm, so fewer pixels make a smaller scene.
    bistatic : bool
        True if receivers are at their true positions, up to half an array from the transmitter;
        False if transmitter and receiver are both at their phase centre (THESIS [32]).
    points : int
        Number of reflectors; if more than one, they are scattered over the image.
    """

    device: Device
    pixels: int = PIXELS
    bistatic: bool = False
    points: int = 1

    @property
    def side_m(self) -> float:
        """Side of the image, L_I of [45] before the first stage, metres."""
        return SIDE_M * self.pixels / PIXELS

    @cached_property
    def grid(self) -> clsas.Grid:
        """Grid of the image."""
        return square(self.side_m, self.pixels, NEAREST_M)

    @property
    def point_m(self) -> tuple[float, float]:
        """Position of the reflector, in the middle, where subimages of every stage meet."""
        return 0.0, NEAREST_M + self.side_m / 2

    @cached_property
    def lines(self) -> clsas.RangeLines:
        """Compressed lines, with the beam patterns of the elements."""
        thesis = Sonar.thesis_wide_beam()
        pings, spacing_m = 10, 64 * SPACING_M
        sonar = thesis
        if not self.bistatic:
            pings, spacing_m = 640, SPACING_M
            sonar = Sonar(
                thesis.pulse, line_array(1, SPACING_M), tx_length_m=15e-3, rx_length_m=15e-3
            )
        track = clsas.Track.straight(
            ((1 - pings) / 2 * spacing_m, 0, 0), (spacing_m, 0, 0), pings, ping_interval_s=1.0
        )
        positions_m = np.array([[*self.point_m, 0.0]])
        if self.points > 1:
            random = np.random.default_rng(1)
            away_m = random.uniform(-0.5, 0.5, (self.points, 2)) * self.side_m
            positions_m = np.pad(away_m, ((0, 0), (0, 1))) + positions_m
        # Ranges from every channel to the whole scene, with a margin for side lobes.
        far_m = math.hypot(NEAREST_M + self.side_m, self.side_m / 2 + 320 * SPACING_M)
        window_m = NEAREST_M - 1, far_m + 1
        echoes = clsas.simulate(sonar, track, clsas.PointTargets(positions_m), range_m=window_m)
        return clsas.compress(echoes, oversampling=1.25)

    @cached_property
    def exact(self) -> clsas.Image:
        """Image by plain backprojection."""
        return self.backproject()

    def backproject(self) -> clsas.Image:
        """Return the exact image."""
        return clsas.backproject(self.lines, self.grid, accuracy_db=ACCURACY_DB, device=self.device)

    def plan(self, **request: object) -> clsas.Plan:
        """Return a plan for `stages`, `tolerance_db` or `tolerance_wavelengths`."""
        return clsas.plan(self.lines, self.grid, device=self.device, **request)

    def form(self, plan: clsas.Plan) -> clsas.Image:
        """Return the image that a plan forms."""
        return clsas.factorize(self.lines, self.grid, plan, device=self.device)

    @cached_property
    def scattered(self) -> Scene:
        """The same scene with many reflectors, for errors that do not depend on one position."""
        return replace(self, points=300)

    def error_db(self, **request: object) -> float:
        """Return the relative rms error of the image that a plan forms, dB."""
        return clsas.relative_error_db(self.form(self.plan(**request)), self.exact)

    def error_m(self, stages: Stages) -> float:
        """Return the range error of all stages according to [45], metres."""
        return sum(stage_errors_m(stages, SPACING_M, self.side_m, NEAREST_M))

    def range_errors_m(self, plan: clsas.Plan) -> np.ndarray:
        """Return range errors of a nearest-beam plan at 1016 pixels, metres [pixels, channels]."""
        random = np.random.default_rng(1)
        pixels = random.integers(0, self.pixels, (1000, 2))
        ends = [0, self.pixels // 2 - 1, self.pixels // 2, self.pixels - 1]
        pixels = np.concatenate([pixels, list(product(ends, ends))])
        return range_errors_m(plan, self.lines, self.grid, pixels)

    def largest_error_m(self, plan: clsas.Plan) -> float:
        """Return the largest range error of a nearest-beam plan, metres."""
        return float(np.abs(self.range_errors_m(plan)).max())

    @cached_property
    def exact_quality(self) -> Quality:
        """Quality of the exact image."""
        return self.measure(self.exact)

    @cached_property
    def exact_peak(self) -> float:
        """Amplitude of the point in the exact image."""
        return clsas.measure_point(self.exact, self.point_m, search_m=GUARD_M).amplitude

    def measure(self, image: clsas.Image) -> Quality:
        """Return the quality of the point in an image."""
        x_m, _ = image.grid.axes_m
        beyond = profile(image)[np.abs(x_m - self.point_m[0]) > GUARD_M]
        try:
            with warnings.catch_warnings():
                # In a useless image, a side lobe may exceed the peak, which gives a warning.
                warnings.simplefilter("ignore", clsas.ClsasWarning)
                found = clsas.measure_point(image, self.point_m, search_m=GUARD_M)
        except ValueError:  # there is no point response
            resolution_m = pslr_db = islr_db = loss_db = math.nan
        else:
            far_db = decibels(beyond, found.amplitude).max(initial=-math.inf)
            resolution_m = found.azimuth.resolution_m
            pslr_db = float(max(*found.azimuth.pslr_db, far_db))
            islr_db = found.azimuth.islr_db
            loss_db = 20 * math.log10(self.exact_peak / found.amplitude)
        error_db = clsas.relative_error_db(image, self.exact)
        return Quality(resolution_m, pslr_db, islr_db, loss_db, error_db)


@dataclass(frozen=True)
class Quality:
    """Measures of the point in an image.

    Attributes
    ----------
    resolution_m : float
        -3 dB width in azimuth.
    pslr_db : float
        Highest side lobe over the peak, either in azimuth through the peak, or anywhere beyond
        `GUARD_M` in azimuth.
    islr_db : float
        Energy of the nearest 10 side lobes on each side over that of the main lobe, in azimuth.
    loss_db : float
        Peak of the exact image over this peak.
    error_db : float
        Relative rms error of the whole image.
    """

    resolution_m: float
    pslr_db: float
    islr_db: float
    loss_db: float
    error_db: float

    def usable(self, exact: Quality) -> bool:
        """Return whether width, side lobes and peak are close to those of the exact image."""
        return (
            abs(self.resolution_m / exact.resolution_m - 1) <= WIDTH - 1
            and self.pslr_db <= exact.pslr_db + PSLR_DB
            and self.loss_db <= LOSS_DB
        )

    def cells(self) -> dict[str, str]:
        """Return the cells of a table by column."""
        return {
            "azimuth mm": f"{1e3 * self.resolution_m:.2f}",
            "PSLR dB": f"{self.pslr_db:.1f}",
            "ISLR dB": f"{self.islr_db:.1f}",
            "loss dB": f"{self.loss_db:.2f}",
            "image error dB": "" if self.error_db == -math.inf else f"{self.error_db:.1f}",
        }


def profile(image: clsas.Image) -> np.ndarray:
    """Return the azimuth point-spread function of the thesis: the maximum over range."""
    return np.abs(image.pixels).max(axis=0)


def decibels(amplitude: np.ndarray, reference: float) -> np.ndarray:
    """Return levels over a reference, at least -200 dB."""
    return 20 * np.log10(np.maximum(amplitude / reference, 1e-10))


def fraction(error_m: float) -> str:
    """Return an error as a fraction of the wavelength, in words."""
    return f"λ/{WAVELENGTH_M / error_m:.4g}"


def name(stages: Stages) -> str:
    """Return stages as text, QR x QI."""
    return " ".join(f"{beams}x{divisions}" for beams, divisions in stages) or "backprojection"


def equal_stages(number: int) -> Stages:
    """Return the plan of the thesis for a number of stages, QR = QI = 2; 1 is backprojection."""
    return [(2, 2)] * (number - 1)


def in_turn(
    work: dict[object, Callable[[], object]],
    repeats: int,
    take: Callable[[Sequence[float]], float] = statistics.median,
) -> dict[object, float]:
    """Return the median seconds of each piece of work, or others, done in turns after a warm-up."""
    taken: dict[object, list[float]] = {key: [] for key in work}
    for repeat in range(repeats + 1):
        for key, do in work.items():
            start = time.perf_counter()
            do()
            if repeat:
                taken[key].append(time.perf_counter() - start)
    return {key: take(each) for key, each in taken.items()}


@dataclass(frozen=True)
class Output:
    """Where a script writes its tables and pictures.

    Attributes
    ----------
    folder : Path or None
        None for the documentation: docs/tables/thesis, and those pictures that are in docs/images.
    device : Device
        What computes, which tables state.
    """

    folder: Path | None
    device: Device

    @classmethod
    def of(cls, given: argparse.Namespace, device: Device) -> Output:
        """Return the output that the command line asks for."""
        if not given.docs:
            given.out.mkdir(parents=True, exist_ok=True)
        return cls(None if given.docs else given.out, device)

    def table(self, stem: str) -> Path:
        """Return the file of a table."""
        return (self.folder or stored_tables.TABLES / "thesis") / f"{stem}.csv"

    def picture(self, stem: str) -> Path | None:
        """Return the file of a picture, or None if the documentation does not show it."""
        if self.folder:
            return self.folder / f"{stem}.png"
        name = stem.removeprefix("figures_").removeprefix("figure_").replace("_", "-")
        shown = stored_tables.ROOT / "docs" / "images" / f"thesis-{name}.png"
        return shown if shown.exists() else None


def add_output(parser: argparse.ArgumentParser) -> None:
    """Add the options of `Output`, and the device."""
    parser.add_argument(
        "--out", type=Path, default=Path("thesis"), help="folder for CSV and PNG files"
    )
    parser.add_argument(
        "--docs",
        action="store_true",
        help="write the tables and pictures of the documentation instead",
    )
    parser.add_argument(
        "--device", help="device, as listed by `clsas devices` [default: the fastest]"
    )


def arguments(description: str, repeats: int | None = None) -> tuple[argparse.Namespace, Scene]:
    """Return the arguments of the command line, and their scene."""
    parser = argparse.ArgumentParser(description=description.splitlines()[0])
    add_output(parser)
    parser.add_argument(
        "--pixels",
        type=int,
        default=PIXELS,
        help="pixels along each side, 4.9 mm each [default: %(default)s]",
    )
    parser.add_argument(
        "--bistatic",
        action="store_true",
        help="put receivers at their true positions, apart from the transmitter",
    )
    if repeats is not None:
        parser.add_argument(
            "--repeats",
            type=int,
            default=repeats,
            help="timed runs of each image [default: %(default)s]",
        )
    given = parser.parse_args()
    scene = Scene(open_device(given.device), given.pixels, given.bistatic)
    given.out = Output.of(given, scene.device)
    print(
        f"{scene.device.info.label}: {scene.lines.channels} lines, {given.pixels} x {given.pixels} "
        f"pixels of {scene.side_m:g} m x {scene.side_m:g} m from {NEAREST_M:g} m"
    )
    return given, scene


def report(
    out: Output,
    stem: str,
    rows: Sequence[Mapping[str, object]],
    origin: dict[str, str] | None = None,
) -> dict[str, str]:
    """Print rows as a Markdown table, write them as CSV, and return their origin.

    By default the origin is this run; pass another one for rows that follow from an earlier table.
    """
    header = list(rows[0])
    origin = origin or _this_run(out)
    cells = [[str(row[column]) for column in header] for row in rows]
    print(stored_tables.markdown(stored_tables.StoredTable(origin, header, cells), stem))
    stored_tables.write(out.table(stem), origin, header, cells)
    return origin


def _this_run(out: Output) -> dict[str, str]:
    """Return the origin of numbers that this run measured."""
    info, options = out.device.info, [each for each in sys.argv[1:] if each != "--docs"]
    command = " ".join([f"scripts/thesis/{Path(sys.argv[0]).name}", *options])
    device = f"{info.name}, {info.compute_units} compute units"
    return stored_tables.here(device, f"{info.platform} {info.driver}", command)


def figure(width: float = 6.0, height: float = 4.0):
    """Return an empty matplotlib figure."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def save(drawn, out: Output, stem: str, dpi: float = 120.0, colours: int = 64) -> None:
    """Write a figure as PNG with few colours, which makes a small file."""
    path = out.picture(stem)
    if path is None:
        return
    plot.save(drawn, path, dpi=dpi)
    path.write_bytes(with_fewer_colours(path, colours))
    print(f"wrote {path}")
