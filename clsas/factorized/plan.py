"""Plans: how an image is formed, decided before the device starts, and what is predicted of it."""

from __future__ import annotations

import functools
import hashlib
import json
import weakref
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

import numpy as np

from clsas.core import reprs, validate
from clsas.core.digests import grid_digest, lines_digest
from clsas.core.extras import needed
from clsas.core.fields import CONFIG, Constraint, Number, explained
from clsas.core.grid import Grid
from clsas.core.lines import RangeLines
from clsas.core.reading import parse_json
from clsas.factorized import report
from clsas.factorized.estimates import ErrorBudget, Work
from clsas.factorized.factorization import ExactImage, Factorization
from clsas.factorized.fields import StoredBeam, StoredErrors, StoredWork
from clsas.sonar.simplify import EFFECTS

if TYPE_CHECKING:
    from pydantic import TypeAdapter

COVERAGE = ("reached", "warned")
"""Entries of `Plan.kept`: whether any line reaches the grid, and whether a warning said no."""
VERSION = 4
"""Version of a plan's JSON. Version 1, of clsas before 0.1.0, had no number; version 2 had one mean
track; version 3 did not tell the origin of costs."""


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
    work: StoredWork
    errors: StoredErrors
    cost_source: CostSource = "given"
    costs_measured: str = ""

    __pydantic_config__ = CONFIG
    __repr__ = reprs.of_fields


@dataclass(frozen=True, eq=False)
class Plan:
    """An image, decided before the device starts; made by `plan`, used by `factorize`.

    Attributes
    ----------
    tolerance_db : float or None
        Relative rms error asked for; None where stages were given.
    image : Factorization or ExactImage
        How the image is formed. Exact, if nothing is faster within the tolerance.
    prediction : Prediction
        Predicted error, time and memory.
    beam : BeamWindow or None
        Weights of the channels.
    lines_digest, grid_digest : str
        Of the geometry that this plan was made for.
    left_out : tuple of str
        Effects that the image does without, since their error lies far below the tolerance: see
        `clsas.sonar.simplify`.
    """

    tolerance_db: Number | None
    image: Annotated[Factorization | ExactImage, Constraint(discriminator="method")]
    prediction: Prediction
    beam: StoredBeam | None
    lines_digest: str
    grid_digest: str
    left_out: tuple[str, ...] = ()

    __pydantic_config__ = CONFIG

    def __post_init__(self) -> None:
        """Check that the fields fit each other."""
        if not set(self.left_out) <= set(EFFECTS):
            got = validate.shown(self.left_out)
            raise ValueError(f"left_out must be some of {', '.join(EFFECTS)}, got {got}")
        if not self.is_exact and (self.factorization.limits is None) != (self.beam is None):
            raise ValueError("limits must be given with a beam, and left out without one")

    @functools.cached_property
    def kept(self) -> dict[str, Any]:
        """Geometry that an image by this plan leaves for the next; see `factorize`."""
        return {}

    def __getstate__(self) -> dict[str, Any]:
        """Return the fields: what is kept for other images is not sent to other processes."""
        return {name: value for name, value in self.__dict__.items() if name != "kept"}

    @property
    def is_exact(self) -> bool:
        """True for exact backprojection."""
        return isinstance(self.image, ExactImage)

    @property
    def factorization(self) -> Factorization:
        """How the image is divided; raises TypeError for an exact one."""
        if isinstance(self.image, ExactImage):
            raise TypeError("the plan must divide the image, got one of an exact image")
        return self.image

    @property
    def sides(self) -> tuple[tuple[int, int], ...]:
        """Rows and columns of subimages, stage by stage. Empty for an exact image."""
        return self.image.sides

    @property
    def half_precision(self) -> bool:
        """True if lines are handed on from stage to stage in half precision."""
        return self.image.half_precision

    @property
    def stages(self) -> tuple[Stage, ...]:
        """Predictions for every stage, and the backprojection at the end."""
        return self.prediction.stages

    @property
    def predicted_error_db(self) -> float:
        """Relative rms error against the exact image, as a bound, dB."""
        return self.prediction.error_db

    @property
    def predicted_seconds(self) -> float:
        """Predicted time on the device that the plan was made for."""
        return self.prediction.seconds

    @property
    def exact_seconds(self) -> float:
        """Predicted time of `clsas.backproject`."""
        return self.prediction.exact_seconds

    @property
    def memory_bytes(self) -> int:
        """Largest amount of device memory needed."""
        return self.prediction.memory_bytes

    @property
    def work(self) -> Work:
        """Counted operations, which make the predicted time."""
        return self.prediction.work

    @property
    def errors(self) -> ErrorBudget:
        """Contributions to the predicted error."""
        return self.prediction.errors

    def __repr__(self) -> str:
        """Return the request, the prediction and the sides of the subimages."""
        return report.summary(self)

    def _repr_html_(self) -> str:
        return report.report(self).html()

    def describe(self) -> str:
        """Return a table of what is predicted, stage by stage."""
        return report.report(self).text()

    def changed(self, **fields: Any) -> Plan:
        """Return this plan with other values of some fields of its `image`, for study.

        The prediction stays as it was.

        Raises
        ------
        TypeError, ValueError
            If there is no such field, or its value is not allowed.
        ImportError
            If pydantic, which checks the values, is not installed (extra `files`).
        """
        with needed("Plan.changed"):
            from pydantic import ValidationError
            from pydantic.dataclasses import dataclass as checking
        plain = {name: _without_numpy(value) for name, value in fields.items()}
        kind = type(self.image)
        try:
            checked = checking(kind, frozen=True, eq=False)(**vars(self.image) | plain)
        except ValidationError as error:
            raise ValueError(explained(error, fields)) from None
        return replace(self, image=kind(**vars(checked)))

    def moved(self, lines: RangeLines) -> Plan:
        """Return this plan for lines whose channels lie a little beside those it was made for.

        For navigation, which forms many images of the same samples. The predictions hold as far as
        both tracks are equally smooth.

        Raises
        ------
        TypeError
            If `lines` is not a RangeLines.
        """
        validate.instance("lines", lines, RangeLines)
        plan = replace(self, lines_digest=lines_digest(lines))
        plan.kept["lines"] = weakref.ref(lines)  # their band is that of the plan
        plan.kept.update({name: self.kept[name] for name in COVERAGE if name in self.kept})
        return plan

    def to_json(self, *, filters: bool = True) -> str:
        """Return this plan as text that `from_json` reads.

        Parameters
        ----------
        filters : bool
            False leaves out the hundreds of coefficients of the filters. The text is then short,
            for people and logs, but no plan that `from_json` reads.

        Raises
        ------
        ImportError
            If pydantic is not installed (extra `files`).
        """
        validate.flag("filters", filters)
        # Lists and numbers as JSON has them.
        values = {"version": VERSION} | json.loads(json.dumps(_stored().dump_python(self)))
        if filters:
            values["digest"] = _json_digest(values)
        else:
            _drop(values, "coefficients")
        return json.dumps(values, indent=1)

    @classmethod
    def from_json(cls, text: str) -> Plan:
        """Return the plan that `to_json` wrote.

        Raises
        ------
        ValueError
            If the text is not such a plan, was written by another version, or its digest is not
            that of what it says.
        ImportError
            If pydantic is not installed (extra `files`).
        """
        with needed("plans as JSON"):
            from pydantic import ValidationError
        try:
            values = parse_json(text)
            if not isinstance(values, dict):
                raise ValueError(f"it must be an object, got {validate.shown(values)}")
            _check_version(values)
            _check_digest(values)
            values = {name: values[name] for name in values if name not in ("version", "digest")}
            return _stored().validate_json(json.dumps(values))
        except ValidationError as error:
            problem = explained(error, values)
            raise ValueError(f"text must be a plan as of Plan.to_json: {problem}") from None
        except (TypeError, ValueError) as error:
            raise ValueError(f"text must be a plan as of Plan.to_json: {error}") from error

    def check(self, lines: RangeLines, grid: Grid) -> None:
        """Raise TypeError or ValueError unless this plan was made for these lines and this grid."""
        validate.instance("lines", lines, RangeLines)
        validate.instance("grid", grid, Grid)
        for name, mine, theirs in (
            ("lines", self.lines_digest, lines_digest(lines)),
            ("grid", self.grid_digest, grid_digest(grid)),
        ):
            if mine != theirs:
                raise ValueError(
                    f"the plan was made for another {name.removesuffix('s')} geometry than that "
                    f"of {name}; plan anew with clsas.plan"
                )
        if not self.is_exact:
            # Sampled lines hold no frequency beyond: more would only cost memory.
            most = abs(lines.carrier_cycles_per_m) + 1 / lines.range_step_m
            given = self.factorization.highest_cycles_per_m
            validate.number("highest_cycles_per_m", given, "cycles/m", most=most)


def _without_numpy(value: Any) -> Any:
    """Return a value of NumPy as Python's, which fields of plans are."""
    return value.tolist() if isinstance(value, (np.generic, np.ndarray)) else value


def _check_version(values: dict[str, Any]) -> None:
    """Raise ValueError unless a text is of the version that this clsas writes."""
    version = values.get("version", 1 if "roots_at_once" in values else None)
    if version is None:
        raise ValueError("it lacks 'version'")
    if version != VERSION:
        by = "clsas before 0.1.0" if version == 1 else "another clsas"
        raise ValueError(
            f"it has version {validate.shown(version)}, made by {by}; this clsas reads version "
            f"{VERSION}: make it anew with clsas.plan"
        )


def _check_digest(values: dict[str, Any]) -> None:
    """Raise ValueError unless a text holds the digest of what it says."""
    if "digest" not in values:
        raise ValueError("it lacks 'digest', as a text that `to_json` wrote without filters does")
    said = {name: value for name, value in values.items() if name != "digest"}
    if values["digest"] != _json_digest(said):
        raise ValueError("its digest differs: it was changed or damaged")


@functools.cache
def _stored() -> TypeAdapter[Plan]:
    """Return pydantic's reader and writer of plans."""
    with needed("plans as JSON"):
        from pydantic import TypeAdapter
    return TypeAdapter(Plan)


def _drop(values: dict[str, Any], name: str) -> None:
    """Remove a key from nested tables."""
    values.pop(name, None)
    for value in values.values():
        if isinstance(value, dict):
            _drop(value, name)


def _json_digest(values: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:16]
