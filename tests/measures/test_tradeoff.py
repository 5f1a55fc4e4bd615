import csv
import dataclasses
import sys

import numpy as np
import pytest

import clsas
from clsas.engine.data.grid import Grid
from clsas.measures.tradeoff import STAGES, Response, Row, Tradeoff, summary

# Far enough apart that their side lobes do not meet; the first one is the strongest.
TARGETS = clsas.PointTargets([[0.02, 40.3, 0], [-0.25, 40.55, 0]], [1.0, 0.6])
GRID = Grid.plane((-0.3, 0.3, 96), (40.0, 40.6, 128))


def row(label, seconds, error_db, **others):
    method = others.pop("method", "tolerance")
    return Row(label, method, "a plan", 0.5, seconds, 2 * seconds, error_db, error_db - 1, **others)


POINT = Response(0.01, -13.2, -10.0)
WIDER = Response(0.011, -12.0, -9.0)
MADE = Tradeoff(
    "abacus",
    "1.0",
    640,
    (96, 128),
    3,
    (
        row("-20 dB", 0.1, -25.0, azimuth=WIDER, range=POINT, dark_error_db=-3.0),
        row("-30 dB", 0.3, -35.0),
        row("-50 dB", 0.2, -52.0),
        row("2 of 2x2", 0.4, -5.0, method="stages"),
        row("exact", 1.0, -70.0, method="exact", azimuth=POINT, range=POINT),
    ),
)


@pytest.fixture(scope="module")
def lines():
    along = np.zeros((200, 3))
    along[:, 0] = (np.arange(200) - 99.5) * 8.25e-3
    return clsas.simulate_lines(along, along, TARGETS, carrier_hz=1e6, bandwidth_hz=1e5)


@pytest.mark.slow
def test_every_method_is_measured_against_the_exact_image(lines):
    seen = []
    measured = clsas.tradeoff(
        lines, GRID, tolerances_db=(-30, -50), stages=[[(2, 2), (4, 2)]],
        repeats=2, progress=lambda done, total: seen.append((done, total)),
    )  # fmt: skip
    labels = [row.label for row in measured.rows]
    assert labels == ["-30 dB", "-50 dB", "2x2,4x2", "exact"]
    assert (measured.channels, measured.pixels, measured.repeats) == (200, (128, 96), 2)
    assert measured.device in [info.label for info in clsas.list_devices()]
    assert seen == [(done, 13) for done in range(1, 14)]  # a reference, and 3 runs of 4 methods
    loose, tight, summed, exact = measured.rows
    assert measured.exact is exact
    # Two points in a dark scene: errors are spread over levels far above the darkest tenth.
    assert measured.dark_level_db < -30
    assert all(row.dark_error_db > row.error_db for row in measured.rows)
    assert tight.error_db < -48
    assert loose.error_db < -28
    assert exact.error_db < -60
    assert summed.error_db > tight.error_db
    assert all(row.seconds > 0 and row.predicted_seconds > 0 for row in measured.rows)
    for mine, exacts in ((tight.azimuth, exact.azimuth), (tight.range, exact.range)):
        assert mine.resolution_m == pytest.approx(exacts.resolution_m, rel=0.02)
        assert mine.pslr_db == pytest.approx(exacts.pslr_db, abs=0.3)
    assert exact.azimuth.resolution_m == pytest.approx(0.443 * 1.5e-3 * 40.3 / 1.65, rel=0.03)


@pytest.mark.exhaustive
def test_a_study_sweeps_the_choices_of_the_planner(lines):
    measured = clsas.tradeoff(lines, GRID, tolerances_db=(-40,), stages=(), repeats=1, study=True)
    studied = [row for row in measured.rows if row.method == "study"]
    assert measured.rows[0].method == "tolerance"
    labels = {row.label for row in studied}
    assert len(labels) == len(studied) > 9
    assert "-40 dB, 8+6 taps, 2 stages" in labels
    assert "-40 dB, 4+4 taps, 1 stage" in labels
    assert all(row.error_db <= -39 for row in studied)
    assert any("8 taps in range" in row.plan and "6 taps along" in row.plan for row in studied)


@pytest.mark.slow
def test_a_beam_counts_in_every_image(lines):
    beam = clsas.BeamWindow(1.0, "hann")
    narrow = clsas.tradeoff(lines, GRID, tolerances_db=(-40,), stages=(), beam=beam, repeats=1)
    assert [row.label for row in narrow.rows] == ["-40 dB", "exact"]
    assert narrow.rows[0].error_db < -38
    wide = clsas.tradeoff(lines, GRID, tolerances_db=(), stages=(), repeats=1)
    (exact,) = wide.rows
    assert narrow.exact.azimuth.resolution_m > 1.5 * exact.azimuth.resolution_m


@pytest.mark.slow
def test_an_image_on_points_has_no_response(lines):
    grid = Grid.points(GRID.positions_m(slice(0, 2), slice(0, 3)).reshape(-1, 3))
    measured = clsas.tradeoff(lines, grid, tolerances_db=(-40,), repeats=1)
    # Points are not a plane: the thesis's method is left out, and the plan is exact.
    assert [row.label for row in measured.rows] == ["-40 dB", "exact"]
    assert measured.rows[0].plan == "plain backprojection"
    assert all(row.azimuth is row.range is None for row in measured.rows)
    assert measured.describe().splitlines()[1].split()[-4:] == ["-"] * 4


@pytest.mark.slow
def test_default_stages_leave_a_line_and_a_pixel(lines):
    small = Grid.plane((-0.02, 0.06, 9), (40.2, 40.4, 30))
    measured = clsas.tradeoff(lines, small, tolerances_db=(), repeats=1)
    assert [row.label for row in measured.rows] == [f"{n} of 2x2" for n in (1, 2, 3)] + ["exact"]
    assert max(len(stages) for stages in STAGES) == 5


@pytest.mark.parametrize(
    ("error", "message", "given"),
    [
        (TypeError, "lines must be of type RangeLines", {"lines": 3}),
        (TypeError, "grid must be of type Grid", {"grid": 3}),
        (ValueError, "repeats must be at least 1, got 0", {"repeats": 0}),
        (ValueError, "tolerances_db must be", {"tolerances_db": (-50, -200)}),
        (ValueError, "stages must leave a line and a pixel", {"stages": [[(300, 2)]]}),
        (TypeError, "stages must be a sequence", {"stages": [2]}),
        (TypeError, "stages must be a sequence", {"stages": 3}),
        (TypeError, "beam must be of type BeamWindow", {"beam": 3}),
        (TypeError, "study must be of type bool", {"study": "x"}),
        (TypeError, "tolerances_db must be a sequence", {"tolerances_db": None}),
        (TypeError, "progress must be a function", {"progress": 3}),
    ],
)
def test_bad_input_is_refused_before_any_image(lines, monkeypatch, error, message, given):
    for imager in ("factorize", "form_exactly"):
        monkeypatch.setattr(sys.modules["clsas.measures.tradeoff"], imager, pytest.fail)
    with pytest.raises(error, match=message):
        clsas.tradeoff(**{"lines": lines, "grid": GRID} | given)


def test_a_grid_without_echoes_is_refused(lines):
    silent = dataclasses.replace(lines, samples=np.zeros_like(lines.samples))
    with pytest.raises(ValueError, match="grid must lie where the lines have echoes"):
        clsas.tradeoff(silent, GRID, tolerances_db=[-30], stages=[], repeats=1)


def test_the_front_holds_rows_that_no_other_beats():
    assert [row.label for row in MADE.front] == ["-20 dB", "-50 dB", "exact"]


def test_table():
    table = [line.split("  ") for line in MADE.describe().splitlines()]
    first = [cell.strip() for cell in table[1] if cell.strip()]
    assert first == [
        *("-20 dB", "0.1", "0.2", "10", "-25.0", "-26.0", "-3.0"),
        *("1.100", "1.000", "-12.0", "-13.2"),
    ]
    assert len(table) == 1 + len(MADE.rows)
    names = [cell.strip() for cell in table[0] if cell.strip()]
    assert len(set(names)) == len(names)
    assert len({len(line) for line in MADE.describe().splitlines()}) == 1


def test_csv(tmp_path):
    MADE.save_csv(tmp_path / "t.csv")
    with open(tmp_path / "t.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["label"] for row in rows] == [row.label for row in MADE.rows]
    assert float(rows[0]["time_s"]) == 0.1
    assert float(rows[0]["predicted_time_s"]) == 0.2
    assert float(rows[0]["dark_error_db"]) == -3.0
    assert float(rows[0]["azimuth_resolution_m"]) == 0.011
    assert rows[1]["azimuth_resolution_m"] == ""
    assert rows[-1]["method"] == "exact"
    with pytest.raises(FileNotFoundError):
        MADE.save_csv(tmp_path / "none" / "t.csv")


@pytest.mark.slow
def test_picture(tmp_path):
    pytest.importorskip("matplotlib")
    from clsas import plot

    figure = plot.tradeoff(MADE, title="small")
    (axes,) = figure.axes
    assert axes.get_yscale() == "log"
    assert "(dB)" in axes.get_xlabel()
    assert "(s)" in axes.get_ylabel()
    assert "abacus" in axes.get_title()
    front = axes.get_lines()[0]
    np.testing.assert_array_equal(front.get_xydata(), [[-25, 0.1], [-52, 0.2], [-70, 1]])
    hollow = [line for line in axes.get_lines() if line.get_fillstyle() == "none"]
    drawn = {tuple(point) for line in hollow for point in line.get_xydata()}
    assert drawn == {(row.predicted_error_db, row.predicted_seconds) for row in MADE.rows}
    legend = [text.get_text() for text in figure.legends[0].get_texts()]
    assert len(legend) == len(set(legend)) == 5
    MADE.save_png(tmp_path / "t.png")
    assert (tmp_path / "t.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(TypeError, match="measured must be of type Tradeoff"):
        plot.tradeoff(3)


def test_without_matplotlib_the_message_says_how_to_get_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ImportError, match=r"pip install 'matplotlib>=3\.10'"):
        MADE.save_png(tmp_path / "t.png")
    assert not any(tmp_path.iterdir())


def test_summary_of_a_plan(lines):
    text = summary(clsas.plan(lines, GRID, stages=[(2, 2), (4, 2)]))
    assert text.endswith("; 2 taps in range, 2 at the end, sums of 2, 4 neighbours")
    assert text.startswith("64x48, 32x24; ")
    assert summary(clsas.plan(lines, GRID, stages=[])) == "plain backprojection"
