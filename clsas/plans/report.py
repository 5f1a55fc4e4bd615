"""Plans as text: a summary in one line, and a report with tables."""

from __future__ import annotations

from clsas.core import reprs
from clsas.core.tables import Report, Table
from clsas.plans.factorization import ExactImage, Factorization
from clsas.plans.predictions import Prediction, Stage

_HEADINGS = (
    "stage", "subimages", "rows x columns", "channels", "samples", "operations", "error", "time",
)  # fmt: skip
_COSTS = {
    "given": "costs that were given.",
    "calibrated": "costs that an earlier version of clsas measured on this device{when}.",
    "scaled": "default costs, scaled to this device by a short measurement{when}.",
    "default": (
        "default costs, which were not scaled to this device; `clsas devices --measure` does that."
    ),
}


def summary(
    tolerance_db: float | None, method: Factorization | ExactImage, prediction: Prediction
) -> tuple[str, ...]:
    """Return the parts of a summary: request, sizes of subimages, and prediction."""
    asked = "stages as given"
    if tolerance_db is not None:
        asked = f"tolerance {reprs.quantity(tolerance_db, 'dB')}"
    sides = ", ".join(map(reprs.by, method.sides))
    return (
        asked,
        f"subimages of {sides} pixels" if sides else "exact",
        f"predicted error {prediction.error_db:.1f} dB",
        f"predicted time {_seconds(prediction.seconds)}",
        f"{reprs.quantity(prediction.memory_bytes, 'bytes')} of device memory",
    )


def report(
    tolerance_db: float | None,
    method: Factorization | ExactImage,
    prediction: Prediction,
    left_out: tuple[str, ...],
) -> Report:
    """Return the predictions of a plan: in total, stage by stage, and by cause of error."""
    parts: list[str | Table] = [_headline(tolerance_db, method, prediction)]
    if left_out:
        parts.append(f"Left out, far below the tolerance: {', '.join(left_out)}")
    if isinstance(method, ExactImage):
        reason = method.reason or "no factorization is faster within the tolerance"
        because = "" if tolerance_db is None else f": {reason}"
        parts.append(f"Plain backprojection{because}.")
    else:
        parts += [_filters(method), _stages(prediction.stages)]
    parts += ["Error by cause, with its margin; powers add up:", *prediction.errors.describe()]
    origin = costs_in_words(prediction.cost_source, prediction.costs_measured)
    parts.append(f"Times follow from {origin}")
    return Report(parts)


def costs_in_words(source: str, measured: str) -> str:
    """Return the origin of costs and the day of their measurement, as the end of a sentence."""
    return _COSTS[source].format(when=f" on {measured[:10]}" if measured else "")


def _headline(
    tolerance_db: float | None, method: Factorization | ExactImage, prediction: Prediction
) -> str:
    is_exact = isinstance(method, ExactImage)
    if tolerance_db is not None:
        asked = f"tolerance {tolerance_db:.4g} dB"
    else:
        asked = "no stage, as given" if is_exact else "stages as given, nearest beam"
    precision = "" if is_exact else f", {'half' if method.half_precision else 'single'} precision"
    return (
        f"Plan: {asked}; predicted error {prediction.error_db:.1f} dB, "
        f"{_seconds(prediction.seconds)} on {prediction.device} "
        f"(exact: {_seconds(prediction.exact_seconds)}), "
        f"{prediction.memory_bytes / 2**20:.0f} MiB{precision}"
    )


def _filters(method: Factorization) -> str:
    return (
        f"{method.align.taps} taps in range at {method.resampling.ratio:.2f} x the lines' rate, "
        f"{method.aperture.describe()}, {method.final.taps} taps at the end"
    )


def _stages(stages: tuple[Stage, ...]) -> Table:
    labels = [*(str(number) for number in range(1, len(stages))), "last"]
    rows = [
        (
            label,
            f"{stage.subimages}",
            f"{stage.rows} x {stage.columns}",
            f"{stage.channels}",
            f"{stage.samples}",
            f"{stage.operations:.3g}",
            f"{stage.error_db:.1f} dB",
            _seconds(stage.seconds),
        )
        for label, stage in zip(labels, stages, strict=True)
    ]
    return Table(_HEADINGS, rows)


def _seconds(seconds: float) -> str:
    return f"{seconds:.3g} s" if seconds >= 1 else f"{1e3 * seconds:.3g} ms"
