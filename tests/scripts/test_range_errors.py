import numpy as np
import pytest
from cases import along_x, beside, patch, thesis_lines
from thesis.range_errors import range_errors_m

from clsas import plan
from clsas.engine.factorized.virtual_channels import stage_errors_m

SPACING_M, SIDE_M, NEAREST_M = 8.25e-3, 5.0, 40.0  # THESIS chapter 5
STAGES = [[(2, 2)], [(3, 8)], [(8, 2)], [(2, 2)] * 3, [(4, 8), (2, 2)]]


@pytest.mark.watches("scripts/thesis")
@pytest.mark.parametrize("stages", STAGES)
@pytest.mark.parametrize("bistatic", [False, True])
def test_errors_of_a_plan(stages, bistatic):
    """The largest errors are those of [45], reduced by the position of the outermost channel."""
    grid = patch(-SIDE_M / 2, NEAREST_M, 1024, 1024, SIDE_M / 1024)
    tx = along_x(640, SPACING_M)
    lines = thesis_lines(grid, tx, beside(tx, 0.05, 0.0, 0.0) if bistatic else None)
    random = np.random.default_rng(2)
    corners = [[0, 0], [0, 1023], [511, 511], [512, 512], [1023, 0]]
    pixels = np.concatenate([corners, random.integers(0, 1024, (200, 2))])
    errors_m = range_errors_m(plan(lines, grid, stages=stages), lines, grid, pixels)
    assert errors_m.shape == (len(pixels), 640)
    bounds_m = stage_errors_m(stages, SPACING_M, SIDE_M, NEAREST_M)
    shares = [(beams - 1) / beams for beams, _ in stages]
    expected_m = np.dot(bounds_m, shares)
    # Lines of sight are oblique by up to 7 degrees, which adds up to 12 %.
    assert 0.85 * expected_m <= np.abs(errors_m).max() <= 1.12 * expected_m
    # Errors of stages are independent, so their powers add up.
    rms_m = np.sqrt(np.mean(errors_m**2))
    spread = [
        (beams**2 - 1) / 3 / beams**2 * e**2 for (beams, _), e in zip(stages, bounds_m, strict=True)
    ]
    assert rms_m == pytest.approx(np.sqrt(np.sum(spread) / 3), rel=0.15)


def test_a_plan_without_sums_errs_nowhere():
    grid = patch(0.0, 42.5, 64, 64)
    lines = thesis_lines(grid, along_x(40, SPACING_M))
    pixels = np.stack(np.meshgrid(np.arange(64), np.arange(64)), axis=-1).reshape(-1, 2)
    errors_m = range_errors_m(plan(lines, grid, stages=[(1, 2), (1, 2)]), lines, grid, pixels)
    assert np.abs(errors_m).max() < 1e-12
