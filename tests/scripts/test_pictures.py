"""The command that draws the pictures of the documentation."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("matplotlib")

ROOT = Path(__file__).parents[2]


@pytest.mark.watches("scripts/pictures", "scripts/pages")
def test_a_picture_of_the_documentation_is_drawn(tmp_path):
    command = [sys.executable, ROOT / "scripts" / "pictures", "demo", "--out", tmp_path]
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    done = subprocess.run(
        command, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True, check=True
    )
    picture = tmp_path / "demo.png"
    assert done.stdout.startswith(str(picture))
    assert "too large" not in done.stdout
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert (ROOT / "docs" / "images" / picture.name).is_file()
