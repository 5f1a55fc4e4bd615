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
"""A number, or an array with one number for each of several sizes of subimages."""


@dataclass(frozen=True)
class Work:
    """Counted operations of a device and its host.

    `clsas.factorized.costs.Costs` has the same fields in nanoseconds; `Costs.seconds` multiplies
    the two. Amounts are numbers, or arrays over sizes of subimages.

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


@dataclass(frozen=True)
class ErrorBudget:
    """Relative error powers by cause, which add up to the predicted error.

    Attributes
    ----------
    exact
        The interpolation and arithmetic of exact backprojection.
    range_filters, aperture_filters
        Interpolation in range and along the aperture, in all stages together.
    upsampling
        Filters that upsample the lines.
    roots
        Projection of channels onto the mean track, and rounding in the roots.
    spacing
        Uneven spacing of virtual channels, and changes of the beam's weights between them.
    leaves
        Expansion of ranges and weights in the leaves.
    beam_edges
        Edges of the beam, which are neglected because their weights are small.
    phases
        Polynomials for sine and cosine.
    half_precision
        Rounding of the lines between stages.
    nearest_beams
        Plain sums of neighbours, as in THESIS.
    line_ends, aliasing
        Ambiguities of the lines themselves: see `clsas.signal.ambiguity`.
    left_out
        Neglected effects: see `clsas.sonar.simplify`.
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


_NEGLIGIBLE = 1e-3  # share of the total below which contributions are not shown


CostSource: TypeAlias = Literal["given", "calibrated", "scaled", "default"]
"""Origin of the costs of a prediction: see `clsas.factorized.costs.KnownCosts`."""


@dataclass(frozen=True)
class Stage:
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

    __pydantic_config__ = CONFIG


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
        measurement; "calibrated" by an earlier version of clsas; or "default".
    costs_measured : str
        Time of that measurement, UTC, in ISO 8601; "" without one.
    stages : tuple of Stage
        All stages and, last, the backprojection; empty for an exact image.
    work : Work
        Counted operations, from which the time follows.
    errors : ErrorBudget
        Contributions to the error.
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
