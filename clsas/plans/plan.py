"""Plans: how an image will be formed, with its predicted error, time and memory."""

from __future__ import annotations

import functools
import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

from clsas.core import reprs, validate
from clsas.core.digests import DIGEST, grid_digest, is_intact, lines_digest, with_digest
from clsas.core.extras import needed
from clsas.core.fields import CONFIG, Constraint, Number, StoredAs, explained
from clsas.core.grid import Grid
from clsas.core.lines import RangeLines
from clsas.core.reading import parse_json
from clsas.core.tables import Report
from clsas.plans import report
from clsas.plans.factorization import ExactImage, Factorization
from clsas.plans.predictions import ErrorBudget, Prediction, Stage, Work
from clsas.sonar.beam import BeamWindow
from clsas.sonar.simplify import EFFECTS

if TYPE_CHECKING:
    from pydantic import TypeAdapter

VERSION = 6
"""Version of a plan's JSON. Version 1, from before clsas 0.1.0, had no number. Before version 6,
digests of lines and grids were computed in another way."""


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

    tolerance_db: Number | None
    method: Annotated[Factorization | ExactImage, Constraint(discriminator="kind")]
    prediction: Prediction
    beam: Annotated[BeamWindow, StoredAs(dict[str, Any])] | None
    lines_digest: str
    grid_digest: str
    left_out: tuple[str, ...] = ()

    __pydantic_config__ = CONFIG

    def __post_init__(self) -> None:
        """Raise ValueError if the fields contradict each other."""
        if not set(self.left_out) <= set(EFFECTS):
            got = validate.shown(self.left_out)
            raise ValueError(f"left_out must be some of {', '.join(EFFECTS)}, got {got}")
        if not self.is_exact and (self.factorization.limits is None) != (self.beam is None):
            raise ValueError("limits must be given with a beam, and must be None without one")

    @property
    def is_exact(self) -> bool:
        """True for exact backprojection."""
        return isinstance(self.method, ExactImage)

    @property
    def factorization(self) -> Factorization:
        """Division of the image and its filters. Raises TypeError for an exact image."""
        if isinstance(self.method, ExactImage):
            raise TypeError("the plan must divide the image, got a plan for an exact image")
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
    def stages(self) -> tuple[Stage, ...]:
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

    def __repr__(self) -> str:
        """Return the request, the sizes of the subimages and the prediction."""
        return reprs.summary(self, *report.summary(self.tolerance_db, self.method, self.prediction))

    def _repr_html_(self) -> str:
        return self._report().html()

    def describe(self) -> str:
        """Return the predictions as text: in total, stage by stage, and by cause of error."""
        return self._report().text()

    def _report(self) -> Report:
        return report.report(self.tolerance_db, self.method, self.prediction, self.left_out)

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

        Raises
        ------
        ImportError
            If pydantic is not installed (extra `files`).
        """
        validate.flag("filters", filters)
        # The digest is of lists and numbers as they are after a round trip through JSON.
        values = {"version": VERSION} | json.loads(json.dumps(_stored().dump_python(self)))
        if filters:
            values = with_digest(values)
        else:
            _drop(values, "coefficients")
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
            If the text is not such a plan, was written by an unsupported version, or does not match
            its digest.
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
            values = {name: values[name] for name in values if name not in ("version", DIGEST)}
            return _stored().validate_json(json.dumps(values))
        except ValidationError as error:
            problem = explained(error, values)
            raise ValueError(f"text must be a plan as of Plan.to_json: {problem}") from None
        except (TypeError, ValueError) as error:
            raise ValueError(f"text must be a plan as of Plan.to_json: {error}") from error

    def check(self, lines: RangeLines, grid: Grid) -> None:
        """Check that this plan was made for the geometry of these lines and this grid.

        If pydantic is installed (extra `files`), the values of all fields are checked as well.

        Parameters
        ----------
        lines : RangeLines
        grid : Grid

        Raises
        ------
        TypeError, ValueError
            If it was made for another geometry, a field has a value that it may not have, or an
            argument is not of these types.
        """
        validate.instance("lines", lines, RangeLines)
        validate.instance("grid", grid, Grid)
        _check_values(self)
        for name, mine, theirs in (
            ("lines", self.lines_digest, lines_digest(lines)),
            ("grid", self.grid_digest, grid_digest(grid)),
        ):
            if mine != theirs:
                raise ValueError(
                    f"{name} must have the geometry for which the plan was made; make a new plan "
                    "with clsas.plan"
                )
        if not self.is_exact:
            # Sampled lines contain no higher frequencies; a higher bound would only need memory.
            most = abs(lines.carrier_cycles_per_m) + 1 / lines.range_step_m
            if lines.sound_speed is not None:  # slower water at the seabed has shorter wavelengths
                most *= 2
            given = self.factorization.highest_cycles_per_m
            validate.number("highest_cycles_per_m", given, "cycles/m", most=most)


def _check_values(plan: Plan) -> None:
    """Raise ValueError if a field has a value that it may not have, for example by `replace`."""
    try:
        from pydantic import ValidationError
    except ImportError:  # nobody can have read the plan from JSON
        return
    try:
        _stored().validate_python(plan)
    except ValidationError as error:
        raise ValueError(f"the plan is invalid: {explained(error, vars(plan))}") from None


def _check_version(values: dict[str, Any]) -> None:
    """Raise ValueError unless this clsas reads the version of a text."""
    version = values.get("version", 1 if "roots_at_once" in values else None)
    if version is None:
        raise ValueError("it lacks 'version'")
    if version != VERSION:
        by = "clsas before 0.1.0" if version == 1 else "another version of clsas"
        raise ValueError(
            f"it has version {validate.shown(version)}, written by {by}; this clsas reads version "
            f"{VERSION}: make the plan again with clsas.plan"
        )


def _check_digest(values: dict[str, Any]) -> None:
    """Raise ValueError unless a text matches the digest in it."""
    if DIGEST not in values:
        raise ValueError("it lacks 'digest', like texts that `to_json` wrote without filters")
    if not is_intact(values):
        raise ValueError("its digest differs: the text was changed or damaged")


@functools.cache
def _stored() -> TypeAdapter[Plan]:
    """Return the pydantic adapter that reads and writes plans."""
    with needed("plans as JSON"):
        from pydantic import TypeAdapter
    return TypeAdapter(Plan)


def _drop(values: dict[str, Any], name: str) -> None:
    """Remove a key from nested objects."""
    values.pop(name, None)
    for value in values.values():
        if isinstance(value, dict):
            _drop(value, name)
