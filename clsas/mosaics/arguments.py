"""Arguments of a mosaic: checks, and the requests that they make."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from clsas.engine.data import validate
from clsas.engine.data.beam import MOST_TRACK_PINGS, BeamWindow
from clsas.engine.data.declared import Number
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.simplify import shift_error
from clsas.engine.data.validate import ArgumentError, ArgumentTypeError
from clsas.engine.exact.decide import BEST_ACCURACY_DB
from clsas.engine.factorized.planner import TOLERANCE_DB, checked_pairs, tolerance_in_db
from clsas.mosaics.document import Document, is_there
from clsas.mosaics.provenance import REQUESTS, beam_json
from clsas.mosaics.scheduling import Growth
from clsas.mosaics.survey import END, has_ended


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
        first, second, *_ = request
        raise ArgumentError(second, f"be left out if `{first}` is given")
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


FOLLOW = Number(
    "s",
    above=0.0,
    help="Stop after this time without a new file. A file named `end` stops it at once.",
)
"""Declares for how long the folder of a survey is followed."""


def checked_growth(source: RangeLines | Path, follow_s: float | None) -> Growth | None:
    """Return the folder to follow, or None without `follow_s`; other sources raise ValueError."""
    if follow_s is None:
        return None
    idle_s = FOLLOW.check("follow_s", follow_s)
    if isinstance(source, RangeLines) or not source.is_dir():
        got = "lines in memory" if isinstance(source, RangeLines) else repr(str(source))
        raise ArgumentError("source", "be a folder if `follow_s` is given", got)
    return Growth(source.resolve(), idle_s)


def beam_of_mosaic(
    beam: BeamWindow | None, source: RangeLines | Path, store: Path | None, *, grows: bool
) -> BeamWindow | None:
    """Return a beam whose weights later pings do not change, if there may be any.

    Files may be added to a folder that is followed, and to one without a file `end` whose mosaic is
    stored. The mosaic of such a folder keeps its beam when the folder is complete.

    Raises
    ------
    ValueError
        If there may be later pings, and the weights depend on them.
    """
    if beam is None or isinstance(source, RangeLines) or not source.is_dir():
        return beam
    if grows or (store is not None and not has_ended(source)):
        if beam.normalise:
            raise ArgumentError(
                "beam",
                "not normalise for a folder that may grow, since the scale depends on the number "
                "of all channels",
                hint=f"put an empty file '{END}' into a complete folder",
            )
        return beam_of_growing(beam)
    if store is not None and is_there(store):
        growing = beam_of_growing(beam)
        if Document.read(store).inputs.get("beam") == json.loads(beam_json(growing)):
            return growing
    return beam


def beam_of_growing(beam: BeamWindow) -> BeamWindow:
    """Return a beam whose direction follows the track over a fixed number of pings."""
    if beam.along is None and beam.track_pings is None:
        return replace(beam, track_pings=MOST_TRACK_PINGS)
    return beam


def warn_of_window(beam: BeamWindow, geometry: RangeLines, request: dict[str, Any]) -> None:
    """Warn if a growing survey's image differs from that of the same pings in one file.

    `beam` is that of the file, whose direction follows the track over another number of pings.
    The difference is the rms of that of the weights, relative to their own.
    """
    if len(geometry.ping_starts) < 2:
        return
    growing = beam_of_growing(beam)
    sine = np.linalg.norm(np.cross(beam.directions(geometry), growing.directions(geometry)), axis=1)
    power = shift_error(beam, float(np.sqrt(np.mean(sine**2))), geometry)
    ways = request.get("tolerance_db"), request.get("tolerance_wavelengths")
    asked_db = request.get("accuracy_db") or tolerance_in_db(*ways) or TOLERANCE_DB
    if power > 10 ** (asked_db / 10):
        validate.warn(
            "`source` may grow, or did when the mosaic began: the direction of the track is "
            f"smoothed over {MOST_TRACK_PINGS} pings, whatever their number. The image may differ "
            f"by {10 * np.log10(power):.0f} dB from that of the {len(geometry.ping_starts)} pings "
            "in one file. Give `track_pings` for both, or put an empty file "
            f"'{END}' into a complete folder before its mosaic begins"
        )


def check_client(client: object, source: object, store: object, device: object) -> None:
    """Raise TypeError or ValueError unless the other arguments can be used with a client."""
    if not hasattr(client, "get_executor"):
        raise ArgumentTypeError("client", "be a `distributed.Client`", repr(client))
    if store is None:
        raise ArgumentError("store", "be given with a client, whose workers write to it")
    if isinstance(source, RangeLines):
        raise ArgumentError("source", "be a path with a client, whose workers read from it")
    if device is not None:
        raise ArgumentError(
            "device", "be left out with a client", hint="every worker takes one itself"
        )
