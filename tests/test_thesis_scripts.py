"""Every script of scripts/thesis runs, on a scene of 0.3 m x 0.3 m."""

import csv
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("matplotlib")

FOLDER = Path(__file__).parents[1] / "scripts" / "thesis"
SCRIPTS = sorted(path.stem for path in FOLDER.glob("[fs]*_*.py"))
COLUMNS = {
    "figure_18": {"stages", "seconds"},
    "figure_19": {"stages", "[45] mm", "measured mm"},
    "figure_20": {"stages", "log10", "seconds"},
    "figure_37": {"stages", "[45]", "usable"},
    "figures_21_36": {"[45]", "azimuth mm", "PSLR dB", "ISLR dB"},
    "section_4_2": {"total", "backprojection"},
    "section_5_2_1": {"[45]", "measured", "seconds"},
}


def test_every_script_is_known():
    assert sorted(COLUMNS) == SCRIPTS


@pytest.mark.parametrize("script", SCRIPTS)
def test_script_runs(script, tmp_path):
    options = ["--out", tmp_path, "--pixels", "64"]
    if {"seconds"} <= COLUMNS[script]:
        options += ["--repeats", "1"]
    done = subprocess.run(
        [sys.executable, FOLDER / f"{script}.py", *options], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    with open(tmp_path / f"{script}.csv") as file:
        rows = list(csv.DictReader(file))
    assert rows
    assert COLUMNS[script] <= set(rows[0])
    pictures = list(tmp_path.glob("*.png"))
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in pictures)
    assert pictures
