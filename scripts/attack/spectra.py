"""Image lines with difficult spectra, and compare errors with the requests or with warnings.

Thin guard bands: echoes of four points from two pings of the thesis's sonar, with flat and tilted
spectra (10 dB), are compressed with less and less oversampling. The reference is an image of lines
with an oversampling of 4. Offsets: lines on their carrier contain a constant. The reference is the
oracle.

    python scripts/attack/spectra.py [--device NAME]

The exit code is 1 if the error of any image exceeds the request, and no warning predicted it.
"""

import argparse
import dataclasses
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
from exactly import prepare

import clsas
from clsas.engine.factorized.costs import Costs
from clsas.selftest.extremes import raw

POINTS = [(0.0, 42.5, 0), (0.08, 42.505, 0), (-0.07, 42.49, 0), (0.03, 42.512, 0)]
SLOW_EXACT = Costs(pixel_ns=1e6, point_ns=1e6)  # so that small images are factorized
MISSES = []


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", help="index, kind or name")
    device = parser.parse_args().device
    print("errors in dB: requested, measured (predicted); ! marks predictions that a warning gave")
    for length_m in (0.0, 2.5):
        for tilt_db in (0, 10, -10):
            guard_bands(tilt_db, length_m, device)
    for offset in (0.0, 0.01, 0.03, 0.1, 0.3, 1.0):
        known = raw(300, oversampling=12.5, offset=offset)
        report(f"offset {offset:4.0%} of rms", known.lines, known.grid, known.error_db, device)
    print(f"{len(MISSES)} missed" if MISSES else "none missed")
    sys.exit(bool(MISSES))


def guard_bands(tilt_db: float, length_m: float, device: str | None) -> None:
    """Image lines with ever thinner guard bands, which end `length_m` beyond the points."""
    sonar = clsas.Sonar.thesis_wide_beam()
    track = clsas.Track.straight((-0.264, 0, 0), (2, 0, 0), pings=2, ping_interval_s=0.264)
    span = (42.5 - length_m, 42.5 + length_m) if length_m else None
    echoes = clsas.simulate(sonar, track, clsas.PointTargets(POINTS), range_m=span)
    grid = clsas.Grid.plane((-0.1, 0.1, 256), (42.4, 42.6, 256))

    echoes = tilted(echoes, tilt_db)
    fine = clsas.compress(echoes, oversampling=4.0)
    reference = clsas.backproject(fine, grid, accuracy_db=-85, device=device)
    for oversampling in (2.0, 1.5, 1.4, 1.25, 1.1, 1.05, 1.0):
        report(
            f"tilt {tilt_db:3} dB, {'long' if length_m else 'short'} lines, "
            f"oversampling {oversampling:4}",
            clsas.compress(echoes, oversampling=oversampling),
            grid,
            lambda pixels: clsas.relative_error_db(clsas.Image(pixels, grid), reference),
            device,
        )


def tilted(echoes: clsas.Echoes, tilt_db: float) -> clsas.Echoes:
    """Return echoes whose spectrum rises by `tilt_db` over the band of the pulse."""
    frequency = np.fft.fftfreq(2 * echoes.length, 1 / echoes.sample_rate_hz)
    relative = np.clip(frequency / echoes.pulse.bandwidth_hz, -0.5, 0.5)
    padded = np.pad(echoes.samples, ((0, 0), (0, echoes.length)))
    samples = np.fft.ifft(np.fft.fft(padded) * 10 ** (tilt_db / 20 * relative))
    return dataclasses.replace(echoes, samples=samples[:, : echoes.length])


def report(
    name: str,
    lines: clsas.RangeLines,
    grid: clsas.Grid,
    error_db: Callable[[np.ndarray], float],
    device: str | None,
) -> None:
    """Print one row of the table: errors of the exact and of the factorized image."""
    row = f"{name:45}"
    for asked_db in (-80, -50):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            if asked_db == -80:
                image = clsas.backproject(lines, grid, accuracy_db=asked_db, device=device)
                predicted_db = prepare(lines, grid, accuracy_db=asked_db, device=device).error_db
            else:
                plan = clsas.plan(
                    lines, grid, tolerance_db=asked_db, device=device, costs=SLOW_EXACT
                )
                image = clsas.factorize(lines, grid, plan, device=device)
                predicted_db = plan.predicted_error_db
        warned = any("the error may be" in str(each.message) for each in caught)
        measured_db = error_db(image.pixels)
        missed = measured_db > (max(asked_db, predicted_db) if warned else asked_db)
        row += f"  {asked_db}: {measured_db:6.1f} ({predicted_db:6.1f}{'!' if warned else ' '})"
        if missed:
            MISSES.append(name)
            row += " missed"
    print(row, flush=True)


if __name__ == "__main__":
    main()
