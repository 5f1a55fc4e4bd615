"""A small mosaic to attack: 48 patches of a swaying track, which take some seconds to form.

It is so high that it has two levels. The first is written with each patch. The second mixes
patches, since these are 18 columns wide.
"""

from __future__ import annotations

import sys
from pathlib import Path

SCENE = """
[sonar]
preset = "edgetech"

[track]
start_m = [-12.0, 0.0, 10.0]
velocity_m_s = [2.0, 0.0, 0.0]
pings = 60
ping_interval_s = 0.2

[track.sway]
amplitude_m = 0.1
period_s = 10.0

[[targets]]
position_m = [0.0, 60.0, 0.0]

[[targets]]
position_m = [1.5, 57.0, 0.0]
amplitude = 0.5

[grid]
x = { start_m = -2, stop_m = 2, count = 140 }
y = { start_m = 56, stop_m = 61, count = 2052 }

[image]
tolerance_db = -40

[image.beam]
width_deg = 6
shape = "hann"

[mosaic]
patches = [6, 8]
memory_mib = 66  # for about four patches at a time
"""

PATCHES = 48


def write_scene(folder: Path) -> Path:
    """Write the scene file, and return its path."""
    path = folder / "scene.toml"
    path.write_text(SCENE)
    return path


def command(scene: Path, store: Path, workers: int = 0) -> list[str]:
    """Return the command that forms the mosaic, in one process or with worker processes."""
    lines = next(iter(scene.parent.glob("*.lines.h5")), None)
    parts = [sys.executable, "-m", "clsas", "mosaic", scene, "-o", store]
    parts += ["--lines", lines] if lines else []
    parts += ["--workers", workers] if workers else []
    return list(map(str, parts))
