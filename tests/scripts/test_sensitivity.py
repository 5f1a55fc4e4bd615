import pytest
from studies import sensitivity
from studies.scaling import scaled

from clsas.engine.device.device import open_device
from clsas.engine.factorized import search
from clsas.engine.factorized.costs import Costs


def named(name):
    (found,) = (each for each in sensitivity.constants() if each.name == name)
    return found


def test_tuned_constants_are_numbers_that_may_be_changed():
    found = {each.name for each in sensitivity.constants()}
    assert {"MARGIN_DB", "_LEAF_SHARE", "MEASURED_CHANNELS", "GEOMETRY_ERROR"} <= found
    assert not {"STACK", "CHUNK", "TAPS", "MOST_TAPS"} & found


@pytest.mark.slow
def test_neighbours_are_half_and_twice_the_value_or_the_power():
    assert named("_LEAF_SHARE").neighbours == (0.125, 0.5)
    assert named("MEASURED_CHANNELS").neighbours == (128, 512)
    assert named("MARGIN_DB").neighbours == (-2.0, 4.0)


@pytest.mark.watches("scripts/studies")
def test_a_constant_is_changed_wherever_it_is_imported_and_then_restored():
    constant = named("LEAST_BATCH")
    before = constant.value
    with constant.set_to(7):
        assert constant.value == search.LEAST_BATCH == 7
    assert constant.value == search.LEAST_BATCH == before


def test_a_trial_plans_and_measures():
    case = scaled(64)
    lines, costs = case.lines(), Costs(pixel_ns=1e4, point_ns=1e4)
    trial = sensitivity.Trial(-30.0, lines, case.grid, case.beam, costs, open_device())
    found = trial.run()
    assert found.predicted_s > 0
    assert found.predicted_db <= -30
    assert found.measured_db != found.measured_db  # NaN, since there is no reference
