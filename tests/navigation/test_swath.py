"""Ranges that micronavigation uses."""

import numpy as np
import pytest
from cases import along_x

from clsas.engine.data.lines import RangeLines
from clsas.navigation.micronavigation import checked_swath

FIRST_M = np.array([10.0, 11.5, 12.0, 10.0])
TRACK = along_x(4, 0.1)
LINES = RangeLines(np.ones((4, 401), complex), FIRST_M, 0.01, TRACK, TRACK, 100e3, 1500.0)


def swath(range_m=None):
    return checked_swath(LINES, range_m, None, "port", None, None)


def test_windows_lie_in_the_ranges_that_all_channels_have():
    edges_m = swath().edges_m
    assert 12.0 < edges_m[0] < 12.1
    assert 13.9 < edges_m[-1] < 14.0
    np.testing.assert_array_equal(swath((12.0, 14.0)).edges_m[[0, -1]], [12.0, 14.0])


@pytest.mark.parametrize("range_m", [(11.0, 13.0), (12.5, 15.0), (13.0, 12.5)])
def test_ranges_that_some_channels_lack_are_refused(range_m):
    with pytest.raises(ValueError, match="that all channels have, 12 to 14 m"):
        swath(range_m)
