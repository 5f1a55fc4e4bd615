"""Random scenes of every family, held to float64 sums that share nothing with the imagers."""

import pytest
from families import draw
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from judging import images_of

HOLDING = ("plain", "bands", "reliefs and points")


@pytest.mark.slow
@settings(
    max_examples=2,
    deadline=None,
    phases=[Phase.explicit, Phase.reuse, Phase.generate],  # smaller seeds are no simpler scenes
    suppress_health_check=[HealthCheck.too_slow],
)
@given(seed=st.integers(0, 2**32 - 1))
@pytest.mark.parametrize("family", HOLDING)
def test_no_image_errs_by_more_than_was_asked_and_predicted(family, seed):
    images = images_of(draw(family, seed), accuracy_db=-55, tolerances_db=[-20, -45])
    assert [str(each) for each in images if each.missed and not each.warned] == []
