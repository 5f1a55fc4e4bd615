"""Parts that the results of `clsas.limits` share: how to build one, and why one is missing."""

from __future__ import annotations

from clsas.measures.limits_result import LABELS, Limit

Result = Limit | tuple[str, str]
"""A result, or the names of results (separated by spaces) and why they cannot be given."""

_ROUNDING = 1e-6  # relative excess of a limit that rounding explains
_UNITS = {"_m_s": "m/s", "_hz": "Hz", "_db": "dB", "_m": "m", "_s": "s"}

NO_PINGS = "requires a track of two or more pings at different positions"
NO_INTERVAL = "requires a track of two or more pings"
NO_RANGE = "requires a track and a grid, or the recorded range"
NO_RECORD = "requires the recorded range; without it, every echo is recorded"
NO_GRID = "requires a track and a grid"
NO_PLANE = "requires a grid on a plane; this one consists of points"
NO_ELEMENT = "requires the length of the elements, which are omnidirectional"
NO_ARRAY = "requires several receivers along the track"
NO_STEP = "requires several receivers along the track, or the length of the elements"
NO_CENTRES = "requires several phase centres: a track, or several receivers"
NO_LOBES = "requires lobes; these would lie beyond end-fire"
CURVED = "requires a straight track; this one is curved, or turns back"
UNSEEN = "requires an aperture: several places from which the beam covers the middle"


def result(
    name: str,
    value: float,
    equation: str,
    meaning: str,
    *,
    most: float | None = None,
    least: float | None = None,
    slack: float = _ROUNDING,
    consequence: str = "",
) -> Limit:
    """Return a result, whose unit is that of its name. `most` or `least` is its limit."""
    unit = next((unit for end, unit in _UNITS.items() if name.endswith(end)), "")
    limit, side, kept = None, "", None
    if most is not None:
        limit, side, kept = most, "most", value <= most * (1 + slack)
    elif least is not None:
        limit, side, kept = least, "least", value >= least * (1 - slack)
    return Limit(
        name,
        "",
        LABELS[name],
        float(value),
        unit,
        limit,
        side,
        kept,
        equation,
        meaning,
        consequence,
    )
