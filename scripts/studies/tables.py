"""Tables of docs/benchmarks.md and docs/accuracy.md, printed as Markdown."""

from __future__ import annotations

import dataclasses
import itertools
import multiprocessing
import resource
import tempfile
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
from scipy import stats

import clsas
from clsas import plot
from clsas.engine.data.image_error import levels
from clsas.engine.device.device import open_device
from clsas.engine.exact.decide import ACCURACY_DB
from clsas.engine.factorized.plan import ExactImage
from clsas.engine.forming import form
from clsas.engine.scene import Scene
from clsas.engine.signal.interpolation import TAPS
from clsas.measures.quality import dark_level_db
from clsas.selftest import bench, cases, wreck
from clsas.simulation import seabeds
from studies.scaling import scaled

TOLERANCES_DB = {
    "ffbp-thesis": (-40.0,),
    "ffbp-2k": (-50.0, -30.0),
    **dict.fromkeys(cases.DENSE_CASES, (-40.0,)),
}
"""Tolerances for the cases of factorized imaging, dB; -50 for all others."""
FITTED = 4  # exponents are fitted to sizes down to this fraction of the largest
CONFIDENCE = 0.95  # of the intervals of exponents
SHADOW_PIXELS = 1024  # along each side of the wreck's scene, 64 m x 56 m
SHADOW_TOLERANCES_DB = (-20.0, -30.0, -40.0, -50.0, -60.0)
SHADOW_LEVELS_DB = (
    10,
    0,
    -5,
    -10,
    -15,
    -20,
    -25,
)  # level around a pixel, relative to the rms value
SIZES = (256, 384, 512, 768, 1024, 1536, 2048, 3072, 4096, 6144, 8192)
"""Numbers of channels of `scaling`, and of pixels along each side."""


def table(header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Print a Markdown table."""
    print("|", " | ".join(header), "|")
    print("|", " | ".join("---" for _ in header), "|")
    for row in rows:
        print("|", " | ".join(str(cell) for cell in row), "|", flush=True)


def of_several(devices: Sequence[str], cell: str) -> list[str]:
    """Return a cell of the column of devices, which a table of one device does not have."""
    return [cell] if len(devices) > 1 else []


def speed(devices: list[str]) -> None:
    """Print speed and errors of exact imaging of the built-in cases at -50 and -80 dB."""
    rows = []
    for case in cases.EXACT_CASES:
        for accuracy_db in (-50.0, -80.0):
            for device in devices:
                r = bench.run(case, device=device, accuracy_db=accuracy_db)
                rows.append(
                    [
                        case,
                        r["device"],
                        r["driver"],
                        f"{r['taps']} at {r['upsampling']:.2f}",
                        "{median:.3f} ({min:.3f} to {max:.3f})".format(**r["seconds"]),
                        f"{r['gbp_per_s']:.2f}",
                        f"{r['kernel_gbp_per_s']:.2f}",
                        f"{r['gflop_per_s']:.0f}",
                        f"{100 * r['share_of_peak']:.0f} %",
                        f"{r['rounding_error_db']:.1f}",
                        f"{r['true_error_db']:.1f}",
                    ]
                )
    table(
        [
            "case",
            "device",
            "driver",
            "taps, upsampling",
            "seconds: median (min to max)",
            "GBP/s",
            "kernel GBP/s",
            "GFLOP/s",
            "of peak",
            "rounding dB",
            "true error dB",
        ],
        rows,
    )


def presets(devices: list[str]) -> None:
    """Print the interpolators chosen by `accuracy_db` and their errors, on the first device."""
    rows = []
    for accuracy_db in (-20, -30, -40, -50, -60, -70, -80, -85):
        r = bench.run("bp-thesis", device=devices[0], accuracy_db=accuracy_db, repeats=3)
        rows.append(
            [
                accuracy_db,
                r["taps"],
                f"{r['upsampling']:.2f}",
                f"{r['predicted_error_db']:.1f}",
                f"{r['true_error_db']:.1f}",
                f"{r['rounding_error_db']:.1f}",
                f"{r['gbp_per_s']:.2f}",
            ]
        )
    header = [
        "accuracy_db",
        "taps",
        "upsampling",
        "predicted dB",
        "true dB",
        "rounding dB",
        "GBP/s",
    ]
    table(header, rows)


def taps(devices: list[str]) -> None:
    """Print the kernel time by taps, the source of `clsas.engine.signal.interpolation.COST`."""
    case = dataclasses.replace(cases.EXACT_CASES["bp-thesis"], channels=512)
    lines, grid = case.lines(), case.grid
    best: dict[tuple[str, int], float] = {}
    for _ in range(5):
        for name in devices:
            device = open_device(name)
            for count in TAPS:
                method = ExactImage(ACCURACY_DB, taps=count, upsampling=3.0)
                with device.profile() as times:
                    form(Scene.of(lines, grid, None, None), method, device)
                seconds = times["backproject_tiles"].total_s
                best[name, count] = min(best.get((name, count), seconds), seconds)
    pairs = lines.channels * grid.size
    rows = [[n, c, f"{pairs / s / 1e9:.2f}", f"{s / best[n, 4]:.2f}"] for (n, c), s in best.items()]
    table(["device", "taps", "kernel GBP/s", "time over that of 4 taps"], rows)


def simulation(devices: list[str]) -> None:
    """Print time and memory of a simulation of 100 000 points on 1200 channels."""
    random = np.random.default_rng(1)
    positions = random.uniform([-40, 50, 0], [40, 90, 0], (100_000, 3))
    scene = clsas.PointTargets(positions, random.standard_normal(100_000))
    track = clsas.Track.straight((-40, 0, 0), (2, 0, 0), pings=200, ping_interval_s=0.2)
    directive = clsas.Sonar.edgetech()
    plain = dataclasses.replace(directive, tx_length_m=None, rx_length_m=None)
    rows = []
    for name, sonar in (("none", plain), ("of tx and rx", directive)):
        start, processor = time.perf_counter(), time.process_time()
        clsas.simulate(sonar, track, scene)
        times = time.perf_counter() - start, time.process_time() - processor
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        rows.append([name, *(f"{value:.1f}" for value in times), f"{memory:.0f}"])
    table(["element patterns", "seconds", "processor seconds", "peak memory, MiB"], rows)


def simulation_along_rays(devices: list[str], turns: int = 3) -> None:
    """Print processor time of simulations below a thermocline, relative to water of one speed.

    Both take turns, and the shortest times count.
    """
    random = np.random.default_rng(1)
    positions = random.uniform([-40, 50, 0], [40, 90, 0], (100_000, 3))
    points = clsas.PointTargets(positions, random.standard_normal(100_000))
    seabed = seabeds.wreck(density_m2=100)
    track = clsas.Track.straight((-2, 0, 20), (2, 0, 0), pings=4, ping_interval_s=0.2)
    directive = clsas.Sonar.edgetech()
    plain = dataclasses.replace(directive, tx_length_m=None, rx_length_m=None)
    profile = clsas.SoundSpeed(
        np.array([0.0, 12, 15, 60]), np.array([1505.0, 1504, 1494, 1490]), surface_z_m=30
    )
    rows = []
    for name, sonar, scene, spreading in (
        ("points", plain, points, False),
        ("points, spreading", plain, points, True),
        ("points, element patterns, spreading", directive, points, True),
        ("wreck, element patterns, spreading", directive, seabed, True),
    ):
        times: dict[bool, list[float]] = {False: [], True: []}
        for bent in [False, True] * turns:
            start = time.process_time()
            water = profile if bent else None
            clsas.simulate(sonar, track, scene, spreading=spreading, sound_speed=water, workers=1)
            times[bent].append(time.process_time() - start)
        straight_s, bent_s = min(times[False]), min(times[True])
        rows.append([name, f"{straight_s:.2f}", f"{bent_s:.2f}", f"{bent_s / straight_s:.2f}"])
    table(["scene", "one speed, processor s", "profile, processor s", "ratio"], rows)


def factorized(devices: list[str], names: list[str] | None = None) -> None:
    """Print speed and errors of factorized and exact imaging, for all or some cases."""
    rows = []
    for case, device in itertools.product(names or cases.FACTORIZED_CASES, devices):
        for tolerance_db in TOLERANCES_DB.get(case, (-50.0,)):
            r = bench.run_factorized(case, device=device, tolerance_db=tolerance_db, repeats=3)
            rows.append(
                [
                    case,
                    r["device"],
                    r["driver"],
                    r["tolerance_db"],
                    "{median:.3f} ({min:.3f} to {max:.3f})".format(**r["seconds"]),
                    *(
                        f"{r[key]['median']:.3f}"
                        for key in ("again_seconds", "moved_seconds", "plan_seconds")
                    ),
                    f"{r['predicted_seconds']:.3f}",
                    "{median:.3f} ({min:.3f} to {max:.3f})".format(**r["exact_seconds"]),
                    f"{r['speedup']:.1f}",
                    f"{r['speedup_again']:.1f}",
                    f"{r['speedup_over_default']:.1f}",
                    f"{r['error_db']:.1f}",
                    f"{r['predicted_error_db']:.1f}",
                ]
            )
    table(
        [
            "case",
            "device",
            "driver",
            "tolerance dB",
            "seconds: median (min to max)",
            "again",
            "moved",
            "planning",
            "predicted",
            "exact: median (min to max)",
            "speedup",
            "again",
            "over default",
            "error dB",
            "predicted dB",
        ],
        rows,
    )


def scaling(device: str, largest: int, png_file: str | None) -> None:
    """Print the times for N channels and N x N pixels by N, and the exponents of their growth."""
    sizes = [size for size in SIZES if size <= largest]
    measured = [
        # Large images take minutes, and their times vary little from run to run.
        bench.run_factorized(scaled(size), device=device, repeats=3 if size <= 4096 else 1)
        for size in sizes
    ]
    seconds = {
        "factorized": [r["seconds"]["median"] for r in measured],
        "exact": [r["exact_seconds"]["median"] for r in measured],
    }
    names = ["N", "factorized_s", "exact_s", "speedup", "plan_s", "error_db", "predicted_error_db"]
    rows = [
        [
            size,
            *(f"{r[key]['median']:.4g}" for key in ("seconds", "exact_seconds")),
            f"{r['speedup']:.4g}",
            f"{r['plan_seconds']['median']:.4g}",
            *(f"{r[key]:.1f}" for key in ("error_db", "predicted_error_db")),
        ]
        for size, r in zip(sizes, measured, strict=True)
    ]
    table(names, rows)
    print(f"\n{measured[0]['device']}, {measured[0]['driver']}: time grows as N to the power of\n")
    growths = {name: growth(sizes, times) for name, times in seconds.items()}
    table(["image", *GROWTH_COLUMNS], [[name, *each.cells] for name, each in growths.items()])
    if png_file is not None:
        draw_scaling(sizes, seconds, growths, measured[0]["device"], png_file)


GROWTH_COLUMNS = ("exponent", f"{CONFIDENCE:.0%} interval", "sizes", "N")


@dataclasses.dataclass(frozen=True)
class Growth:
    """A power of N that is fitted to times.

    Attributes
    ----------
    exponent : float
    half_width : float
        Half width of its confidence interval; not a number with fewer than three sizes.
    sizes : list of int
        Sizes that it is fitted to.
    """

    exponent: float
    half_width: float
    sizes: list[int]

    @property
    def cells(self) -> list[str]:
        """Cells of `GROWTH_COLUMNS`."""
        ends = (self.exponent - self.half_width, self.exponent + self.half_width)
        interval = "" if np.isnan(self.half_width) else "{:.2f} to {:.2f}".format(*ends)
        of = f"{self.sizes[0]} to {self.sizes[-1]}"
        return [f"{self.exponent:.2f}", interval, str(len(self.sizes)), of]


def growth(sizes: Sequence[int], times: Sequence[float]) -> Growth:
    """Return the power of N that fits the logarithms of times best, by least squares.

    It is fitted to the largest sizes, because small images have fixed costs. Its interval is that
    of Student's t, for errors of the logarithms that are independent and of equal variance.
    """
    few = [index for index, size in enumerate(sizes) if FITTED * size >= max(sizes)]
    fitted = [sizes[index] for index in few]
    if len(few) < 2:
        return Growth(np.nan, np.nan, fitted)
    found = stats.linregress(np.log(fitted), np.log([times[index] for index in few]))
    free = len(few) - 2
    half_width = found.stderr * stats.t.ppf((1 + CONFIDENCE) / 2, free) if free else np.nan
    return Growth(float(found.slope), float(half_width), fitted)


def draw_scaling(
    sizes: Sequence[int],
    seconds: dict[str, list[float]],
    growths: dict[str, Growth],
    device: str,
    png_file: str,
) -> None:
    """Draw the table of `scaling`."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 5), layout="constrained")
    axes = figure.subplots()
    for (name, times), marker in zip(seconds.items(), "oD", strict=True):
        grows = growths[name]
        label = f"{name}: N^({grows.exponent:.2f} ± {grows.half_width:.2f})"
        axes.loglog(sizes, times, marker=marker, label=label)
    axes.set(
        xlabel="N (channels; the image has N x N pixels)", ylabel="time of the image (s)",
        xticks=sizes, xticklabels=sizes,
    )  # fmt: skip
    axes.set_title(f"tolerance -50 dB\n{device}", fontsize="small")
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    axes.legend()
    plot.save_png(figure, png_file)


SURVEY_M = 500.0
SURVEY_PARTS, SURVEY_PINGS = 26, 50  # files, and pings per file, which are 0.4 m apart
DAY_S = 86_400.0


def shadows(devices: list[str]) -> None:
    """Print errors in the wreck's shadows by the local level, to which they are relative."""
    lines, grid = wreck.lines(), wreck.grid(SHADOW_PIXELS)
    beam = cases.MOSAIC_CASES["mosaic-wreck"][1]
    rows = []
    for device in devices:
        exact = clsas.backproject(lines, grid, beam=beam, accuracy_db=-85, device=device).pixels
        level_db = 10 * np.log10(levels(exact) / np.mean(np.abs(exact / np.abs(exact).max()) ** 2))
        for tolerance_db in SHADOW_TOLERANCES_DB:
            image = clsas.factorize(lines, grid, tolerance_db, beam=beam, device=device).pixels
            errors = [f"{clsas.relative_error_db(image, exact):.1f}"]
            errors.append(f"{clsas.relative_error_db(image, exact, darkest=0.1):.1f}")
            for middle_db in SHADOW_LEVELS_DB:
                chosen = np.abs(level_db - middle_db) <= 2.5
                error_db = clsas.relative_error_db(image[chosen], exact[chosen])
                errors.append(f"{error_db:.1f}")
            rows.append([*of_several(devices, device), f"{tolerance_db:g}", *errors])
        share = [np.mean(np.abs(level_db - middle_db) <= 2.5) for middle_db in SHADOW_LEVELS_DB]
        darkest = f"{dark_level_db(exact):.1f} dB"
        shares = [f"{100 * each:.2g} %" for each in share]
        level = "level, share of the image"
        rows.append([*of_several(devices, device), level, "", darkest, *shares])
    header = [*of_several(devices, "device"), "tolerance dB", "image", "darkest tenth"]
    table([*header, *(f"{middle_db} dB" for middle_db in SHADOW_LEVELS_DB)], rows)


def survey_lines(folder: str, part: int) -> None:
    """Write a file of a survey with a swaying Edgetech array over one point per square metre."""
    pings = np.arange(part * SURVEY_PINGS, (part + 1) * SURVEY_PINGS)
    # The track extends 10 m beyond the image at each end, more than half the beam's footprint.
    centre_m = np.zeros((len(pings), 3))
    centre_m[:, 0] = 0.4 * pings - 10
    centre_m[:, 1] = 0.2 * np.sin(2 * np.pi * pings / 57)
    centre_m[:, 2] = 20
    sonar = clsas.Sonar.edgetech()
    rx_m = (centre_m[:, None] + sonar.rx_m).reshape(-1, 3)
    tx_m = np.repeat(centre_m, sonar.receivers, axis=0)
    random = np.random.default_rng(1)
    points = np.zeros((int(100 * (SURVEY_M + 60)), 3))
    points[:, 0] = random.uniform(-30, SURVEY_M + 30, len(points))
    points[:, 1] = random.uniform(30, 130, len(points))
    near = np.abs(points[:, 0] - centre_m[:, 0].mean()) < 20
    amplitudes = (random.standard_normal((len(points), 2)) @ [1, 1j])[near]
    lines = clsas.simulate_lines(
        tx_m,
        rx_m,
        clsas.PointTargets(points[near], amplitudes),
        carrier_hz=sonar.pulse.carrier_hz,
        bandwidth_hz=sonar.pulse.bandwidth_hz,
        first_range_m=30.0,
        length=4096,
    )
    clsas.save(Path(folder) / f"{part:04}.h5", lines)


def survey(devices: list[str]) -> None:
    """Print rate and peak memory of a mosaic of 100 m x 500 m at 5 cm from 300 MB of files."""
    grid = clsas.Grid.plane((0, SURVEY_M, 10_001), (30, 130, 2001))
    beam = clsas.BeamWindow(6.0, "hann")
    with tempfile.TemporaryDirectory() as folder:
        # Simulate in other processes, so that the peak memory of this one is that of imaging.
        with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as pool:
            list(pool.map(survey_lines, [folder] * SURVEY_PARTS, range(SURVEY_PARTS)))
        size = sum(file.stat().st_size for file in Path(folder).iterdir())
        rows: list[list[object]] = []
        for name in devices:
            before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            start = time.perf_counter()
            mosaic = clsas.mosaic(
                folder,
                grid,
                Path(folder) / f"{len(rows)}.zarr",
                tolerance_db=-40,
                beam=beam,
                device=name,
            )
            records = [patch.record for patch in mosaic]
            seconds = time.perf_counter() - start
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            rate = grid.size / seconds
            _, row_step_m, column_step_m = grid.vectors_m
            square_m = np.linalg.norm(row_step_m) * np.linalg.norm(column_step_m)
            predicted_db = [
                r.predicted_error_db for r in records if r.channels > r.missing_channels
            ]
            rows.append(
                [
                    name,
                    f"{size / 2**20:.0f}",
                    "{} x {} of {} x {}".format(*mosaic.shape, *mosaic.patch_shape),
                    f"{seconds:.1f}",
                    f"{sum(r.plan_seconds for r in records):.1f}",
                    f"{sum(r.read_seconds for r in records):.1f}",
                    f"{max(each for each in predicted_db if each is not None):.1f}",
                    f"{rate / 1e6:.2f}",
                    f"{rate * square_m * DAY_S / 1e6:.0f}",
                    f"{peak:.0f} ({before:.0f})",
                ]
            )
    table(
        [
            "device",
            "lines, MiB",
            "patches",
            "seconds",
            "planning",
            "reading",
            "predicted dB",
            "Mpixel/s",
            "square km per day",
            "peak memory, MiB (before)",
        ],
        rows,
    )
