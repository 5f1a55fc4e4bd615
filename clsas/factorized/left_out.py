"""Plans that leave effects out: the plan for the given lines, and the one for the simpler model."""

from __future__ import annotations

import weakref
from dataclasses import replace

from clsas.core.digests import grid_digest, lines_digest
from clsas.core.grid import Grid
from clsas.core.lines import RangeLines
from clsas.factorized.plan import COVERAGE, Plan
from clsas.sonar.beam import BeamWindow
from clsas.sonar.simplify import Model, leave_out


def with_left_out(
    simpler: Plan, model: Model, lines: RangeLines, grid: Grid, beam: BeamWindow | None
) -> Plan:
    """Return the plan for given lines that leaves out effects as their model does.

    `simpler` is the plan of the model; it is kept for the image.
    """
    plan = replace(
        simpler,
        left_out=model.left_out,
        beam=beam,
        lines_digest=lines_digest(lines),
        grid_digest=grid_digest(grid),
    )
    plan.kept["model"] = model.lines.without_samples(), model.grid, simpler
    return plan


def without_left_out(plan: Plan, lines: RangeLines, grid: Grid) -> tuple[RangeLines, Grid, Plan]:
    """Return the simpler model's lines, grid and plan, which leaves nothing out.

    The geometry of both is kept for the next image of the plan.
    """
    if "model" not in plan.kept:
        model = leave_out(lines, grid, plan.beam, plan.left_out)
        simpler = replace(
            plan,
            left_out=(),
            beam=model.beam,
            lines_digest=lines_digest(model.lines),
            grid_digest=grid_digest(model.grid),
        )
        plan.kept["model"] = model.lines.without_samples(), model.grid, simpler
    geometry, simple_grid, simpler = plan.kept["model"]
    simple_lines = replace(geometry, samples=lines.samples)
    simpler.kept["lines"] = weakref.ref(simple_lines)  # the given lines' band is theirs
    simpler.kept.update({name: plan.kept[name] for name in COVERAGE if name in plan.kept})
    return simple_lines, simple_grid, simpler
