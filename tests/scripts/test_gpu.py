"""The report of scripts/gpu, on any device."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from clsas.engine.device.device import open_device

ROOT = Path(__file__).parents[2]


def run(*arguments, **variables):
    return subprocess.run(
        [sys.executable, ROOT / "scripts" / "gpu_report.py", *arguments],
        text=True, capture_output=True, env=os.environ | {"PYTHONPATH": str(ROOT)} | variables,
    )  # fmt: skip


@pytest.mark.watches("scripts/gpu", "scripts/gpu_report.py")
@pytest.mark.parametrize("selection", [(), ("--quick",)])
def test_a_report_holds_what_a_part_printed(tmp_path, selection):
    report = tmp_path / "report.md"
    info = open_device().info
    done = run("--device", info.label, "--only", "Devices", "--out", report, *selection)
    assert done.returncode == 0, done.stderr
    text = report.read_text()
    assert f"# clsas on {info.name}" in text
    assert f"Driver {info.driver} of {info.platform}" in text
    assert "`python -m clsas devices`: exit code 0 after" in text
    assert info.label in text.split("## Devices")[1]
    assert text.endswith("All parts succeeded.\n")


@pytest.mark.watches("scripts/gpu", "scripts/gpu_report.py")
def test_a_report_needs_no_git(tmp_path):
    report = tmp_path / "report.md"
    done = run("--device", "0", "--only", "Devices", "--out", report, PATH=str(tmp_path))
    assert done.returncode == 0, done.stderr
    assert "commit unknown (git is not installed)" in report.read_text()


@pytest.mark.slow
def test_a_device_that_is_missing_is_named_and_nothing_is_written(tmp_path):
    report = tmp_path / "report.md"
    done = run("--device", "abacus", "--out", report)
    assert done.returncode == 1
    assert "abacus" in done.stderr
    assert "Traceback" not in done.stderr
    assert not report.exists()
