"""Plans: how an image will be formed, with its predicted error, time and memory.

A plan is frozen data. It contains the division of the image into subimages and the filters, or the
accuracy of an exact image, and the prediction. Every number that sizes a buffer or an index is
bounded where the object is made, so that neither a damaged text nor a replaced field can make a
kernel read or write outside its buffers.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields, is_dataclass
from functools import cache, partial
from itertools import pairwise
from types import UnionType
from typing import (
    Annotated,
    Any,
    ClassVar,
    Literal,
    TypeAlias,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import reprs, validate
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.decibels import in_db
from clsas.engine.data.declared import Choice, Number, check_fields
from clsas.engine.data.digests import DIGEST, grid_digest, is_intact, lines_digest, with_digest
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.reading import parse_json
from clsas.engine.data.reprs import Report, Table
from clsas.engine.data.simplify import EFFECTS
from clsas.engine.data.surface import LEAST_SIDE
from clsas.engine.data.validate import ArgumentError, ArgumentTypeError
from clsas.engine.device.kernels import PHASE_TERMS
from clsas.engine.exact.decide import ACCURACY
from clsas.engine.factorized.track import Shape
from clsas.engine.factorized.virtual_channels import InterpolatedAperture, NearestBeams
from clsas.engine.signal.interpolation import (
    MOST_UPSAMPLING,
    PHASES,
    STAGE_TAPS,
    TAPS,
    UPSAMPLING_TAPS,
    Interpolator,
    Resampling,
    Upsampler,
)

VERSION = 6
"""Version of a plan's JSON."""

UNREACHED = "no line reaches the grid"
"""Reason for an exact image that is all zeros; `clsas.plan` has then warned."""

CostSource: TypeAlias = Literal["given", "scaled", "default"]
"""Origin of the costs of a prediction: see `clsas.engine.factorized.costs.KnownCosts`."""

Amount: TypeAlias = float | NDArray[np.float64]
"""A number, or an array with one number for each of several sizes of subimages."""

# Bounds of what a plan may contain, far beyond what plans need. Indices stay within int32.
_MOST_COUNT = 2**31 - 1
_MOST_SAMPLES = 2**30 - 1  # of a line, before and after upsampling
_MOST_OFFSET = 2**20 - 1  # of a line's first sample, in samples
_MOST_STAGES = 64  # halving the sides of 2^31 x 2^31 pixels one by one takes 62
_MOST_COEFFICIENT = 1e6  # arbitrary; those of designed filters are below 2
_WIDEST_SINE = 3.0  # of an aspect angle; the limits of beams that reach end-fire are 2

# Checks of fields: functions of name and value, which return the value to keep.
_count = partial(validate.count, least=0, most=_MOST_COUNT)
_whole = partial(validate.count, least=1, most=_MOST_COUNT)
_amount = partial(validate.number, least=0.0)

_NEGLIGIBLE = 1e-3  # share of the total error below which contributions are not shown


@dataclass(frozen=True, eq=False)
class Plan:
    """How an image will be formed, decided in advance, with predicted error, time and memory.

    `clsas.plan` makes plans. `clsas.factorize` and `clsas.Imager` form images by them.

    Attributes
    ----------
    tolerance_db : float or None
        Requested relative rms error, dB; None if stages were given instead.
    method : Factorization or ExactImage
        The factorization, or exact backprojection if no factorization within the tolerance is
        faster.
    prediction : Prediction
        Predicted error, time and memory.
    beam : BeamWindow or None
        Weights of the channels.
    lines_digest, grid_digest : str
        Digests of the geometry for which this plan was made.
    left_out : tuple of str
        Effects that the image neglects, because their error is far below the tolerance.

    See Also
    --------
    clsas.plan : Make a plan.
    clsas.factorize : Form an image by a plan.

    Examples
    --------
    >>> import clsas
    >>> import numpy as np
    >>> track_m = np.c_[np.linspace(-2, 2, 64), np.zeros((64, 2))]
    >>> point = clsas.PointTargets([[0, 20, 0]])
    >>> lines = clsas.simulate_lines(
    ...     track_m, track_m, point, carrier_hz=100e3, bandwidth_hz=20e3
    ... )
    >>> grid = clsas.Grid.plane((-0.5, 0.5, 32), (19.5, 20.5, 32))
    >>> plan = clsas.plan(lines, grid, tolerance_db=-40)
    >>> plan.predicted_error_db <= -40
    True
    >>> clsas.Plan.from_json(plan.to_json()).tolerance_db
    -40.0
    """

    tolerance_db: float | None
    method: Factorization | ExactImage
    prediction: Prediction
    beam: BeamWindow | None
    lines_digest: str
    grid_digest: str
    left_out: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Raise TypeError or ValueError if a field is not allowed, or contradicts another."""
        if self.tolerance_db is not None:
            _check(self, tolerance_db=partial(validate.number, unit="dB"))
        validate.instance("method", self.method, Factorization, ExactImage)
        validate.instance("prediction", self.prediction, Prediction)
        if self.beam is not None:
            validate.instance("beam", self.beam, BeamWindow)
        effects = validate.entries("left_out", self.left_out, "names of effects")
        if len(effects) > len(EFFECTS) or not all(each in EFFECTS for each in effects):
            got = validate.shown(self.left_out)
            raise ArgumentError("left_out", f"be some of {', '.join(EFFECTS)}", got)
        object.__setattr__(self, "left_out", tuple(effects))
        _check(self, lines_digest=validate.text, grid_digest=validate.text)
        if not (self.is_exact or self.stages):
            raise ArgumentError("prediction.stages", "not be empty for a factorization")
        if not self.is_exact and (self.factorization.limits is None) != (self.beam is None):
            raise ArgumentError("limits", "be given with a beam, and be None without one")

    @property
    def is_exact(self) -> bool:
        """True for exact backprojection."""
        return isinstance(self.method, ExactImage)

    @property
    def factorization(self) -> Factorization:
        """Division of the image and its filters. Raises TypeError for an exact image."""
        if isinstance(self.method, ExactImage):
            raise ArgumentTypeError("plan", "divide the image", "a plan for an exact image")
        return self.method

    @property
    def sides(self) -> tuple[tuple[int, int], ...]:
        """Rows and columns of subimages, stage by stage; empty for an exact image."""
        return self.method.sides

    @property
    def half_precision(self) -> bool:
        """True if the lines between stages are in half precision."""
        return self.method.half_precision

    @property
    def stages(self) -> tuple[StagePrediction, ...]:
        """Predictions for each stage and, last, for the backprojection."""
        return self.prediction.stages

    @property
    def predicted_error_db(self) -> float:
        """Predicted bound on the relative rms error with respect to the exact image, dB."""
        return self.prediction.error_db

    @property
    def predicted_seconds(self) -> float:
        """Predicted time on the device for which the plan was made, seconds."""
        return self.prediction.seconds

    @property
    def exact_seconds(self) -> float:
        """Predicted time of `clsas.backproject` on the same device, seconds."""
        return self.prediction.exact_seconds

    @property
    def memory_bytes(self) -> int:
        """Predicted peak of device memory, bytes."""
        return self.prediction.memory_bytes

    @property
    def work(self) -> Work:
        """Counted operations, from which the predicted time follows."""
        return self.prediction.work

    @property
    def errors(self) -> ErrorBudget:
        """Contributions to the predicted error."""
        return self.prediction.errors

    def check(self, lines: RangeLines, grid: Grid) -> None:
        """Check that this plan was made for the geometry of these lines and this grid.

        Parameters
        ----------
        lines : RangeLines
        grid : Grid

        Raises
        ------
        TypeError, ValueError
            If it was made for another geometry, or an argument is not of these types.
        """
        validate.instance("lines", lines, RangeLines)
        validate.instance("grid", grid, Grid)
        for name, mine, theirs in (
            ("lines", self.lines_digest, lines_digest(lines)),
            ("grid", self.grid_digest, grid_digest(grid)),
        ):
            if mine != theirs:
                allowed = "have the geometry for which the plan was made"
                raise ArgumentError(name, allowed, hint="make a new plan with `clsas.plan`")
        if not self.is_exact:
            # Sampled lines contain no higher frequencies; a higher bound would only need memory.
            most = lines.highest_cycles_per_m
            if lines.sound_speed is not None:  # slower water at the seabed has shorter wavelengths
                most *= 2
            given = self.factorization.highest_cycles_per_m
            validate.number("highest_cycles_per_m", given, "cycles/m", most=most)

    def to_json(self, *, filters: bool = True) -> str:
        """Return this plan as JSON, which `from_json` reads.

        Parameters
        ----------
        filters : bool
            If False, omit the hundreds of coefficients of the filters. The text is then short
            enough for people and logs, but `from_json` cannot read it.

        Returns
        -------
        str
        """
        validate.flag("filters", filters)
        values = {"version": VERSION} | asdict(self)
        text = json.dumps(values, default=lambda array: array.tolist())
        # The digest is of lists and numbers as they are after a round trip through JSON.
        values = with_digest(json.loads(text)) if filters else _without_filters(text)
        return json.dumps(values, indent=1)

    @classmethod
    def from_json(cls, text: str) -> Plan:
        """Return the plan in a text that `to_json` wrote.

        Parameters
        ----------
        text : str

        Returns
        -------
        Plan

        Raises
        ------
        ValueError
            If the text is not such a plan, was written by another version, or does not match its
            digest.
        """
        try:
            values = parse_json(text)
            if not isinstance(values, dict):
                raise ValueError(f"it must be an object, got {validate.shown(values)}")
            if "version" not in values:
                raise ValueError("it lacks 'version'")
            if values["version"] != VERSION:
                raise ValueError(
                    f"it has version {validate.shown(values['version'])}, written by another "
                    f"version of clsas; this clsas reads version {VERSION}: make the plan again "
                    "with `clsas.plan`"
                )
            if DIGEST not in values:
                raise ValueError(
                    "it lacks 'digest', like texts that `to_json` wrote without filters"
                )
            if not is_intact(values):
                raise ValueError("its digest differs: the text was changed or damaged")
            del values["version"], values[DIGEST]
            return _from_table(cls, values, "")
        except (TypeError, ValueError) as error:
            raise ArgumentError("text", "be a plan as of Plan.to_json", hint=str(error)) from None

    def __repr__(self) -> str:
        """Return the request, the sizes of the subimages and the prediction."""
        asked = "stages as given"
        if self.tolerance_db is not None:
            asked = f"tolerance {reprs.quantity(self.tolerance_db, 'dB')}"
        sides = ", ".join(map(reprs.by, self.sides))
        return reprs.summary(
            self,
            asked,
            f"subimages of {sides} pixels" if sides else "exact",
            f"predicted error {self.predicted_error_db:.1f} dB",
            f"predicted time {_time(self.predicted_seconds)}",
            f"{reprs.quantity(self.memory_bytes, 'bytes')} of device memory",
        )

    def _repr_html_(self) -> str:
        return _report(self).html()

    def describe(self) -> str:
        """Return the predictions as text: in total, stage by stage, and by cause of error."""
        return _report(self).text()


@dataclass(frozen=True, eq=False)
class Factorization:
    """A division of the image into subimages within subimages, and the filters between stages.

    The roots are formed from the lines themselves. Each stage divides the subimages of the stage
    before, and combines their channels into fewer virtual channels. The subimages of the last
    stage, the leaves, are backprojected.

    Attributes
    ----------
    sides : tuple of (rows, columns)
        Size of subimages in pixels, stage by stage.
    tile : (rows, columns)
        Size of the blocks of pixels that are backprojected together: leaves, or parts of them.
    aperture : InterpolatedAperture or NearestBeams
        Method that combines channels into virtual channels.
    align, final : Interpolator
        Filters in range, of the stages and of the last backprojection.
    resampling : Resampling
        Positions of samples after upsampling.
    upsampler : Upsampler or None
        Filters that upsample lines; None for upsampling by FFT.
    half_precision : bool
        True if the lines between stages are in half precision, which halves their memory.
    half_lengths : tuple of int
        Number of samples on either side of a subimage's centre in its lines, stage by stage.
    most_channels : tuple of int
        Number of virtual channels of a subimage, stage by stage, for which buffers have room from
        the start.
    highest_cycles_per_m : float
        Phase per metre of range at the upper end of the lines' band, cycles.
    closest_m : float
        Lower bound on the distance of pixels from the track.
    limits : (low, high) or None
        With a beam, the sines of the aspect angle between which its weights matter.
    roots_at_once, roots_prepared : int
        Number of roots that are formed together, and whose geometry is prepared together.
    phase_terms : int
        Number of terms in the polynomials for sine and cosine of the phases of pixels.
    stretch : float
        Relative excess of the growth of ranges along the line of sight over that of ranges from
        the mean track, averaged over all channels.
    """

    sides: tuple[tuple[int, int], ...]
    tile: tuple[int, int]
    aperture: InterpolatedAperture | NearestBeams
    align: Interpolator
    final: Interpolator
    resampling: Resampling
    upsampler: Upsampler | None
    half_precision: bool
    half_lengths: tuple[int, ...]
    most_channels: tuple[int, ...]
    highest_cycles_per_m: float
    closest_m: float
    limits: tuple[float, float] | None
    roots_at_once: int
    roots_prepared: int
    phase_terms: int = PHASE_TERMS[-1]
    stretch: float = 0.0
    kind: Literal["factorized"] = "factorized"

    __repr__ = reprs.of_fields

    def describe(self) -> str:
        """Return the filters in words."""
        return (
            f"{self.align.taps} taps in range at {self.resampling.ratio:.2f} x the lines' rate, "
            f"{self.aperture.describe()}, {self.final.taps} taps at the end"
        )

    @property
    def band(self) -> tuple[float, float] | None:
        """Centre and half width of the band for which filters were designed; None for any band."""
        return self.aperture.band

    def __post_init__(self) -> None:
        """Raise TypeError or ValueError if a field is not allowed, or contradicts another."""
        levels = len(validate.entries("sides", self.sides, "rows and columns of each stage"))
        if not 1 <= levels <= _MOST_STAGES:
            raise ArgumentError("sides", f"be of 1 to {_MOST_STAGES} stages", levels)
        pair = partial(_each, length=2, meaning="rows and columns", check=_whole)
        of_stages = partial(_each, length=levels, meaning="one for each stage", check=_count)
        _check(
            self,
            sides=partial(of_stages, check=pair),
            tile=pair,
            half_precision=validate.flag,
            half_lengths=of_stages,
            most_channels=of_stages,
            highest_cycles_per_m=partial(validate.number, unit="cycles/m", least=0.0, most=1e9),
            closest_m=partial(validate.number, unit="m", least=0.0, most=1e12),
            roots_at_once=_whole,
            roots_prepared=_whole,
            phase_terms=partial(validate.count, least=PHASE_TERMS[0], most=PHASE_TERMS[-1]),
            stretch=partial(validate.number, least=-0.5, most=1.0),
            kind=partial(validate.one_of, allowed=("factorized",)),
        )
        if self.limits is not None:
            sine = partial(validate.number, least=-_WIDEST_SINE, most=_WIDEST_SINE)
            _check(self, limits=partial(_each, length=2, meaning="ascending sines", check=sine))
        _check_filter("align", self.align, STAGE_TAPS)
        _check_filter("final", self.final, TAPS)
        _check_resampling(self.resampling, self.upsampler)
        _check_aperture(self.aperture, levels)

        def require(fits: bool, name: str, allowed: str) -> None:
            if not fits:
                raise ArgumentError(name, f"be {allowed}", validate.shown(getattr(self, name)))

        nested = all(
            a % b == 0
            for large, small in pairwise((*self.sides, self.tile))
            for a, b in zip(large, small, strict=True)
        )
        require(
            nested,
            "sides",
            f"rows and columns, each divisible by the next and at last by {self.tile}",
        )
        rows, columns = LEAST_SIDE
        whole_items = self.tile[0] % rows == 0 and self.tile[1] % columns == 0
        require(whole_items, "tile", f"a multiple of {rows} rows and {columns} columns")
        whole_leaves = self.aperture.splits_leaves or self.tile == self.sides[-1]
        require(whole_leaves, "tile", "the last pair of sides")
        ascend = self.limits is None or self.limits[0] < self.limits[1]
        require(ascend, "limits", "two ascending sines")
        together = self.roots_prepared % self.roots_at_once == 0
        require(together, "roots_prepared", f"a multiple of roots_at_once, {self.roots_at_once}")
        made = self.upsampler is not None
        require(made or not self.half_precision, "half_precision", "false without an upsampler")


@dataclass(frozen=True)
class ExactImage:
    """Backprojection of all channels to all pixels.

    Attributes
    ----------
    accuracy_db : float
        Relative rms error of interpolation, dB.
    reason : str
        Reason why the image is not factorized, in words; "" if an exact image was requested.
    taps, upsampling
        Interpolation of the lines; None to choose the fastest: see `clsas.backproject`.
    """

    accuracy_db: Annotated[float, ACCURACY]
    reason: str = ""
    taps: Annotated[
        int | None, Choice(TAPS, help="Samples of a line per interpolation.", default="the fastest")
    ] = None
    upsampling: Annotated[
        float | None,
        Number(
            least=1.0,
            most=MOST_UPSAMPLING,
            help="Factor by which lines are upsampled before interpolation.",
            default="the fastest",
        ),
    ] = None
    kind: Annotated[Literal["exact"], Choice(("exact",), help="Tells it from a factorization.")] = (
        "exact"
    )

    sides: ClassVar[tuple[tuple[int, int], ...]] = ()
    half_precision: ClassVar[bool] = False
    band: ClassVar[None] = None

    def __post_init__(self) -> None:
        """Raise TypeError or ValueError if a field is not allowed."""
        check_fields(self)
        _check(self, reason=validate.text)


@dataclass(frozen=True, eq=False)
class Prediction:
    """Predicted error, time and memory of an image.

    Attributes
    ----------
    error_db : float
        Bound on the relative rms error with respect to the exact image, dB.
    seconds, exact_seconds : float
        Time of the image, and of `clsas.backproject`.
    memory_bytes : int
        Peak of device memory.
    device : str
        Device to which the times apply.
    cost_source : str
        Origin of the costs from which times follow: "given"; "scaled" to the device by a short
        measurement; or "default".
    costs_measured : str
        Time of that measurement, UTC, in ISO 8601; "" without one.
    stages : tuple of StagePrediction
        All stages and, last, the backprojection; empty for an exact image.
    work : Work
        Counted operations, from which the time follows.
    errors : ErrorBudget
        Contributions to the error.
    """

    error_db: float
    seconds: float
    exact_seconds: float
    memory_bytes: int
    device: str
    stages: tuple[StagePrediction, ...]
    work: Work
    errors: ErrorBudget
    cost_source: CostSource = "given"
    costs_measured: str = ""

    __repr__ = reprs.of_fields

    def __post_init__(self) -> None:
        """Raise TypeError or ValueError if a field, or an amount in it, is not allowed."""
        stages = validate.entries("stages", self.stages, "stages")
        if len(stages) > _MOST_STAGES + 1:
            raise ArgumentError("stages", f"be at most {_MOST_STAGES + 1}", len(stages))
        for number, stage in enumerate(stages):
            validate.instance(f"stages[{number}]", stage, StagePrediction)
        object.__setattr__(self, "stages", tuple(stages))
        _check(
            self,
            error_db=partial(validate.number, unit="dB"),
            seconds=_amount,
            exact_seconds=_amount,
            memory_bytes=partial(validate.count, least=0),
            device=validate.text,
            cost_source=partial(validate.one_of, allowed=get_args(CostSource)),
            costs_measured=validate.text,
        )
        # The classes of these two do not check them: in a search, their amounts may be arrays.
        validate.instance("work", self.work, Work)
        validate.instance("errors", self.errors, ErrorBudget)
        for name in ("work", "errors"):
            for part, amount in vars(getattr(self, name)).items():
                _amount(f"{name}.{part}", amount)


@dataclass(frozen=True)
class StagePrediction:
    """Predicted work, error and time of one stage, or of the backprojection at the end.

    Attributes
    ----------
    rows, columns : int
        Size of the subimages in pixels.
    subimages : int
        Number of subimages in the grid.
    channels : int
        Virtual channels of a subimage, on average.
    samples : int
        Range samples of a line.
    operations : float
        Samples times channels that are aligned and combined. For the backprojection, pixels times
        channels.
    error_db : float
        Relative rms error of the interpolations, dB.
    seconds : float
        Time.
    """

    rows: int
    columns: int
    subimages: int
    channels: int
    samples: int
    operations: float
    error_db: float
    seconds: float

    def __post_init__(self) -> None:
        """Raise TypeError or ValueError if a field is not allowed."""
        _check(
            self,
            rows=_count,
            columns=_count,
            subimages=_count,
            channels=_count,
            samples=_count,
            operations=_amount,
            error_db=partial(validate.number, unit="dB"),
            seconds=_amount,
        )


@dataclass(frozen=True)
class ErrorBudget:
    """Relative error powers by cause, which add up to the predicted error.

    Attributes
    ----------
    exact
        The interpolation and arithmetic of exact backprojection (`predict_exact`).
    range_filters, upsampling
        Interpolation in range in all stages together, and the filters that upsample the lines
        (`with_range_filters`).
    aperture_filters, spacing, leaves
        Interpolation along the aperture in all stages together; uneven spacing of virtual channels,
        with changes of the beam's weights between them; expansion of ranges and weights in the
        leaves (`errors_of_tree`).
    roots
        Projection of channels onto the mean track, and rounding in the roots (`root_error`).
    beam_edges
        Edges of the beam, which are neglected because their weights are small (`trimmed`).
    phases, half_precision
        Polynomials for sine and cosine, and rounding of the lines between stages
        (`with_arithmetic`).
    nearest_beams
        Plain sums of neighbours, as in THESIS (`nearest_errors`).
    line_ends, aliasing
        Ambiguities of the lines themselves: see `clsas.engine.signal.ambiguity`.
    left_out
        Neglected effects: see `clsas.engine.data.simplify`.

    Notes
    -----
    Candidates are compared by all but the last three, with a margin (`margin_db`). `_completed` in
    the planner adds these to the plan that is chosen.
    """

    exact: float = 0.0
    range_filters: float = 0.0
    aperture_filters: float = 0.0
    upsampling: float = 0.0
    roots: float = 0.0
    spacing: float = 0.0
    leaves: float = 0.0
    beam_edges: float = 0.0
    phases: float = 0.0
    half_precision: float = 0.0
    nearest_beams: float = 0.0
    line_ends: float = 0.0
    aliasing: float = 0.0
    left_out: float = 0.0

    @property
    def total(self) -> float:
        """Sum of all contributions. Causes are independent, so that their powers add up."""
        return sum(asdict(self).values())

    @property
    def total_db(self) -> float:
        """Relative rms error of all contributions together, dB."""
        return in_db(self.total)

    def times(self, factor: float) -> ErrorBudget:
        """Return all contributions times a factor."""
        return ErrorBudget(*(factor * each for each in asdict(self).values()))

    def describe(self) -> list[str]:
        """Return a line of text per contribution, the largest first, without negligible ones."""
        found = sorted(asdict(self).items(), key=lambda item: -item[1])
        return [
            f"{name.replace('_', ' '):<16}  {in_db(error):6.1f} dB"
            for name, error in found
            if error > _NEGLIGIBLE * self.total
        ]


@dataclass(frozen=True)
class Work:
    """Counted operations of a device and its host.

    `Costs` has the same fields in nanoseconds, and `Costs.seconds` multiplies the two. Amounts are
    numbers, or arrays over sizes of subimages.

    Attributes
    ----------
    call
        Number of images, for the decisions, buffers and launches of any method.
    upsampled_sample, filtered_sample
        Samples of upsampled lines, by FFT on the host and by filters on the device.
    reference
        Roots times channels, on the host.
    batch
        Batches of roots times stages, for launches, tables and transfers; also further strips.
    subimage
        Subimages of all stages.
    line
        Lines aligned and combined in stages, for their shifts, phases and weights.
    sample, sample_tap
        Samples aligned and combined in stages; the same times the taps of both filters.
    single_sample
        Samples of lines in single precision among these.
    given_sample
        Samples aligned in the first stage, whose lines come from main memory.
    leaf_channel
        Virtual channels of the leaves.
    leaf, leaf_point
        Pixels times virtual channels of leaves, with 4 taps, on a plane and off it.
    leaf_gathered
        The same of leaves so thick that samples are not looked up in registers.
    group
        Pixels off a plane, which the host puts into groups.
    part
        Tiles or groups times channels of an exact image, for references on the host.
    pixel, point
        Pixels times channels of an exact image, with 4 taps, in tiles and in groups.
    beam
        Pixels times channels with beam weights, in exact images and in leaves.
    """

    call: Amount = 0.0
    upsampled_sample: Amount = 0.0
    filtered_sample: Amount = 0.0
    reference: Amount = 0.0
    batch: Amount = 0.0
    subimage: Amount = 0.0
    line: Amount = 0.0
    sample: Amount = 0.0
    sample_tap: Amount = 0.0
    single_sample: Amount = 0.0
    given_sample: Amount = 0.0
    leaf_channel: Amount = 0.0
    leaf: Amount = 0.0
    leaf_point: Amount = 0.0
    leaf_gathered: Amount = 0.0
    group: Amount = 0.0
    part: Amount = 0.0
    pixel: Amount = 0.0
    point: Amount = 0.0
    beam: Amount = 0.0

    def __add__(self, other: Work) -> Work:
        """Return the sum of two amounts of work."""
        return Work(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))


# Checks of fields


def _check(part: object, **checks: Callable[[str, Any], Any]) -> None:
    """Replace fields of a frozen object by what their checks return."""
    for name, check in checks.items():
        object.__setattr__(part, name, check(name, getattr(part, name)))


def _each(
    name: str, values: object, length: int, meaning: str, check: Callable[[str, Any], Any]
) -> tuple[Any, ...]:
    """Return so many values, each checked; `meaning` says what they are."""
    given = validate.entries(name, values, f"{length} numbers, {meaning}")
    if len(given) != length:
        raise ArgumentError(name, f"be {length} numbers, {meaning}", validate.shown(values))
    return tuple(check(f"{name}[{number}]", each) for number, each in enumerate(given))


def _check_filter(name: str, given: Interpolator, taps: tuple[int, ...]) -> None:
    """Raise TypeError or ValueError unless kernels can evaluate a filter."""
    validate.instance(name, given, Interpolator)
    pairs = validate.one_of(f"{name}.taps", given.taps, taps) // 2
    validate.number(f"{name}.upsampling", given.upsampling, least=1.0, most=MOST_UPSAMPLING)
    _check_coefficients(name, given.coefficients, [(pairs, 2, pairs)])
    validate.number(f"{name}.error_db", given.error_db, "dB")
    validate.number(f"{name}.scatter_db", given.scatter_db, "dB")


def _check_coefficients(name: str, given: Any, shapes: Sequence[tuple[int, ...]]) -> None:
    values = validate.array(f"{name}.coefficients", given, np.float64, None)
    if values.shape not in shapes:
        allowed = " or ".join(map(str, shapes))
        raise ArgumentError(f"{name}.coefficients", f"have shape {allowed}", values.shape)
    if (largest := float(np.abs(values).max())) > _MOST_COEFFICIENT:
        allowed = f"be at most {_MOST_COEFFICIENT:g} in size"
        raise ArgumentError(f"{name}.coefficients", allowed, f"{largest:g}")


def _check_resampling(given: Resampling, upsampler: Upsampler | None) -> None:
    """Raise TypeError or ValueError unless lines can be upsampled so."""
    validate.instance("resampling", given, Resampling)
    validate.count("resampling.lead", given.lead, least=0, most=_MOST_OFFSET)
    for name in ("period", "upsampled_period", "length"):
        validate.count(f"resampling.{name}", getattr(given, name), most=_MOST_SAMPLES)
    validate.count("resampling.shift", given.shift, least=-given.period, most=given.period)
    validate.count("resampling.first", given.first, least=-_MOST_OFFSET, most=_MOST_OFFSET)
    if upsampler is None:
        if not 0 <= given.first <= given.upsampled_period - given.length:
            got = validate.shown(given)
            raise ArgumentError("resampling", "be from samples within its period", got)
        return
    validate.instance("upsampler", upsampler, Upsampler)
    _whole("upsampler.step", upsampler.step)
    validate.number("upsampler.error_db", upsampler.error_db, "dB")
    shapes = [(PHASES, taps) for taps in UPSAMPLING_TAPS]
    _check_coefficients("upsampler", upsampler.coefficients, shapes)
    if given.period * PHASES != given.upsampled_period * upsampler.step:
        allowed = f"be by {PHASES} / {upsampler.step}, as the upsampler does"
        raise ArgumentError("resampling", allowed, validate.shown(given))


def _check_aperture(given: InterpolatedAperture | NearestBeams, levels: int) -> None:
    """Raise TypeError or ValueError unless an aperture has virtual channels for all stages."""
    validate.instance("aperture", given, InterpolatedAperture, NearestBeams)
    validate.one_of("aperture.method", given.method, [type(given).method])
    of_stages = partial(_each, length=levels, meaning="one for each stage")
    if isinstance(given, NearestBeams):
        of_stages("aperture.factors", given.factors, check=_whole)
        return
    _check_filter("aperture.filter", given.filter, STAGE_TAPS)
    dense = partial(validate.number, least=1.0, most=100.0)
    of_stages("aperture.oversampling", given.oversampling, check=dense)
    validate.number("aperture.beam_cycles", given.beam_cycles, "cycles", least=0.0, most=1e3)
    frequency = partial(validate.number, unit="cycles", least=-0.5, most=0.5)
    _each("aperture.band", given.band, 2, "centre and half width", frequency)
    validate.one_of("aperture.shape", given.shape, get_args(Shape))


# JSON


def _from_table(kind: Any, table: dict[str, Any], prefix: str) -> Any:
    """Return the object of a dataclass whose fields a table of JSON contains, and no others.

    `prefix` is the path of the fields, for messages. The class checks their values.
    """
    names = [field.name for field in fields(kind)]
    for name in table:
        if name not in names:
            raise ValueError(f"{prefix}{validate.printable(name)} is unknown")
    for name in names:
        if name not in table:
            raise ValueError(f"{prefix[:-1] or 'it'} lacks {name!r}")
    kinds = _types_of(kind)
    values = {name: _from_json(kinds[name], table[name], prefix + name) for name in names}
    try:
        return kind(**values)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{prefix}{error}") from None


_types_of = cache(get_type_hints)


def _from_json(kind: Any, value: Any, path: str) -> Any:
    """Return a value of JSON as a field of some type: object, tuple or array, or as it is.

    The class of the field checks its value.
    """
    kinds = get_args(kind) if get_origin(kind) is UnionType else (kind,)
    classes = [each for each in kinds if is_dataclass(each)]
    if isinstance(value, dict) and classes:
        found = classes[0]
        if len(classes) > 1:  # they differ in the value of one field, which has a default
            tag = "kind" if hasattr(found, "kind") else "method"
            of_tag = {getattr(each, tag): each for each in classes}
            found = of_tag[validate.one_of(f"{path}.{tag}", value.get(tag), list(of_tag))]
        return _from_table(found, value, f"{path}.")
    for each in kinds:
        if get_origin(each) is tuple and isinstance(value, list):
            part = get_args(each)[0]
            return tuple(_from_json(part, v, f"{path}[{i}]") for i, v in enumerate(value))
        if get_origin(each) is np.ndarray and (isinstance(value, list) or len(kinds) == 1):
            return validate.array(path, value, np.float64, None)
    return value


def _without_filters(text: str) -> dict[str, Any]:
    """Return the values of a JSON text without the coefficients of filters."""
    return json.loads(
        text,
        object_hook=lambda table: {
            name: value for name, value in table.items() if name != "coefficients"
        },
    )


# Descriptions


def costs_in_words(source: CostSource, measured: str) -> str:
    """Return the origin of costs and the day of their measurement, as the end of a sentence."""
    if source == "given":
        return "costs that were given."
    if source == "scaled":
        when = f" on {measured[:10]}" if measured else ""
        return f"default costs, scaled to this device by a short measurement{when}."
    return (
        "default costs, which were not scaled to this device; `clsas devices --measure` does that."
    )


def _report(plan: Plan) -> Report:
    """Return the predictions of a plan: in total, stage by stage, and by cause of error."""
    method, prediction = plan.method, plan.prediction
    if plan.tolerance_db is not None:
        asked = f"tolerance {plan.tolerance_db:.4g} dB"
    else:
        asked = "no stage, as given" if plan.is_exact else "stages as given, nearest beam"
    precision = "half" if plan.half_precision else "single"
    parts: list[str | Table] = [
        f"Plan: {asked}; predicted error {prediction.error_db:.1f} dB, "
        f"{_time(prediction.seconds)} on {prediction.device} "
        f"(exact: {_time(prediction.exact_seconds)}), {prediction.memory_bytes / 2**20:.0f} MiB"
        + ("" if plan.is_exact else f", {precision} precision")
    ]
    if plan.left_out:
        parts.append(f"Left out, far below the tolerance: {', '.join(plan.left_out)}")
    if isinstance(method, ExactImage):
        reason = method.reason or "no factorization is faster within the tolerance"
        because = "" if plan.tolerance_db is None else f": {reason}"
        parts.append(f"Plain backprojection{because}.")
    else:
        parts += [method.describe(), _table(prediction.stages)]
    parts += ["Error by cause, with its margin; powers add up:", *prediction.errors.describe()]
    origin = costs_in_words(prediction.cost_source, prediction.costs_measured)
    parts.append(f"Times follow from {origin}")
    return Report(parts)


def _table(stages: tuple[StagePrediction, ...]) -> Table:
    """Return the table of stages, of which the last is the backprojection."""
    headings = (
        "stage", "subimages", "rows x columns", "channels", "samples", "operations", "error",
        "time",
    )  # fmt: skip
    labels = [*(str(number) for number in range(1, len(stages))), "last"]
    rows = [
        (
            label,
            f"{stage.subimages}",
            f"{stage.rows} x {stage.columns}",
            f"{stage.channels}",
            f"{stage.samples}",
            f"{stage.operations:.3g}",
            f"{stage.error_db:.1f} dB",
            _time(stage.seconds),
        )
        for label, stage in zip(labels, stages, strict=True)
    ]
    return Table(headings, rows)


def _time(seconds: float) -> str:
    return f"{seconds:.3g} s" if seconds >= 1 else f"{1e3 * seconds:.3g} ms"
