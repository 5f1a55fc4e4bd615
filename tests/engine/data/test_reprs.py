"""Reprs of public classes are short, have units, and no whole arrays; reports have tables."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import clsas
from clsas.engine.data import reprs
from clsas.engine.data.reprs import Report, Table
from clsas.measures.assess import KEYS

PULSE = clsas.Pulse(1e6, 1e5, 1e-3)
SONAR = clsas.Sonar.thesis_wide_beam()
TRACK = clsas.Track.straight((1e6, 2e6, 0), (2, 0, 0), 500, 0.25)
PLANE = clsas.Grid.plane(x=(1e6 - 0.5, 1e6 + 0.5, 401), y=(40, 42, 201))
POINTS = clsas.Grid.points(np.arange(36000.0).reshape(20, 20, 30, 3))
SAMPLES = np.ones((500, 200), np.complex64)
LINES = clsas.RangeLines(SAMPLES, 39.0, 0.00375, TRACK.positions_m, TRACK.positions_m, 1e6, 1500.0)
AT_M = TRACK.positions_m - [0, 2e6, 0]
BESIDE = clsas.RangeLines(SAMPLES, 39.9, 0.00375, AT_M, AT_M, 1e6, 1500.0)  # PLANE


def pixels(grid):
    return np.ones(grid.shape, np.complex64)


@pytest.mark.parametrize(
    ("obj", "text"),
    [
        (PULSE, "Pulse(carrier 1 MHz, bandwidth 100 kHz, duration 1 ms, code 'up', taper 0)"),
        (
            clsas.Pulse.phase_code(1e5, 1e-3, (1, -1) * 50),
            "Pulse(carrier 100 kHz, bandwidth 100 kHz, duration 1 ms, code [100 values], taper 0)",
        ),
        (
            SONAR,
            "Sonar(64 receivers over 1.0395 m, carrier 1 MHz, bandwidth 100 kHz, elements of "
            "15 mm)",
        ),
        (TRACK, "Track(500 pings in 124.8 s, x 1000000 to 1000249.5 m, y 2000000 m, z 0 m)"),
        (
            clsas.channels(SONAR, clsas.Track.straight((0, 0, 0), (2, 0, 0), 10, 0.264)),
            "Channels(640 channels, receivers at x -0.51975 to 5.27175 m, y 0 m, z 0 m)",
        ),
        (
            clsas.Pointing.scan(np.linspace(-1, 1, 900)),
            "Pointing(squint [900 values], depression 0 rad)",
        ),
        (
            clsas.Pointing.spot((1, 2, 3)),
            "Pointing(squint (0) rad, depression 0 rad, spot (1, 2, 3) m)",
        ),
        (
            clsas.BeamWindow(5, "hann", along=np.ones((900, 3))),
            "BeamWindow(width 5 deg, shape 'hann', squint 0 deg, taper 0.5, along float64 "
            "[900, 3], normalise False)",
        ),
        (
            PLANE,
            "Grid(201 x 401 pixels, x 999999.5 to 1000000.5 m, y 40 to 42 m, z 0 m)",
        ),
        (
            PLANE.with_height(np.linspace(-1, 3, PLANE.size).reshape(PLANE.shape)),
            "Grid(201 x 401 pixels, x 999999.5 to 1000000.5 m, y 40 to 42 m, z -1 to 3 m)",
        ),
        (
            clsas.Grid.oriented((0, 0, 0), (0, 0.3, 0.4), (0.2, 0.1, 0), (11, 21)),
            "Grid(11 x 21 pixels, x 0 to 4 m, y 0 to 5 m, z 0 to 4 m)",
        ),
        (
            POINTS,
            "Grid(20 x 20 x 30 pixels, x 0 to 35997 m, y 1 to 35998 m, z 2 to 35999 m)",
        ),
        (
            clsas.Image(pixels(PLANE), PLANE),
            "Image(201 x 401 complex pixels, x 999999.5 to 1000000.5 m, y 40 to 42 m, z 0 m)",
        ),
        (
            LINES,
            "RangeLines(500 channels of 200 samples, range 39 to 39.74625 m in steps of 3.75 mm, "
            "carrier 1 MHz)",
        ),
        (
            clsas.Echoes(SAMPLES, 0, 2e5, 1e6, (0, 0, 0), (0, 0, 0), 1500, PULSE),
            "Echoes(500 channels of 200 samples at 200 kHz, carrier 1 MHz)",
        ),
        (
            clsas.PointTargets(np.arange(3000.0).reshape(1000, 3)),
            "PointTargets(1000 points, x 0 to 2997 m, y 1 to 2998 m, z 2 to 2999 m)",
        ),
        (
            clsas.Seabed((0, 10), (30, 40), np.linspace(0, 1, 101 * 51).reshape(51, 101)),
            "Seabed(x 0 to 10 m, y 30 to 40 m, z 0 to 1 m, steps of 0.1 m x 0.2 m, 600 "
            "scatterers per m2)",
        ),
        (clsas.Store(Path("/data/image.zarr")), "Store('/data/image.zarr')"),
        (
            clsas.mosaic(BESIDE, PLANE, patches=(2, 4)),
            "Mosaic(2 x 4 patches of 101 x 101 pixels, 0 of 8 finished, "
            "x 999999.5 to 1000000.5 m, y 40 to 42 m, z 0 m)",
        ),
    ],
    ids=lambda value: None if isinstance(value, str) else type(value).__name__,
)
def test_public_objects_say_what_they_are(obj, text):
    assert repr(obj) == text


def test_plans_are_short_however_many_filters_they_have():
    grid = clsas.Grid.plane(x=(-1, 1, 1001), y=(40, 42, 1001))
    places = np.stack([np.linspace(-2, 2, 500), np.zeros(500), np.zeros(500)], -1)
    lines = clsas.RangeLines(np.ones((500, 900), complex), 39.0, 0.005, places, places, 1e6, 1500.0)
    plans = [
        clsas.plan(lines, grid, tolerance_db=-30),
        clsas.plan(lines, grid, stages=[(2, 2)] * 3),
        clsas.plan(lines, clsas.Grid.plane((0, 0.1, 3), (40, 40.1, 3)), tolerance_db=-30),
    ]
    assert [plan.is_exact for plan in plans] == [False, False, True]
    for plan, words in zip(plans, ("tolerance -30 dB", "stages as given", "exact"), strict=True):
        text = repr(plan)
        assert len(text) < 250
        for each in (words, "predicted error ", "predicted time", "iB of device memory"):
            assert each in text
        page = plan._repr_html_()
        assert f"{plan.predicted_error_db:.1f} dB" in page
        assert page.count("<tr>") == (0 if plan.is_exact else 1 + len(plan.stages))
        lines_of_text = plan.describe().splitlines()
        for cell in lines_of_text[-2].split("  "):
            assert cell.strip() in page


@pytest.mark.slow
def test_everything_that_comes_with_a_result_is_short():
    grid = clsas.Grid.plane(x=(-0.1, 0.1, 101), y=(42.4, 42.6, 101))
    track = clsas.Track.straight((-2.376, 0, 0), (2, 0, 0), 10, 0.264)
    targets = clsas.PointTargets([[0.0, 42.5, 0.0]])
    lines = clsas.compress(clsas.simulate(SONAR, track, targets), window="hamming")
    assessment = clsas.assess(lines, grid)
    tradeoff = clsas.tradeoff(lines, grid, tolerances_db=(-30,), stages=(((2, 2),),), repeats=1)
    patch = next(iter(clsas.mosaic(lines, grid)))
    image = clsas.backproject(lines, grid)
    point = clsas.measure_point(image, (0, 42.5))
    plan = clsas.plan(lines, grid, tolerance_db=-20)
    for obj, words in (
        (assessment, f"tolerance -50 dB, {len(KEYS)} effects, needed and not modelled: none"),
        (assessment.effects[0], "name 'motion during flight'"),
        (tradeoff, "3 images of 101 x 101 pixels from 640 channels"),
        (patch, "row 0, column 0, 101 x 101 pixels, x -0.1 to 0.1 m"),
        (patch.record, "predicted error -50 dB"),
        (point, "x 0 m, y 42.5 m, z 0 m, amplitude "),
        (point.azimuth, "offset float64 ["),
        (clsas.list_devices()[0], "index 0"),
        (plan, "tolerance -20 dB"),
    ):
        text = repr(obj)
        assert words in text
        assert "array(" not in text
        assert len(text) < 400
    for obj in (assessment, tradeoff):
        assert obj._repr_html_().startswith("<div>")
        assert "<table>" in obj._repr_html_()


def test_numbers_have_prefixes_that_suit_them():
    assert reprs.quantity(0.015, "m") == "15 mm"
    assert reprs.quantity(-2.5e-5, "m") == "-25 µm"
    assert reprs.quantity(0.5, "m") == "0.5 m"
    assert reprs.quantity(0, "Hz") == "0 Hz"
    assert reprs.quantity(1.25e9, "Hz") == "1.25 GHz"
    assert reprs.quantity(3 << 29, "bytes") == "1.5 GiB"
    assert reprs.quantity(205_517, "bytes") == "200.7 KiB"
    assert reprs.quantity(1023, "bytes") == "1023 bytes"
    assert reprs.quantity(float("-inf"), "dB") == "-inf dB"
    assert reprs.span(-0.0, 1 / 3, "m") == "0 to 0.333333 m"


def test_private_and_missing_fields_are_left_out():
    @dataclass
    class Some:
        rate_hz: float
        names: dict
        text: str
        missing: float | None = None
        _kept: int = 3

        __repr__ = reprs.of_fields

    text = repr(Some(2e3, {"a": 1}, "x" * 500))
    assert text.startswith("Some(rate 2 kHz, names [1 entries], text 'xxx")
    assert len(text) < 200


# Reports

NUMBERS = Table(("", "time (s)"), [("exact", "1.5"), ("-40 dB", "0.25")])

LINE = '<p style="white-space: pre-wrap">'


def test_numbers_stand_under_each_other():
    assert NUMBERS.lines() == ["        time (s)", " exact       1.5", "-40 dB      0.25"]


def test_words_begin_under_each_other():
    words = Table(("effect", "needed"), [("beam", "yes"), ("relief of grid", "-")], align="left")
    assert words.lines() == ["effect          needed", "beam            yes", "relief of grid  -"]


def test_a_report_is_one_text_and_one_page():
    report = Report(["Plan: < 1 s", NUMBERS, "Default  costs."])
    assert report.text().splitlines() == ["Plan: < 1 s", *NUMBERS.lines(), "Default  costs."]
    page = report.html()
    assert page.startswith(f"<div>{LINE}Plan: &lt; 1 s</p><table>")
    assert page.count("<tr>") == 3
    assert '<td style="text-align: right">0.25</td>' in page
    assert page.endswith(f"{LINE}Default  costs.</p></div>")


def test_a_report_may_have_no_table():
    assert Report(["Exact."]).text() == "Exact."
    assert Report(["Exact."]).html() == f"<div>{LINE}Exact.</p></div>"
