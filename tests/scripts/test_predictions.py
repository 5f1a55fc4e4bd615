import re

import pytest
from studies import predictions

from clsas.engine.data.grid import Grid
from clsas.engine.device.device import open_device
from clsas.engine.factorized import measured_costs as costs
from clsas.engine.imaging import plan
from clsas.selftest import cases
from clsas.selftest.cases import Case


@pytest.fixture
def small(monkeypatch):
    """One small case of each kind."""
    case = Case(200, 8.25e-3, 1e6, 100e3, (-0.5, 0.5), (40.0, 41.0), 128)
    monkeypatch.setattr(cases, "EXACT_CASES", {"bp-small": case})
    monkeypatch.setattr(cases, "FACTORIZED_CASES", {"ffbp-small": case})
    return case


@pytest.mark.watches("scripts/studies", "scripts/bench")
def test_every_request_has_a_row(small):
    device = open_device()
    rows = list(predictions.rows(device, repeats=1))
    assert [(row[0], row[1]) for row in rows] == [
        ("bp-small", "-50"), ("bp-small", "-80"), ("ffbp-small", "-50"),
    ]  # fmt: skip
    assert all(len(row) == len(predictions.COLUMNS) for row in rows)
    for row in rows:
        measured_s = float(row[4].split()[0])
        assert float(row[5]) == pytest.approx(float(row[3]) / measured_s, rel=0.2)
    lines, grid = small.lines(), small.grid
    assert isinstance(grid, Grid)
    planned = plan(lines, grid, tolerance_db=-50)
    assert float(rows[2][3]) == pytest.approx(planned.predicted_seconds, abs=1e-3)
    assert [row[0] for row in predictions.rows(device, ["ffbp-small"], 1)] == ["ffbp-small"]


def test_the_title_tells_device_and_costs():
    device = open_device()
    day = costs.load(device).measured[:10]
    driver = re.escape(device.info.driver)
    words = rf"{driver}, \d+ compute units: default costs, scaled to this device by .* on {day}"
    assert re.search(words, predictions.title(device))


def test_all_cases_of_the_benchmarks_are_asked_for():
    assert {case for case, _ in predictions.requests()} == {
        *cases.EXACT_CASES,
        *cases.FACTORIZED_CASES,
    }
