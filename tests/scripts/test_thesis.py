"""Every script in scripts/thesis runs on a small scene."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import stored_tables

import clsas

pytest.importorskip("matplotlib")

FOLDER = Path(__file__).parents[2] / "scripts" / "thesis"
SCRIPTS = sorted(path.stem for path in FOLDER.glob("[fs]*_*.py"))
COLUMNS = {
    "figure_18": {"stages", "seconds"},
    "figure_19": {"stages", "eq. 45 mm", "measured mm"},
    "figure_20": {"stages", "log10", "seconds"},
    "figure_37": {"stages", "largest usable error, eq. 45"},
    "figures_21_36": {"eq. 45", "azimuth mm", "PSLR dB", "ISLR dB"},
    "figures_39_45": {"eq. 45", "seconds", "error dB", "shadow dB", "mast"},
    "section_4_2": {"form", "total", "backprojection"},
    "section_4_3_memory": {"image MiB", "exact over image", "interpolated over image"},
    "section_4_3": {"eq. 45", "measured", "loss dB"},
    "section_5_2_1": {"eq. 45", "measured", "seconds"},
    "section_5_2_1_order": {"order", "eq. 45", "million operations", "seconds"},
    "section_5_2_1_wavenumber": {"method", "seconds", "error dB"},
    "section_7_1_ranges": {"far/near", "divided into", "seconds", "error dB"},
    "section_7_1_study": {"taps in range", "taps along the aperture", "2 stages, s", "error dB"},
    "section_7_1_taps": {"method", "error dB", "-20 dB, s"},
    "section_7_1": {"per pixel", "speed-up", "error dB", "chosen"},
}
TABLES_ONLY = {
    "section_4_3_memory", "section_5_2_1_order", "section_5_2_1_wavenumber", "section_7_1_ranges",
    "section_7_1_study",
}  # fmt: skip
UNTIMED = {"figure_19", "figure_37", "figures_21_36", "section_4_3", "section_4_3_memory"}


def test_every_script_is_known():
    assert sorted(COLUMNS) == SCRIPTS


@pytest.mark.watches("scripts/thesis")
@pytest.mark.parametrize("script", SCRIPTS)
def test_script_runs(script, tmp_path):
    # 16 pixels remain along each side after the divisions of the orders.
    pixels = "256" if script == "section_5_2_1_order" else "64"
    options = ["--out", tmp_path, "--pixels", pixels]
    if script == "figures_39_45":
        clsas.save(tmp_path / "lines.h5", _points_beside_a_track())
        options += ["--lines", tmp_path / "lines.h5"]
    if script == "section_7_1":
        options += ["--sweep", "receivers per ping"]
    if script == "section_7_1_taps":
        options += ["--system", "thesis, wide beam"]
    if script not in UNTIMED:
        options += ["--repeats", "1"]
    done = subprocess.run(
        [sys.executable, FOLDER / f"{script}.py", *options], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    table = stored_tables.read(tmp_path / f"{script}.csv")
    assert table.rows
    assert COLUMNS[script] <= set(table.header)
    assert table.origin["clsas"] == clsas.__version__
    assert table.origin["command"].startswith(f"scripts/thesis/{script}.py --out")
    if script == "figures_39_45":
        assert [row[0] for row in stored_tables.read(tmp_path / "figure_45.csv").rows] == [
            "1", "4", "16",
        ]  # fmt: skip
    pictures = list(tmp_path.glob("*.png"))
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in pictures)
    assert bool(pictures) == (script not in TABLES_ONLY)


def _points_beside_a_track():
    """Return lines of the wreck's system from half its track, since the wreck takes minutes."""
    x_m = np.arange(200) * 0.2 - 20
    track_m = np.stack([x_m, 0.05 * np.sin(x_m), 20 + 0 * x_m], axis=1)
    random = np.random.default_rng(0)
    places_m = random.uniform([-30, 38, 0], [30, 90, 0], (100, 3))
    points = clsas.PointTargets(places_m, random.normal(size=(100, 2)) @ [1, 1j])
    band = {"carrier_hz": 125e3, "bandwidth_hz": 15e3, "window": "hamming"}
    return clsas.simulate_lines(track_m, track_m, points, **band)
