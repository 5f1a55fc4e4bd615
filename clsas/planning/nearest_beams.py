"""Plans of given stages: nearest beams, as in chapter 4 of the thesis."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from clsas.aperture.nearest import NearestBeams
from clsas.core.decibels import in_db, power
from clsas.opencl.device import Device
from clsas.planning.candidate import Candidate
from clsas.planning.errors import leaf_error, nearest_errors
from clsas.planning.prediction import Conditions, predicted_plan
from clsas.planning.subimages import Side
from clsas.planning.visibility_model import VisibilityModel
from clsas.plans.plan import Plan
from clsas.plans.predictions import ErrorBudget
from clsas.signal import interpolation

NEAREST_UPSAMPLING = 8.0
"""Upsampling of lines before their linear interpolation."""

_MOST_LEAF_ERROR = 1e-8  # power of the expansion of ranges in a tile: -80 dB


def nearest_plan(
    model: VisibilityModel, stages: Sequence[tuple[int, int]], conditions: Conditions
) -> Plan:
    """Return the plan of given stages (QR, QI), with linear interpolation in range."""
    rows, columns = model.grid.shape
    division = math.prod(divisions for _, divisions in stages)
    # Whole work-items: 16 rows by 4 columns.
    side = 16 * math.ceil(rows / division / 16), 4 * math.ceil(columns / division / 4)
    sides = []
    for _, divisions in reversed(stages):
        sides.append(side)
        side = side[0] * divisions, side[1] * divisions
    linear = interpolation.design(2, NEAREST_UPSAMPLING, model.spectrum)
    candidate = Candidate(
        sides=tuple(sides[::-1]),
        tile=_tile(model, sides[0], conditions.device),
        align=linear,
        final=linear,
        aperture=NearestBeams(factors=tuple(beams for beams, _ in stages)),
    )
    error, by_stage = nearest_errors(model, stages)
    found = predicted_plan(model, candidate, ErrorBudget(nearest_beams=error), conditions)
    *divided, last = found.stages
    divided = [
        replace(stage, error_db=in_db(power(stage.error_db) + of_beams))
        for stage, of_beams in zip(divided, by_stage, strict=True)
    ]
    return replace(found, prediction=replace(found.prediction, stages=(*divided, last)))


def _tile(model: VisibilityModel, leaf: Side, device: Device) -> Side:
    """Return the largest tiles of a leaf in which ranges may be expanded about the centre."""
    parts = [
        (rows, columns)
        for rows in range(16, min(leaf[0], 64) + 1, 16)
        for columns in range(4, min(leaf[1], 64) + 1, 4)
        if leaf[0] % rows == 0 and leaf[1] % columns == 0
    ]
    fit = [
        part for part in parts if leaf_error(model, np.array([part]), device)[0] < _MOST_LEAF_ERROR
    ]
    return max(fit or parts[:1], key=math.prod)
