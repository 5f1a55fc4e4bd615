"""Arguments of a mosaic: checks, and the requests that they make."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from clsas.core import validate
from clsas.core.lines import RangeLines
from clsas.exact.backprojection import BEST_ACCURACY_DB
from clsas.mosaics.provenance import REQUESTS
from clsas.mosaics.scheduling import Growth
from clsas.planning.request import TOLERANCE_DB, checked_pairs, tolerance_in_db
from clsas.sonar.beam import BeamWindow
from clsas.sonar.directions import MOST_TRACK_PINGS


def checked_request(
    tolerance_db: float | None,
    tolerance_wavelengths: float | None,
    stages: Sequence[tuple[int, int]] | None,
    accuracy_db: float | None,
) -> dict[str, Any]:
    """Return the given one of `REQUESTS` after checking it, or the default tolerance."""
    given = (tolerance_db, tolerance_wavelengths, stages, accuracy_db)
    request: dict[str, Any] = {
        name: value for name, value in zip(REQUESTS, given, strict=True) if value is not None
    }
    if len(request) > 1:
        raise ValueError(f"at most one of {', '.join(REQUESTS)} must be given, got {request}")
    tolerance_in_db(tolerance_db, tolerance_wavelengths)
    if accuracy_db is not None:
        validate.number("accuracy_db", accuracy_db, "dB", least=BEST_ACCURACY_DB, below=0.0)
    # Convert to plain numbers, since the inputs are stored as JSON.
    for name, value in request.items():
        if name == "stages":
            request[name] = checked_pairs(value)
        elif not isinstance(value, (int, float)):
            request[name] = float(value)
    return request or {"tolerance_db": TOLERANCE_DB}


def checked_growth(source: RangeLines | Path, follow_s: float | None) -> Growth | None:
    """Return the folder to follow, or None without `follow_s`; other sources raise ValueError."""
    if follow_s is None:
        return None
    idle_s = validate.positive("follow_s", follow_s, "s")
    if isinstance(source, RangeLines) or not source.is_dir():
        got = "lines in memory" if isinstance(source, RangeLines) else repr(str(source))
        raise ValueError(f"source must be a folder if follow_s is given, got {got}")
    return Growth(source.resolve(), idle_s)


def beam_of_growing(beam: BeamWindow) -> BeamWindow:
    """Return a beam whose weights later pings do not change; raise ValueError if there is none."""
    if beam.normalise:
        raise ValueError(
            "beam must not normalise for a folder, which may grow: the scale depends on the number "
            "of all channels"
        )
    if beam.along is None and beam.track_pings is None:
        return replace(beam, track_pings=MOST_TRACK_PINGS)
    return beam


def check_client(client: object, source: object, store: object, device: object) -> None:
    """Raise TypeError or ValueError unless the other arguments can be used with a client."""
    if not hasattr(client, "get_executor"):
        raise TypeError(f"client must be a distributed.Client, got {client!r}")
    if store is None:
        raise ValueError("store must be given with a client, whose workers write to it")
    if isinstance(source, RangeLines):
        raise ValueError("source must be a path with a client, whose workers read from it")
    if device is not None:
        raise ValueError("device must be left out with a client: every worker takes one itself")
