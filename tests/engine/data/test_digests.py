"""Every field of lines, grids and records counts in their digests."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

import clsas
from clsas.engine.data.digests import (
    NOT_IN_IMAGES,
    digest,
    grid_digest,
    is_intact,
    lines_digest,
    with_digest,
)

PLACE = clsas.Georeference.local(60.39, 5.32, heading_deg=217)
LINES = clsas.RangeLines(
    np.ones((2, 9), complex), 40.0, 0.05, [[0, 0, 0], [0.5, 0, 0]], [0, 0, 0.1], 1e5, 1500.0
)
OTHER = {
    "samples": 2 * LINES.samples,
    "first_range_m": 41.0,
    "range_step_m": 0.06,
    "tx_m": [0, 0, 1e-9],
    "rx_m": [0, 0, 1e-9],
    "carrier_hz": 1e5 + 1e-6,
    "sound_speed_m_s": 1500 + 1e-9,
    "rx_velocity_m_s": [1.0, 0, 0],
    "look_direction": [0, 1, 0],
    "georeference": PLACE,
    "bank_numbers": [0, 1],
    "sound_speed": clsas.SoundSpeed([0, 60], [1500, 1490], surface_z_m=1.0),
}
GRID = clsas.Grid.plane((0, 1, 3), (40, 41, 2))
OTHER_GRID = {
    "origin_m": [0, 0, 1e-9],
    "row_step_m": [0, 1.1, 0],
    "column_step_m": [0.4, 0, 0],
    "shape": (3, 2),
    "height_m": np.zeros((2, 3)),
    "georeference": PLACE,
}


@pytest.mark.parametrize("name", [each.name for each in dataclasses.fields(clsas.RangeLines)])
def test_every_field_of_lines_counts_unless_it_is_listed(name):
    other = dataclasses.replace(LINES, **{name: OTHER[name]})
    assert digest(other) != digest(LINES)
    left_out = name in NOT_IN_IMAGES[clsas.RangeLines]
    assert (lines_digest(other) == lines_digest(LINES)) == left_out


@pytest.mark.parametrize("name", [each.name for each in dataclasses.fields(clsas.Grid)])
def test_every_field_of_grids_counts_unless_it_is_listed(name):
    if name == "points_m":
        other = clsas.Grid.points(GRID.positions_m())
    else:
        other = dataclasses.replace(GRID, **{name: OTHER_GRID[name]})
    assert digest(other) != digest(GRID)
    left_out = name in NOT_IN_IMAGES[clsas.Grid]
    assert (grid_digest(other) == grid_digest(GRID)) == left_out


@pytest.mark.parametrize(
    ("profile", "changes"),
    [
        (clsas.SoundSpeed([0, 60], [1500, 1490]), {"depth_m": [0, 61]}),
        (clsas.SoundSpeed([0, 60], [1500, 1490]), {"speed_m_s": [1500, 1491]}),
        (clsas.SoundSpeed([0, 60], [1500, 1490]), {"surface_z_m": 1e-9}),
        (PLACE, {"heading_deg": 218.0}),
        (PLACE, {"latitude_deg": 60.3900000001}),  # which words would round
        (PLACE, {"vertical_datum": "EGM2008"}),
        (clsas.BeamWindow(10.0, along=[1.0, 0, 0]), {"along": [0, 1.0, 0]}),
        (clsas.BeamWindow(10.0), {"taper": 0.4}),
    ],
    ids=lambda each: next(iter(each)) if isinstance(each, dict) else type(each).__name__,
)
def test_every_field_of_a_field_counts(profile, changes):
    other = dataclasses.replace(profile, **changes)
    assert len({digest({"of": each}) for each in (profile, other)}) == 2


@pytest.mark.parametrize("of", [digest, lines_digest])
def test_a_field_that_is_added_counts(of):
    wider = dataclasses.make_dataclass(
        "Wider", [("absorption_db_km", float, 0.0)], bases=(clsas.RangeLines,), frozen=True
    )
    values = {each.name: getattr(LINES, each.name) for each in dataclasses.fields(LINES)}
    assert len({of(wider(**values, absorption_db_km=each)) for each in (0.0, 30.0)}) == 2
    assert of(wider(**values)) == of(wider(**values))


@pytest.mark.parametrize(
    "values",
    [
        (np.zeros(4), np.zeros((2, 2)), np.zeros(4, np.float32), np.zeros(8, np.float32)),
        ([[1], [2]], [[1, 2]], [1, [2]], [1, 2]),
        (0, 0.0, -0.0, None, False, "0", "", []),
        (np.nan, np.inf, None),
        (b"ab", b"ac", ["a", "b"]),
        ({"a": 1, "b": None}, {"a": 1}, {"a": 1, "c": None}),
        (Path("a/b"), Path("a/c")),
    ],
)
def test_different_values_have_different_digests(values):
    assert len({digest(each) for each in values}) == len(values)


def test_equal_values_have_equal_digests():
    array = np.arange(6.0).reshape(2, 3)
    assert digest(array) == digest(array.T.copy().T)
    assert digest((np.int64(3), np.float64(0.5))) == digest([3, 0.5])
    assert digest({"a": 1, "b": 2}) == digest({"b": 2, "a": 1})


@pytest.mark.parametrize("value", [{1, 2}, object(), np.array([object()]), clsas.RangeLines])
def test_what_has_no_digest_is_refused(value):
    with pytest.raises(TypeError, match="a digest cannot cover"):
        digest([value])


def test_a_record_is_intact_until_it_is_changed():
    record = json.loads(json.dumps(with_digest({"numbers": {"snr_db": 12.5}, "files": ["a"]})))
    assert is_intact(record)
    assert with_digest(record) == record
    for change in ({"numbers": {"snr_db": 12.25}}, {"more": None}, {"digest": "0" * 16}):
        assert not is_intact(record | change)
    assert not is_intact({name: record[name] for name in ("numbers", "digest")})
    assert not any(map(is_intact, ({"numbers": 1}, [], None, "digest")))
