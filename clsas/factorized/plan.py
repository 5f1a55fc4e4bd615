"""A factorized image, decided: how it is divided, with which filters, and what to expect."""

from __future__ import annotations

import functools
import hashlib
import json
import weakref
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsas.core import reprs, validate
from clsas.core.grid import Grid
from clsas.core.lines import RangeLines
from clsas.core.reading import parse_json
from clsas.core.tables import Report, Table
from clsas.factorized.estimates import ErrorBudget, Work, estimate_of
from clsas.opencl import phases
from clsas.signal.interpolation import PHASES, UPSAMPLING_TAPS, Interpolator, Resampling, Upsampler
from clsas.sonar.beam import BeamWindow
from clsas.sonar.simplify import EFFECTS, Model, leave_out

CHUNK = 32
"""Channels that a stage adds up before it hands on the sums, and takes up those still open."""
LEAST_BATCH = 2
"""Roots that are worked on together at least, if they fit the memory: fewer commands."""


@dataclass(frozen=True)
class Stage:
    """The predicted work of one stage.

    Attributes
    ----------
    rows, columns : int
        Pixels of its subimages.
    subimages : int
        How many there are in the grid.
    channels : int
        Virtual channels of each, on average.
    samples : int
        Range samples of each line.
    operations : float
        Samples times channels that are aligned and combined; for the last row of a plan pixels
        times channels that are backprojected.
    error_db : float
        Relative rms error that its interpolations add.
    seconds : float
        Expected time.
    """

    rows: int
    columns: int
    subimages: int
    channels: int
    samples: int
    operations: float
    error_db: float
    seconds: float


@dataclass(frozen=True, eq=False)
class Plan:
    """An image, decided before the device starts; made by `plan`, used by `factorize`.

    A root subimage is formed from the lines themselves; each stage divides the subimages of the one
    before and combines their channels into fewer, virtual ones; the last stage's are backprojected.

    Attributes
    ----------
    tolerance_db : float or None
        Relative rms error asked for; None where stages were given.
    sides : tuple of (rows, columns)
        Pixels of a subimage, stage by stage. Empty: plain backprojection, since nothing beats it.
    tile : (rows, columns)
        Pixels that are backprojected together: the last stage's subimages, or parts of them.
    nearest : tuple of int
        THESIS QR, stage by stage: neighbours that are summed into one beam; empty where the
        aperture is interpolated.
    align, aperture, final : Interpolator or None
        Filters in range, of the aperture (its `upsampling` is the density of virtual channels over
        the least), and in range for the last stage.
    resampling : Resampling or None
        Where samples go when lines are upsampled first.
    upsampler : Upsampler or None
        What does that; None by FFT.
    half_precision : bool
        Whether lines are handed on from stage to stage in half precision: half of the memory.
    half_lengths : tuple of int
        Samples to either side of a subimage's centre that its lines hold, stage by stage.
    highest_cycles_per_m : float
        Phase per metre of range at the upper end of the lines' band.
    closest_m : float
        Distance from the track that no pixel is nearer than.
    roots_at_once, roots_prepared : int
        Root subimages that are worked on together, and whose geometry is prepared together.
    stages : tuple of Stage
        What is expected of every stage, and of the backprojection at the end.
    predicted_error_db, predicted_seconds : float
        Relative rms error against the exact image, as a bound, and time on the device asked for.
    exact_seconds : float
        Time that `clsas.backproject` is expected to take.
    memory_bytes : int
        Largest amount of device memory needed.
    device : str
        Whose times these are.
    lines_digest, grid_digest : str
        Of the geometry that this plan was made for.
    accuracy_db : float or None
        Of plain backprojection, by itself; None where the image is factorized.
    beam : BeamWindow or None
    limits : (low, high) or None
        Sines of the aspect angle between which channels are used: where the beam weighs anything
        to speak of.
    crowding : tuple of float
        By how much virtual channels are denser than band-limited steering functions need, stage by
        stage: where their spacing changes along the track filters err.
    beam_cycles : float
        For how many cycles per edge of the beam the last stage's virtual channels are dense enough.
    most_channels : tuple of int
        Virtual channels of a subimage, stage by stage, that there is room for from the beginning.
    band : (centre, half width) or None
        Frequencies, cycles per sample, that filters are made for where the aperture is
        interpolated.
    calibrated : bool
        Whether times follow from costs that were measured on this device or given, and not from
        defaults.
    left_out : tuple of str
        Effects that the image does without, since their error lies far below the tolerance: see
        `clsas.sonar.simplify`.
    work, errors : Work, ErrorBudget or None
        What the predicted time and error are made of; None in plans of older versions.
    """

    tolerance_db: float | None
    sides: tuple[tuple[int, int], ...]
    tile: tuple[int, int]
    nearest: tuple[int, ...]
    align: Interpolator | None
    aperture: Interpolator | None
    final: Interpolator | None
    resampling: Resampling | None
    upsampler: Upsampler | None
    half_precision: bool
    half_lengths: tuple[int, ...]
    highest_cycles_per_m: float
    closest_m: float
    roots_at_once: int
    roots_prepared: int
    stages: tuple[Stage, ...]
    predicted_error_db: float
    predicted_seconds: float
    exact_seconds: float
    memory_bytes: int
    device: str
    lines_digest: str
    grid_digest: str
    accuracy_db: float | None = None
    beam: BeamWindow | None = None
    limits: tuple[float, float] | None = None
    crowding: tuple[float, ...] = ()
    beam_cycles: float = 0.0
    most_channels: tuple[int, ...] = ()
    band: tuple[float, float] | None = None
    calibrated: bool = True
    left_out: tuple[str, ...] = ()
    work: Work | None = None
    errors: ErrorBudget | None = None

    def __post_init__(self) -> None:
        """Check what sizes buffers and indices."""

        def check(good: bool, name: str, wanted: str) -> None:
            if not good:
                raise ValueError(
                    f"{name} must be {wanted}, got {validate.shown(getattr(self, name))}"
                )

        def whole(value: object, least: int) -> bool:
            return type(value) is int and least <= value < 2**31

        def numbers(values: object, count: int, least: float) -> bool:
            return (
                isinstance(values, tuple)
                and len(values) == count
                and all(isinstance(v, (int, float)) and least <= v < np.inf for v in values)
            )

        known = isinstance(self.left_out, tuple) and set(self.left_out) <= set(EFFECTS)
        check(known, "left_out", f"some of {', '.join(EFFECTS)}")
        levels = len(self.sides)
        pairs = (*self.sides, self.tile) if levels else self.sides
        nested = all(numbers(p, 2, 1) and all(whole(n, 1) for n in p) for p in pairs) and all(
            a % b == 0
            for large, small in pairwise(pairs)
            for a, b in zip(large, small, strict=True)
        )
        check(nested, "sides", "pairs of rows and columns that divide each other")
        asked = self.tolerance_db is None or numbers((self.tolerance_db,), 1, -np.inf)
        check(asked, "tolerance_db", "a number, or nothing with stages")
        exactly = self.accuracy_db is not None and numbers((self.accuracy_db,), 1, -np.inf)
        wanted = "nothing with sides" if levels else "a number without sides"
        check(exactly if not levels else self.accuracy_db is None, "accuracy_db", wanted)
        for name in ("predicted_error_db", "predicted_seconds", "exact_seconds"):
            check(numbers((getattr(self, name),), 1, -np.inf), name, "a number")
        for name in ("roots_at_once", "roots_prepared"):
            check(whole(getattr(self, name), 1), name, "a whole number from 1")
        fits = self.roots_prepared % self.roots_at_once == 0
        check(fits, "roots_prepared", "a multiple of roots_at_once")
        check(type(self.memory_bytes) is int and self.memory_bytes >= 0, "memory_bytes", "bytes")
        if not levels:
            return
        whole_items = self.tile[0] % 16 == 0 and self.tile[1] % 4 == 0
        check(whole_items, "tile", "a multiple of 16 rows and 4 columns")
        fits = isinstance(self.half_precision, bool)
        fits = fits and not (self.half_precision and self.upsampler is None)
        check(fits, "half_precision", "true or false, false without an upsampler")
        for name in ("half_lengths", "most_channels"):
            counts = getattr(self, name)
            fits = isinstance(counts, tuple) and len(counts) == levels
            fits = fits and all(whole(n, 0) for n in counts)
            check(fits, name, "a whole number for every stage")
        for name, most in (
            ("highest_cycles_per_m", 1e9),
            ("beam_cycles", 1e3),
            ("closest_m", 1e12),
        ):
            check(
                numbers((getattr(self, name),), 1, 0) and getattr(self, name) <= most,
                name,
                f"a number from 0 to {most:g}",
            )
        fits = (self.limits is None) == (self.beam is None)
        if fits and self.limits is not None:
            fits = numbers(self.limits, 2, -3.0) and self.limits[0] < self.limits[1]
        check(fits, "limits", "two ascending sines, with a beam")
        fits = (self.band is None) == bool(self.nearest)
        fits = fits and (self.band is None or numbers(self.band, 2, -0.5))
        check(fits, "band", "centre and half width in cycles per sample")
        if self.nearest:
            fits = numbers(self.nearest, levels, 1) and all(whole(n, 1) for n in self.nearest)
            check(fits, "nearest", "a whole number for every stage")
        else:
            fits = numbers(self.crowding, levels, 1) and max(self.crowding) <= 100
            check(fits, "crowding", "a number from 1 to 100 for every stage")
            check(self.tile == self.sides[-1], "tile", "the last of sides")
        for name, allowed in (("align", (2, 4, 6, 8)), ("final", (2, 4, 6, 8)), ("aperture", ())):
            filter_ = getattr(self, name)
            allowed = allowed or ((1,) if self.nearest else (2, 4, 6, 8))
            good = isinstance(filter_, Interpolator) and filter_.taps in allowed
            good = good and filter_.coefficients.shape == (filter_.taps // 2, 2, filter_.taps // 2)
            good = good and bool(np.isfinite(filter_.coefficients).all())
            check(good and numbers((filter_.upsampling,), 1, 1), name, f"of {allowed} taps")
        good = isinstance(self.resampling, Resampling) and all(
            type(n) is int for n in asdict(self.resampling).values()
        )
        r = self.resampling
        good = good and all(0 < n < 2**30 for n in (r.length, r.period, r.upsampled_period))
        good = good and abs(r.shift) <= r.period and abs(r.first) < 2**20 and 0 <= r.lead < 2**20
        if good and self.upsampler is None:
            good = 0 <= r.first <= r.upsampled_period - r.length
        check(good, "resampling", "made of whole numbers that fit each other")
        if self.upsampler is not None:
            good = isinstance(self.upsampler, Upsampler) and whole(self.upsampler.step, 1)
            good = good and self.upsampler.coefficients.shape in [
                (PHASES, taps) for taps in UPSAMPLING_TAPS
            ]
            good = good and bool(np.isfinite(self.upsampler.coefficients).all())
            good = good and r.period * PHASES == r.upsampled_period * self.upsampler.step
            check(good, "upsampler", "filters for the ratio of resampling")

    @functools.cached_property
    def kept(self) -> dict[str, Any]:
        """Geometry that an image by this plan leaves for the next; see `factorize`."""
        return {}

    def __getstate__(self) -> dict[str, Any]:
        """Return the fields: what is kept for other images is not sent to other processes."""
        return {name: value for name, value in self.__dict__.items() if name != "kept"}

    @property
    def phase_terms(self) -> int:
        """Terms of the polynomials for sine and cosine of pixels' phases."""
        return phases.terms_within(
            self.predicted_error_db if self.tolerance_db is None else self.tolerance_db
        )

    @property
    def is_exact(self) -> bool:
        """True for exact backprojection."""
        return not self.sides

    def __repr__(self) -> str:
        """Return what was asked for, what is expected, and the sides of the subimages."""
        asked = "stages as given"
        if self.tolerance_db is not None:
            asked = f"tolerance {reprs.quantity(self.tolerance_db, 'dB')}"
        sides = ", ".join(map(reprs.by, self.sides))
        return reprs.summary(
            self,
            asked,
            f"subimages of {sides} pixels" if sides else "exact",
            f"predicted error {self.predicted_error_db:.1f} dB",
            f"predicted time {_seconds(self.predicted_seconds)}",
            f"{reprs.quantity(self.memory_bytes, 'bytes')} of device memory",
        )

    def _repr_html_(self) -> str:
        return self._report().html()

    def describe(self) -> str:
        """Return a table of what is expected, stage by stage."""
        return self._report().text()

    def _report(self) -> Report:
        if self.tolerance_db is None:
            wish = "stages as given, nearest beam" if self.sides else "no stage, as given"
        else:
            wish = f"tolerance {self.tolerance_db:.4g} dB"
        lines = [
            f"Plan: {wish}; predicted error {self.predicted_error_db:.1f} dB, "
            f"{_seconds(self.predicted_seconds)} on {self.device} "
            f"(exact: {_seconds(self.exact_seconds)}), {self.memory_bytes / 2**20:.0f} MiB"
        ]
        if not self.is_exact:
            lines[0] += f", {'half' if self.half_precision else 'single'} precision"
        if self.left_out:
            lines.append(f"Left out, far below the tolerance: {', '.join(self.left_out)}")
        usual = (
            []
            if self.calibrated
            else [
                "Times follow from default costs, not from any measured on this device: "
                "`clsas calibrate` measures them."
            ]
        )
        if self.is_exact:
            reason = "" if self.tolerance_db is None else ": no factorization is faster within it"
            return Report([*lines, f"Plain backprojection{reason}.", *self._causes(), *usual])
        taps = f"{self.align.taps} taps in range at {self.resampling.ratio:.2f} x the lines' rate"
        if self.nearest:
            beams = f"sums of {', '.join(map(str, self.nearest))} neighbours"
        else:
            beams = (
                f"{self.aperture.taps} taps along the aperture at {self.aperture.upsampling:.2f} x"
            )
        lines.append(f"{taps}, {beams}, {self.final.taps} taps at the end")
        names = (
            "subimages",
            "rows x columns",
            "channels",
            "samples",
            "operations",
            "error",
            "time",
        )
        rows = [
            (
                f"{s.subimages}",
                f"{s.rows} x {s.columns}",
                f"{s.channels}",
                f"{s.samples}",
                f"{s.operations:.3g}",
                f"{s.error_db:.1f} dB",
                _seconds(s.seconds),
            )
            for s in self.stages
        ]
        labels = [*(str(i + 1) for i in range(len(rows) - 1)), "last"]
        table = [(label, *row) for label, row in zip(labels, rows, strict=True)]
        return Report([*lines, Table(("stage", *names), table), *self._causes(), *usual])

    def _causes(self) -> list[str]:
        """Return what the predicted error is made of, line by line."""
        if self.errors is None:
            return []
        return ["Error by cause, with its margin; powers add up:", *self.errors.describe()]

    def to_json(self, *, filters: bool = True) -> str:
        """Return this plan as text that `from_json` reads.

        Parameters
        ----------
        filters : bool
            False leaves out the hundreds of coefficients of the filters. The text is then short,
            for people and logs, but no plan that `from_json` reads.
        """

        def plain(value: object) -> object:
            return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value

        values = json.loads(json.dumps(asdict(self), default=plain))
        if filters:
            values["digest"] = _json_digest(values)
        else:
            for part in values.values():
                if isinstance(part, dict):
                    part.pop("coefficients", None)
        return json.dumps(values, indent=1)

    @classmethod
    def from_json(cls, text: str) -> Plan:
        """Return the plan that `to_json` wrote.

        Raises
        ------
        ValueError
            If the text is not such a plan, or its digest is not that of what it says.
        """
        try:
            values = parse_json(text)
            if not isinstance(values, dict):
                raise TypeError(f"it must be an object, got {validate.shown(values)}")
            digest = values.pop("digest", None)
            if digest is not None and digest != _json_digest(values):
                raise TypeError("its digest differs: it was changed or damaged")
            for name in ("align", "aperture", "final"):
                if values[name] is not None:
                    half = values[name]["taps"] // 2
                    coefficients = np.array(values[name].pop("coefficients"), np.float64)
                    coefficients = coefficients.reshape(half, 2, half)
                    values[name] = Interpolator(coefficients=coefficients, **values[name])
            if values["resampling"] is not None:
                values["resampling"] = Resampling(**values["resampling"])
            if values["upsampler"] is not None:
                coefficients = np.array(values["upsampler"].pop("coefficients"), np.float64)
                values["upsampler"] = Upsampler(coefficients=coefficients, **values["upsampler"])
            if values["beam"] is not None:
                values["beam"] = BeamWindow(**values["beam"])
            values["sides"] = tuple(map(tuple, values["sides"]))
            values["tile"] = tuple(values["tile"])
            for name in ("limits", "band"):
                if values[name] is not None:
                    values[name] = tuple(values[name])
            values["half_lengths"] = tuple(values["half_lengths"])
            values["nearest"] = tuple(values["nearest"])
            values["most_channels"] = tuple(values["most_channels"])
            values["crowding"] = tuple(values["crowding"])
            values["left_out"] = tuple(values.get("left_out", ()))
            values["stages"] = tuple(Stage(**stage) for stage in values["stages"])
            for name, kind in (("work", Work), ("errors", ErrorBudget)):
                if values.get(name) is not None:
                    values[name] = estimate_of(kind, values[name])
            return cls(**values)
        except (TypeError, ValueError, KeyError, AttributeError, OverflowError) as error:
            what = f"it lacks {error}" if isinstance(error, KeyError) else error
            raise ValueError(f"text must be a plan as of Plan.to_json: {what}") from error

    def check(self, lines: RangeLines, grid: Grid) -> None:
        """Raise ValueError unless this plan was made for these lines and this grid."""
        for name, mine, theirs in (
            ("lines", self.lines_digest, lines_digest(lines)),
            ("grid", self.grid_digest, grid_digest(grid)),
        ):
            if mine != theirs:
                raise ValueError(
                    f"the plan was made for another {name.removesuffix('s')} geometry than that "
                    f"of {name}; plan anew with clsas.plan"
                )


def with_left_out(
    simpler: Plan, model: Model, lines: RangeLines, grid: Grid, beam: BeamWindow | None
) -> Plan:
    """Return the plan for given lines that leaves out effects as their model does.

    `simpler` is the plan of the model; it is kept for the image.
    """
    digests = {"lines_digest": lines_digest(lines), "grid_digest": grid_digest(grid)}
    plan = replace(simpler, left_out=model.left_out, beam=beam, **digests)
    plan.kept["model"] = model.lines.without_samples(), model.grid, simpler
    return plan


def without_left_out(plan: Plan, lines: RangeLines, grid: Grid) -> tuple[RangeLines, Grid, Plan]:
    """Return lines, grid and plan of the same image where nothing is left to leave out.

    The geometry of both is kept for the next image of the plan.
    """
    if "model" not in plan.kept:
        model = leave_out(lines, grid, plan.beam, plan.left_out)
        digests = {
            "lines_digest": lines_digest(model.lines),
            "grid_digest": grid_digest(model.grid),
        }
        simpler = replace(plan, left_out=(), beam=model.beam, **digests)
        plan.kept["model"] = model.lines.without_samples(), model.grid, simpler
    geometry, simple_grid, simpler = plan.kept["model"]
    simple_lines = replace(geometry, samples=lines.samples)
    simpler.kept["lines"] = weakref.ref(simple_lines)  # whose band is that of the lines given
    simpler.kept["warned"] = plan.kept.get("warned", False)
    return simple_lines, simple_grid, simpler


def lines_digest(lines: RangeLines) -> str:
    """Return a digest of everything about lines but their samples."""
    velocity = lines.rx_velocity_m_s
    numbers = [lines.range_step_m, lines.carrier_hz, lines.sound_speed_m_s]
    arrays = [lines.tx_m, lines.rx_m, lines.first_range_m, np.array(numbers)]
    arrays += [] if velocity is None else [velocity]
    return _digest(np.array(lines.samples.shape), *arrays)


def grid_digest(grid: Grid) -> str:
    """Return a digest of where a grid's pixels lie."""
    parts = (grid.origin_m, grid.row_step_m, grid.column_step_m, grid.height_m, grid.points_m)
    return _digest(np.array(grid.shape), *(part for part in parts if part is not None))


def _json_digest(values: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:16]


def _digest(*arrays: NDArray) -> str:
    sha = hashlib.sha256()
    for array in arrays:
        sha.update(np.ascontiguousarray(array).tobytes())
    return sha.hexdigest()[:16]


def _seconds(seconds: float) -> str:
    return f"{seconds:.3g} s" if seconds >= 1 else f"{1e3 * seconds:.3g} ms"
