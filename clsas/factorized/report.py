"""Plans in words: one line, and tables of what is predicted."""

from __future__ import annotations

from typing import TYPE_CHECKING

from clsas.core import reprs
from clsas.core.tables import Report, Table
from clsas.factorized.factorization import ExactImage

if TYPE_CHECKING:
    from clsas.factorized.factorization import Factorization
    from clsas.factorized.plan import Plan, Stage

_HEADINGS = (
    "stage", "subimages", "rows x columns", "channels", "samples", "operations", "error", "time",
)  # fmt: skip
_COSTS = {
    "given": "costs that were given.",
    "calibrated": "costs that `clsas measure-costs` measured on this device{when}.",
    "scaled": (
        "default costs, scaled to this device by a short measurement{when}: `clsas measure-costs` "
        "measures each."
    ),
    "default": (
        "default costs, not from any measured on this device: `clsas measure-costs` measures them."
    ),
}


def summary(plan: Plan) -> str:
    """Return the request, the prediction and the sides of the subimages in one line."""
    asked = "stages as given"
    if plan.tolerance_db is not None:
        asked = f"tolerance {reprs.quantity(plan.tolerance_db, 'dB')}"
    sides = ", ".join(map(reprs.by, plan.sides))
    return reprs.summary(
        plan,
        asked,
        f"subimages of {sides} pixels" if sides else "exact",
        f"predicted error {plan.predicted_error_db:.1f} dB",
        f"predicted time {_seconds(plan.predicted_seconds)}",
        f"{reprs.quantity(plan.memory_bytes, 'bytes')} of device memory",
    )


def report(plan: Plan) -> Report:
    """Return what a plan predicts: in total, stage by stage, and the causes of its error."""
    parts: list[str | Table] = [_headline(plan)]
    if plan.left_out:
        parts.append(f"Left out, far below the tolerance: {', '.join(plan.left_out)}")
    if isinstance(plan.image, ExactImage):
        reason = plan.image.reason or "no factorization is faster within the tolerance"
        because = "" if plan.tolerance_db is None else f": {reason}"
        parts.append(f"Plain backprojection{because}.")
    else:
        parts += [_filters(plan.factorization), _stages(plan.stages)]
    parts += ["Error by cause, with its margin; powers add up:", *plan.prediction.errors.describe()]
    said = plan.prediction
    parts.append(f"Times follow from {costs_in_words(said.cost_source, said.costs_measured)}")
    return Report(parts)


def costs_in_words(source: str, measured: str) -> str:
    """Return the origin of costs, and the day they were measured, as the end of a sentence."""
    return _COSTS[source].format(when=f" on {measured[:10]}" if measured else "")


def _headline(plan: Plan) -> str:
    if plan.tolerance_db is not None:
        asked = f"tolerance {plan.tolerance_db:.4g} dB"
    else:
        asked = "no stage, as given" if plan.is_exact else "stages as given, nearest beam"
    precision = ""
    if not plan.is_exact:
        precision = f", {'half' if plan.half_precision else 'single'} precision"
    return (
        f"Plan: {asked}; predicted error {plan.predicted_error_db:.1f} dB, "
        f"{_seconds(plan.predicted_seconds)} on {plan.prediction.device} "
        f"(exact: {_seconds(plan.exact_seconds)}), {plan.memory_bytes / 2**20:.0f} MiB{precision}"
    )


def _filters(image: Factorization) -> str:
    return (
        f"{image.align.taps} taps in range at {image.resampling.ratio:.2f} x the lines' rate, "
        f"{image.aperture.describe()}, {image.final.taps} taps at the end"
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
