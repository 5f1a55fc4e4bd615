"""Predicted work, errors, time and memory of an image, before it is formed."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import Annotated, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from clsas.core import reprs
from clsas.core.decibels import in_db
from clsas.core.fields import CONFIG, Constraint, Number, StoredAs
from clsas.core.fields import Amount as StoredAmount

Amount: TypeAlias = float | NDArray[np.float64]
"""A number, or one for each of some sizes of subimages."""


@dataclass(frozen=True)
class Work:
    """Counted operations of a device and its host.

    `clsas.planning.costs.Costs` has the same fields, in nanoseconds each: `Costs.seconds`
    multiplies the two. Amounts are numbers, or arrays over sizes of subimages.

    Attributes
    ----------
    call
        Images, however they are formed: decisions, buffers, launches.
    upsampled_sample, filtered_sample
        Samples of the upsampled lines, by FFT on the host and by filters on the device.
    reference
        Root subimages times channels, on the host.
    batch
        Stages of batches of roots: launches, tables, transfers; and of further strips.
    subimage
        Subimages, stage by stage.
    line
        Lines aligned and combined in stages: their shifts, phases and weights.
    sample, sample_tap
        Samples aligned and combined in stages; the same times the taps of both filters.
    single_sample
        Those of lines in single precision.
    given_sample
        Samples aligned in the first stage, whose lines come from main memory.
    leaf_channel
        Virtual channels of the leaves.
    leaf, leaf_point
        Pixels times virtual channels of leaves, with 4 taps, on a plane and off it.
    leaf_gathered
        Those of leaves so thick that samples are not looked up in registers.
    group
        Pixels off a plane that the host puts into groups.
    part
        Tiles, or groups, times channels of an exact image: references, on the host.
    pixel, point
        Pixels times channels of an exact image, with 4 taps, in tiles and in groups.
    beam
        Pixels times channels that a beam weighs, in exact images and leaves.
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
        """Return the work of both."""
        return Work(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))


@dataclass(frozen=True)
class ErrorBudget:
    """Relative error powers that add up to the prediction, by cause.

    Attributes
    ----------
    exact
        The interpolation and arithmetic of exact backprojection.
    range_filters, aperture_filters
        Interpolation in range, and along the aperture, in all stages together.
    upsampling
        The filters that upsample the lines.
    roots
        Channels that are put on the mean track, and rounding in the roots.
    spacing
        Virtual channels whose spacing, or the beam's weights between them, changes.
    leaves
        Expansion of ranges and weights in the leaves.
    beam_edges
        Edges of the beam that are left out because hardly anything is seen there.
    phases
        Polynomials for sine and cosine.
    half_precision
        Rounding of the lines that stages hand on.
    nearest_beams
        THESIS: neighbours summed as they are.
    line_ends, aliasing
        What the lines themselves leave open: see `clsas.signal.ambiguity`.
    left_out
        Effects that the image does without: see `clsas.sonar.simplify`.
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
        """All of them: causes are independent, so that powers add."""
        return sum(asdict(self).values())

    @property
    def total_db(self) -> float:
        """Relative rms error of all of them, dB."""
        return in_db(self.total)

    def times(self, factor: float) -> ErrorBudget:
        """Return every contribution times a factor."""
        return ErrorBudget(*(factor * each for each in asdict(self).values()))

    def describe(self) -> list[str]:
        """Return one line per contribution, the largest first, without those far below the rest."""
        found = sorted(asdict(self).items(), key=lambda item: -item[1])
        return [
            f"{name.replace('_', ' '):<16}  {in_db(error):6.1f} dB"
            for name, error in found
            if error > _NEGLIGIBLE * self.total
        ]


_NEGLIGIBLE = 1e-3  # of the total


CostSource: TypeAlias = Literal["given", "calibrated", "scaled", "default"]
"""Origin of the costs that make a prediction: see `clsas.planning.costs.KnownCosts`."""


@dataclass(frozen=True)
class Stage:
    """Predicted work of one stage.

    Attributes
    ----------
    rows, columns : int
        Pixels of its subimages.
    subimages : int
        Their number in the grid.
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

    __pydantic_config__ = CONFIG


@dataclass(frozen=True, eq=False)
class Prediction:
    """Error, time and memory that an image is predicted to take.

    Attributes
    ----------
    error_db : float
        Relative rms error against the exact image, as a bound.
    seconds, exact_seconds : float
        Time of the image, and of `clsas.backproject`.
    memory_bytes : int
        Largest amount of device memory needed.
    device : str
        Device whose times these are.
    cost_source : str
        Origin of the costs that make the times: "given", "calibrated" on the device, "scaled" to it
        by a short measurement, or "default".
    costs_measured : str
        Time of that measurement, UTC, in ISO 8601; "" without one.
    stages : tuple of Stage
        Every stage, and the backprojection at the end. Empty for an exact image.
    work : Work
        Counted operations, which make the time.
    errors : ErrorBudget
        Contributions, which make the error.
    """

    error_db: Number
    seconds: Number
    exact_seconds: Number
    memory_bytes: Annotated[int, Constraint(ge=0)]
    device: str
    stages: tuple[Stage, ...]
    work: Annotated[Work, StoredAs(dict[str, StoredAmount])]
    errors: Annotated[ErrorBudget, StoredAs(dict[str, StoredAmount])]
    cost_source: CostSource = "given"
    costs_measured: str = ""

    __pydantic_config__ = CONFIG
    __repr__ = reprs.of_fields
