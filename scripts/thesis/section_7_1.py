#!/usr/bin/env python3
"""THESIS section 7.1: which systems suit factorized backprojection.

Six systems are each varied in one way at a time: beam width, range over aperture, size of the
scene, size of the pixels, receivers per ping and carrier frequency. Exact and factorized images at
-40 dB are timed in turns. The pictures show the time that factorization saves against the number
of channels N whose beam touches a pixel. The rule states the number by which N has to be divided.
"""

from __future__ import annotations

import argparse
import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import chapter5
import numpy as np
import stored_tables

import clsas
from clsas.engine.data.system import line_array
from clsas.engine.device.device import Device, open_device
from clsas.engine.factorized.costs import Costs

TOLERANCE_DB = -40.0
POINTS = 50
WORK = 6e9  # most pairs of pixels and channels of a case: an exact image of 4 to 8 s
LINES = 3e8  # most samples of all lines of a case
FEWEST = 30  # channels per pixel from which the rule counts a case
EXACT_IS_SLOW = Costs(pixel_ns=1e4, point_ns=1e4)  # so that every image is factorized


@dataclass(frozen=True)
class System:
    """A system, its survey and its image.

    Attributes
    ----------
    name : str
    carrier_hz, bandwidth_hz, speed_m_s : float
        Band, and speed of sound or light.
    spacing_m : float
        Distance between phase centres along the track.
    beam_deg : float
        Width of the beam that images use; with 180 degrees, they use none.
    range_m : float
        Range of the middle of the scene.
    pixels : int
        Pixels along either side.
    pixel : float
        Size of a pixel, in resolutions along azimuth and range.
    receivers : int
        Receivers per ping, as far apart as two phase centres.
    aperture_m : float or None
        Length of the track, if it is shorter than the beam would allow.
    azimuth_m : float or None
        Size of a pixel along azimuth, if it does not follow from the resolution.
    """

    name: str
    carrier_hz: float
    bandwidth_hz: float
    speed_m_s: float
    spacing_m: float
    beam_deg: float
    range_m: float
    pixels: int = 1024
    pixel: float = 0.5
    receivers: int = 1
    aperture_m: float | None = None
    azimuth_m: float | None = None

    @property
    def wavelength_m(self) -> float:
        """Wavelength at the carrier."""
        return self.speed_m_s / self.carrier_hz

    @property
    def seen_m(self) -> float:
        """Length of the track from which the beam touches a point in the middle of the scene."""
        half = math.radians(min(self.beam_deg, 170.0) / 2)
        seen_m = 2 * self.range_m * math.tan(half)
        return seen_m if self.aperture_m is None else min(seen_m, self.aperture_m)

    @property
    def resolutions_m(self) -> tuple[float, float]:
        """Resolution in azimuth and in range."""
        sine = math.sin(math.atan(self.seen_m / 2 / self.range_m))
        return self.wavelength_m / (4 * sine), self.speed_m_s / (2 * self.bandwidth_hz)

    @property
    def sides_m(self) -> tuple[float, float]:
        """Extent of the scene in azimuth and in range."""
        azimuth_m, across_m = (self.pixel * each_m for each_m in self.resolutions_m)
        along_m = self.pixels * (self.azimuth_m or azimuth_m)
        return along_m, min(self.pixels * across_m, 1.6 * self.range_m)

    @property
    def track_m(self) -> float:
        """Length of the track."""
        return self.aperture_m or self.seen_m + self.sides_m[0]

    @property
    def channels(self) -> int:
        """Number of phase centres, in two pings or more."""
        return self.receivers * max(round(self.track_m / self.spacing_m / self.receivers), 2)

    @property
    def beam(self) -> clsas.BeamWindow | None:
        """Beam of the image."""
        return None if self.beam_deg >= 180 else clsas.BeamWindow(self.beam_deg, "hann")

    @property
    def grid(self) -> clsas.Grid:
        """Grid of the image."""
        along_m, across_m = self.sides_m
        return clsas.Grid.plane(
            (-along_m / 2, along_m / 2, self.pixels),
            (self.range_m - across_m / 2, self.range_m + across_m / 2, self.pixels),
        )

    @cached_property
    def lines(self) -> clsas.RangeLines:
        """Lines of points scattered over the scene."""
        random = np.random.default_rng(1)
        along_m, across_m = self.sides_m
        places_m = np.zeros((POINTS, 3))
        places_m[:, 0] = random.uniform(-0.5, 0.5, POINTS) * along_m
        places_m[:, 1] = self.range_m + random.uniform(-0.5, 0.5, POINTS) * across_m
        phasors = np.exp(2j * np.pi * random.random(POINTS))
        pings = self.channels // self.receivers
        advance_m = self.receivers * self.spacing_m
        ping_m = np.zeros((pings, 1, 3))
        ping_m[:, 0, 0] = (np.arange(pings) - (pings - 1) / 2) * advance_m
        array_m = line_array(self.receivers, 2 * self.spacing_m)[None]
        tx_m = np.broadcast_to(ping_m, (pings, self.receivers, 3)).reshape(-1, 3)
        rx_m = (ping_m + array_m).reshape(-1, 3)
        return clsas.simulate_lines(
            tx_m, rx_m, clsas.PointTargets(places_m, phasors), carrier_hz=self.carrier_hz,
            bandwidth_hz=self.bandwidth_hz, sound_speed_m_s=self.speed_m_s, oversampling=1.25,
        )  # fmt: skip

    @property
    def is_possible(self) -> bool:
        """True if the image and the lines are not too large."""
        along_m, across_m = self.sides_m
        far_m = math.hypot(self.range_m + across_m / 2, (self.track_m + along_m) / 2)
        extent = 2.5 * self.bandwidth_hz * (far_m - self.range_m + across_m / 2) / self.speed_m_s
        return self.channels * self.pixels**2 <= WORK and self.channels * extent <= LINES

    @property
    def per_pixel(self) -> float:
        """Channels whose beam touches a pixel."""
        return min(self.seen_m / self.spacing_m, self.channels)


SOUND, LIGHT = 1500.0, 299792458.0
SYSTEMS = (
    # Ødegaard (2004, chapter 5): elements of 15 mm.
    System("thesis, wide beam", 1e6, 100e3, SOUND, 8.25e-3, math.degrees(0.1), 42.5),
    # Ødegaard (2004, chapter 6): 6 receivers of 0.2 m.
    System("Edgetech", 125e3, 15e3, SOUND, 0.1001, math.degrees(0.06), 60.0, receivers=6),
    # Ødegaard (2004, chapter 6): 96 receivers of one wavelength; the full beam is 60 degrees.
    System("SENSOTEK", 100e3, 37.5e3, SOUND, 7.5e-3, 60.0, 25.0, receivers=96),
    System("5 cm x 5 cm", 100e3, 15e3, SOUND, 0.05, math.degrees(0.15), 100.0, receivers=16),
    System("X-band radar", 9.6e9, 500e6, LIGHT, 0.25, 3.0, 5000.0),
    # An array of 128 elements half a wavelength apart, focused as one phase centre each.
    System("ultrasound array", 5e6, 3e6, 1540.0, 0.077e-3, 90.0, 30e-3, 512, aperture_m=19.7e-3),
)


def beams(system: System) -> Iterator[tuple[str, System]]:
    """Yield the system with other beams."""
    for width_deg in (2, 5, 10, 20, 40, 80, 120, 180):
        yield f"{width_deg} deg", replace(system, beam_deg=float(width_deg))


def ranges(system: System) -> Iterator[tuple[str, System]]:
    """Yield the system at other ranges, with the same track."""
    aperture_m = system.track_m
    for over in (0.5, 1, 2, 4, 8, 16):
        yield f"{over:g}", replace(system, range_m=over * aperture_m, aperture_m=aperture_m)


def sizes(system: System) -> Iterator[tuple[str, System]]:
    """Yield the system with scenes of other sizes."""
    for pixels in (128, 256, 512, 1024, 2048, 4096):
        yield f"{pixels}", replace(system, pixels=pixels)


def pixel_sizes(system: System) -> Iterator[tuple[str, System]]:
    """Yield the system with pixels of other sizes, in the same scene."""
    for factor in (0.5, 1, 2, 4):
        finer = round(system.pixels / factor)
        yield (
            f"{system.pixel * factor:g}",
            replace(system, pixel=system.pixel * factor, pixels=finer),
        )


def receivers(system: System) -> Iterator[tuple[str, System]]:
    """Yield the system with other numbers of receivers per ping, and the same phase centres."""
    for number in (1, 4, 16, 64):
        yield f"{number}", replace(system, receivers=number)


def frequencies(system: System) -> Iterator[tuple[str, System]]:
    """Yield the system at other frequencies, all else but the resolution in azimuth the same."""
    azimuth_m = system.pixel * system.resolutions_m[0]
    for factor in (0.25, 0.5, 1, 2, 4):
        carrier_hz = factor * system.carrier_hz
        if carrier_hz > system.bandwidth_hz:
            other = replace(system, carrier_hz=carrier_hz, azimuth_m=azimuth_m)
            yield f"{carrier_hz:.3g} Hz", other


SWEEPS: dict[str, Callable[[System], Iterator[tuple[str, System]]]] = {
    "beam width": beams,
    "range over aperture": ranges,
    "pixels per side": sizes,
    "pixel over resolution": pixel_sizes,
    "receivers per ping": receivers,
    "carrier": frequencies,
}


def measured(system: System, device: Device, repeats: int) -> dict[str, str]:
    """Return the cells of a table for one case."""
    lines, grid, beam = system.lines, system.grid, system.beam
    request = {"tolerance_db": TOLERANCE_DB, "beam": beam, "device": device}
    chosen = clsas.plan(lines, grid, **request)
    forced = clsas.plan(lines, grid, **request, costs=EXACT_IS_SLOW)
    with (
        clsas.Imager(lines, grid, accuracy_db=TOLERANCE_DB, beam=beam, device=device) as exact,
        clsas.Imager(lines, grid, forced, device=device) as factorized,
    ):
        images = exact(lines), factorized(lines)
        seconds = chapter5.in_turn(
            {"exact": lambda: exact(lines), "factorized": lambda: factorized(lines)}, repeats
        )
    error_db = clsas.relative_error_db(images[1], images[0])
    return {
        "channels": f"{lines.channels}",
        "per pixel": f"{system.per_pixel:.0f}",
        "pixels": f"{grid.shape[0]} x {grid.shape[1]}",
        "subimages": " ".join(f"{each.rows}x{each.columns}" for each in forced.stages[:-1]),
        "virtual channels": " ".join(str(each.channels) for each in forced.stages[:-1]),
        "exact s": f"{seconds['exact']:.3g}",
        "factorized s": f"{seconds['factorized']:.3g}",
        "speed-up": f"{seconds['exact'] / seconds['factorized']:.2f}",
        "error dB": f"{error_db:.1f}",
        "chosen": "exact" if chosen.is_exact else "factorized",
    }


Rows = Sequence[dict[str, str]]


def rule(rows: Rows) -> list[dict[str, str]]:
    """Return by what N has to be divided, for the usual case and for others."""
    usual = [each for each in rows if _is_usual(each)]
    # The ultrasound array, whose scene begins a third of an aperture in front of it, has no rule.
    far = [each for each in rows if each["system"] != "ultrasound array"]
    cases = {
        "as above, beam of up to 20°": usual,
        "pixels as large as the resolution": _varied(far, "pixel over resolution", 1),
        "pixels twice as large as the resolution": _varied(far, "pixel over resolution", 2),
        "512 pixels along each side": _varied(far, "pixels per side", 512),
        "256 pixels along each side": _varied(far, "pixels per side", 256),
        "beam of 40°": _varied(far, "beam width", 40),
        "beam of 80°": _varied(far, "beam width", 80),
        "range of the whole aperture": _varied(far, "range over aperture", 1),
        "range of half the aperture": _varied(far, "range over aperture", 0.5),
    }
    found = []
    for case, some in cases.items():
        enough = [each for each in some if float(each["per pixel"]) >= FEWEST]
        if not enough:
            continue
        divisors = [float(each["per pixel"]) / float(each["speed-up"]) for each in enough]
        least, quarter, median, most_of, most = np.percentile(divisors, (0, 25, 50, 75, 100))
        found.append(
            {
                "case": case,
                "images": str(len(divisors)),
                "divide N by": f"{median:.0f}",
                "half of the images": f"{quarter:.0f} to {most_of:.0f}",
                "all": f"{least:.0f} to {most:.0f}",
            }
        )
    return found


def _value(row: dict[str, str]) -> float:
    """Return the number that was varied, without its unit."""
    return float(row["value"].split()[0])


def _varied(rows: Rows, sweep: str, value: float) -> Rows:
    """Return the rows of a sweep at one value."""
    return [each for each in rows if each["varied"] == sweep and _value(each) == value]


def _is_usual(row: dict[str, str]) -> bool:
    """Return True for fine pixels, narrow beams, long ranges and the system's own carrier."""
    sweep, value = row["varied"], _value(row)
    return (
        row["system"] != "ultrasound array"
        and row["pixels"] == "1024 x 1024"
        and (row["system"] != "SENSOTEK" or sweep == "beam width")
        and not (sweep == "beam width" and value > 20)
        and not (sweep == "range over aperture" and value < 2)
        and not (sweep == "pixel over resolution" and value > 0.5)
        and sweep != "carrier"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    chapter5.add_output(parser)
    parser.add_argument("--pixels", type=int, help="pixels along each side, instead of 1024")
    parser.add_argument("--sweep", action="append", choices=SWEEPS, help="only this sweep")
    names = [system.name for system in SYSTEMS]
    parser.add_argument("--system", action="append", choices=names, help="only this system")
    parser.add_argument("--repeats", type=int, default=3, help="timed runs [default: %(default)s]")
    parser.add_argument(
        "--again", action="store_true", help="evaluate the stored table; nothing is measured"
    )
    given = parser.parse_args()
    device = open_device(given.device)
    out = chapter5.Output.of(given, device)
    if given.again:
        stored = stored_tables.read(out.table("section_7_1"))
        rows = [dict(zip(stored.header, row, strict=True)) for row in stored.rows]
        evaluate(rows, out, stored.origin)
        return
    rows = []
    for sweep in given.sweep or SWEEPS:
        for system in SYSTEMS:
            if system.name not in (given.system or names):
                continue
            if given.pixels:
                system = replace(system, pixels=given.pixels)
            for value, case in SWEEPS[sweep](system):
                if not case.is_possible:
                    continue
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", clsas.ClsasWarning)
                    cells = measured(case, device, given.repeats)
                rows.append({"varied": sweep, "system": system.name, "value": value} | cells)
                print(*rows[-1].values(), sep=" | ", flush=True)
    evaluate(rows, out, chapter5.report(out, "section_7_1", rows))


def evaluate(rows: Rows, out: chapter5.Output, origin: dict[str, str]) -> None:
    """Write the rule that follows from rows, and the picture."""
    divisors = rule(rows)
    if divisors:
        chapter5.report(out, "section_7_1_rule", divisors, origin)
    draw(rows, float(divisors[0]["divide N by"]) if divisors else None, out)


def draw(rows: Rows, divisor: float | None, out: chapter5.Output) -> None:
    """Draw the speed-up over the channels per pixel, or over what is varied at equal ones."""
    sweeps = list(dict.fromkeys(each["varied"] for each in rows))
    figure = chapter5.figure(11, 6.5)
    panels = np.ravel(figure.subplots(2, 3, sharey=True))
    for sweep, axes in zip(sweeps, panels, strict=False):
        per_pixel = sweep in ("beam width", "range over aperture")
        ticks = set()
        for system in SYSTEMS:
            some = [r for r in rows if (r["varied"], r["system"]) == (sweep, system.name)]
            x = [float(r["per pixel"]) if per_pixel else _value(r) for r in some]
            if sweep == "carrier":
                x = [float(f"{each / system.carrier_hz:.2g}") for each in x]
            ticks |= set(x)
            speed_up = [float(r["speed-up"]) for r in some]
            axes.loglog(x, speed_up, "o-", label=system.name, markersize=4)
        if per_pixel and divisor:
            channels = np.array([divisor, 100 * divisor])
            axes.loglog(channels, channels / divisor, "k--", label=f"N/{divisor:g}")
        if not per_pixel:
            axes.set_xticks(sorted(ticks), [f"{each:g}" for each in sorted(ticks)])
            axes.minorticks_off()
        axes.axhline(1.0, color="grey", linestyle=":")
        axes.set_title(f"varied: {sweep}", fontsize="medium")
        label = "carrier over the system's own" if sweep == "carrier" else sweep
        axes.set_xlabel("N, channels whose beam touches a pixel" if per_pixel else label)
        axes.grid(alpha=0.3)
    figure.supylabel("Time of the exact image over that of the factorized one, both at -40 dB")
    panels[0].legend(fontsize="small")
    chapter5.save(figure, out, "section_7_1", dpi=90)


if __name__ == "__main__":
    main()
