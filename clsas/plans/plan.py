"""How an image will be formed, with its predicted error, time and memory."""

from __future__ import annotations

import functools
import hashlib
import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

from clsas.core import reprs, validate
from clsas.core.digests import grid_digest, lines_digest
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

VERSION = 5
"""Version of a plan's JSON. Version 1, of clsas before 0.1.0, had no number; version 2 had a single
mean track; version 3 lacked the origin of costs; in version 4 `method` was `image`."""


@dataclass(frozen=True, eq=False)
class Plan:
    """An image, decided before the device starts; made by `plan`, used by `factorize`.

    Attributes
    ----------
    tolerance_db : float or None
        Relative rms error asked for; None where stages were given.
    method : Factorization or ExactImage
        How the image is formed: exactly, if nothing is faster within the tolerance.
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
    method: Annotated[Factorization | ExactImage, Constraint(discriminator="kind")]
    prediction: Prediction
    beam: Annotated[BeamWindow, StoredAs(dict[str, Any])] | None
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

    @property
    def is_exact(self) -> bool:
        """True for exact backprojection."""
        return isinstance(self.method, ExactImage)

    @property
    def factorization(self) -> Factorization:
        """How the image is divided; raises TypeError for an exact one."""
        if isinstance(self.method, ExactImage):
            raise TypeError("the plan must divide the image, got one of an exact image")
        return self.method

    @property
    def sides(self) -> tuple[tuple[int, int], ...]:
        """Rows and columns of subimages, stage by stage. Empty for an exact image."""
        return self.method.sides

    @property
    def half_precision(self) -> bool:
        """True if lines are handed on from stage to stage in half precision."""
        return self.method.half_precision

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
        return reprs.summary(self, *report.summary(self.tolerance_db, self.method, self.prediction))

    def _repr_html_(self) -> str:
        return self._report().html()

    def describe(self) -> str:
        """Return a table of what is predicted, stage by stage."""
        return self._report().text()

    def _report(self) -> Report:
        return report.report(self.tolerance_db, self.method, self.prediction, self.left_out)

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
            values = _renamed(values) if values["version"] == 4 else values
            values = {name: values[name] for name in values if name not in ("version", "digest")}
            return _stored().validate_json(json.dumps(values))
        except ValidationError as error:
            problem = explained(error, values)
            raise ValueError(f"text must be a plan as of Plan.to_json: {problem}") from None
        except (TypeError, ValueError) as error:
            raise ValueError(f"text must be a plan as of Plan.to_json: {error}") from error

    def check(self, lines: RangeLines, grid: Grid) -> None:
        """Raise TypeError or ValueError unless this plan was made for these lines and this grid.

        If pydantic is installed (extra `files`), values that no plan may have are refused too.
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
                    f"the plan was made for another {name.removesuffix('s')} geometry than that "
                    f"of {name}; plan anew with clsas.plan"
                )
        if not self.is_exact:
            # Sampled lines hold no frequency beyond: more would only cost memory.
            most = abs(lines.carrier_cycles_per_m) + 1 / lines.range_step_m
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
    """Raise ValueError unless a text is of a version that this clsas reads."""
    version = values.get("version", 1 if "roots_at_once" in values else None)
    if version is None:
        raise ValueError("it lacks 'version'")
    if version not in (4, VERSION):
        by = "clsas before 0.1.0" if version == 1 else "another clsas"
        raise ValueError(
            f"it has version {validate.shown(version)}, made by {by}; this clsas reads versions 4 "
            f"and {VERSION}: make it anew with clsas.plan"
        )


def _renamed(values: dict[str, Any]) -> dict[str, Any]:
    """Return the values of a text of version 4 with the names of version 5."""
    image = values.get("image")
    method = (
        {"kind" if name == "method" else name: value for name, value in image.items()}
        if isinstance(image, dict)
        else image
    )
    return {("method" if name == "image" else name): values[name] for name in values} | (
        {"method": method} if "image" in values else {}
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
