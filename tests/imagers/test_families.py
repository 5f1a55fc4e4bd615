"""Random scenes of every family, held to float64 sums that share nothing with the imagers."""

import random

import pytest
from families import FAMILIES, draw
from judging import images_of

MISSED = (
    ("beam's edge", 40979, -30),
    ("dense, narrow, apart", 2131, -40),
    ("dense, narrow, apart", 9007, -50),
    ("apart, narrow", 5025, -20),
    ("apart, narrow", 5061, -15),
    ("moving", 5008, -20),
    ("moving", 5026, -40),
    ("headings with beam", 103, -15),
    ("gains", 2065, -50),
    ("gains, dense", 2084, -60),
    ("gains, dense", 41180, -15),
    ("gains, dense", 41468, -30),
    ("dense", 5082, -50),
    ("rings", 492835, -20),
    ("rings", 123, -50),
    ("reliefs and points with beam", 5020, -50),
    ("anything", 2159, -20),
    ("profiles with heave and motion", 7323, -70),
    ("gaps in the band", 3643315288, -45),
)
"""Families, seeds and tolerances of images that once erred by more than was predicted."""


def missed(family, seed, accuracy_db, tolerances_db):
    """Images that err by more than was asked and predicted, or than they certify, in words."""
    images = images_of(draw(family, seed), accuracy_db, tolerances_db)
    return [str(each) for each in images if (each.missed and not each.warned) or each.disagrees]


@pytest.mark.slow
@pytest.mark.parametrize(("family", "seed", "tolerance_db"), MISSED)
def test_scenes_that_once_missed(family, seed, tolerance_db):
    assert missed(family, seed, -50, [tolerance_db]) == []


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES)
def test_a_scene_of_every_family(family):
    assert missed(family, 1, -55, [-45]) == []


# Scenes whose echoes come from beside the grid may miss by some dB, as docs/accuracy.md says.
PREDICTED = [family for family in FAMILIES if not family.startswith("echoes from beside")]


@pytest.mark.exhaustive
@pytest.mark.parametrize("number", range(12))
@pytest.mark.parametrize("family", PREDICTED)
def test_new_scenes_of_every_family(family, number):
    """The order of the tests has a seed, from which those of the scenes follow."""
    seed = (random.getrandbits(32) + number) % 2**32
    print(f"family {family}, seed {seed}")  # shown if the test fails
    assert missed(family, seed, -55, [-20, -45]) == []
