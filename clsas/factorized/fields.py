"""Types of a plan's fields: see `clsas.core.fields`."""

from __future__ import annotations

from typing import Annotated, Any

from clsas.core.fields import Amount, StoredAs
from clsas.factorized.estimates import ErrorBudget, Work
from clsas.sonar.beam import BeamWindow

StoredBeam = Annotated[BeamWindow, StoredAs(dict[str, Any])]
StoredWork = Annotated[Work, StoredAs(dict[str, Amount])]
StoredErrors = Annotated[ErrorBudget, StoredAs(dict[str, Amount])]
