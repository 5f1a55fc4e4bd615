"""The wreck, recorded from an unknown track, and its image after micronavigation.

The scene is a part of that of `clsas.selftest.wreck`: 18 m of the wreck's 25 m along the track,
with its shadow, from 120 of 200 pings. The pings are half as far apart, so that four of the six
phase centres overlap. According to the navigation the track is straight.
"""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from clsas.engine.data.image import Image
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.system import Sonar
from clsas.engine.data.track import Track, channels
from clsas.engine.data.validate import ClsasWarning
from clsas.engine.imaging import factorize
from clsas.engine.signal.compression import compress
from clsas.files.formats import load
from clsas.files.scene_files import parse_scene
from clsas.measures.quality import measure_point
from clsas.processing.chain import process
from clsas.selftest import wreck
from clsas.simulation.scenes import PointTargets
from clsas.simulation.seabeds import wreck as seabed
from clsas.simulation.simulator import simulate

POINT_M = (-6.0, 54.0, 0.0)
"""Position of a reflector on the sand in front of the wreck."""
RANGE_M = (54.0, 78.0)
"""Nearest and farthest range for micronavigation, over sand and wreck."""

_PINGS, _ADVANCE_M, _HEIGHT_M = 120, 0.2, 20.0
_SWAY_M, _PERIOD = 0.2, 80.0  # pings: 16 m, the period of the sway in the scene of the wreck
_AMPLITUDE = 60.0  # of the reflector, 30 dB above the sand
_DENSITY_M2 = 400.0


SCENE = f"""
[grid]
x = {{ start_m = -9.0, stop_m = 9.0, count = 361 }}
y = {{ start_m = 50.0, stop_m = 74.0, count = 961 }}

[image]
tolerance_db = -40

[image.beam]
width_deg = 5.0
shape = "hann"

[process]
steps = ["inspect", "navigate", "image"]

[process.navigate]
range_m = [{RANGE_M[0]}, {RANGE_M[1]}]
seabed_z_m = 0.0
element_length_m = 0.2
sway_sd_m = 0.3
yaw_sd_deg = 3.0
surge_sd_m = 0.02
"""
"""Scene file for `clsas process`, as a user would write it."""


@dataclass(frozen=True, eq=False)
class Recording:
    """Lines of one passage, with two sets of positions.

    Attributes
    ----------
    true, given : RangeLines
        Lines with the positions of the true track, and with those of the navigation.
    """

    true: RangeLines
    given: RangeLines


@dataclass(frozen=True, eq=False)
class Images:
    """Images of a recording.

    Attributes
    ----------
    true, given : Image
        With the true track, and with the positions of the navigation.
    processed : Image
        After `clsas process` with the `SCENE`.
    """

    true: Image
    given: Image
    processed: Image

    @classmethod
    def of(cls, recording: Recording, folder: Path, device: str | None = None) -> Images:
        """Return the images of a recording; `clsas process` writes its files into a folder."""
        scene = parse_scene(SCENE.encode(), name="wreck.toml", folder=folder)
        output = folder / "processed"
        processed = process(scene, lines=recording.given, output=output, device=device)
        tolerance_db, beam = scene.image["tolerance_db"], scene.image["beam"]
        grid = processed.image.grid
        true = factorize(recording.true, grid, tolerance_db, beam=beam, device=device)
        before = load(output / "before.h5")
        assert isinstance(before, Image)
        return cls(true, before, processed.image)


@dataclass(frozen=True)
class Measures:
    """Measures of an image of the wreck.

    Attributes
    ----------
    peak_db : float
        Level of the reflector.
    azimuth_m, range_m : float
        Widths of the reflector at -3 dB.
    contrast_db : float
        Power of lit sand over that of the wreck's shadow, dB.
    """

    peak_db: float
    azimuth_m: float
    range_m: float
    contrast_db: float

    @classmethod
    def of(cls, image: Image, shadow: wreck.Shadow) -> Measures:
        """Return the measures of an image; raise ValueError if the reflector has no peak."""
        point = measure_point(image, near=POINT_M[:2], extent_m=1.0)
        return cls(
            level_db(image),
            point.azimuth.resolution_m,
            point.range.resolution_m,
            shadow.contrast_db(image, POINT_M[:2]),
        )


def level_db(image: Image) -> float:
    """Return the largest level within 0.5 m of the reflector, dB."""
    x_m, y_m = image.grid.axes_m
    near = np.ix_(np.abs(y_m - POINT_M[1]) < 0.5, np.abs(x_m - POINT_M[0]) < 0.5)
    return 20 * float(np.log10(np.abs(image.pixels[near]).max()))


def recorded(progress: Callable[[int, int], None] | None = None) -> Recording:
    """Return the simulated recording, which takes about a minute on two cores."""
    sonar = Sonar.edgetech()
    course = (-_ADVANCE_M * (_PINGS - 1) / 2, 0.0, _HEIGHT_M), (_ADVANCE_M, 0, 0), _PINGS, 1.0
    turn = 2 * np.pi / _PERIOD
    true = Track.straight(
        *course,
        sway_m=lambda ping: _SWAY_M * np.sin(turn * ping),
        yaw_rad=lambda ping: _SWAY_M * turn / _ADVANCE_M * np.cos(turn * ping),
    )
    targets = (
        seabed((-17.0, 17.0), (47.0, 77.0), density_m2=_DENSITY_M2),
        PointTargets([POINT_M], [_AMPLITUDE]),
    )
    lines = compress(simulate(sonar, true, targets, progress=progress), window="hamming")
    given = channels(sonar, Track.straight(*course))
    return Recording(lines, replace(lines, tx_m=given.tx_m, rx_m=given.rx_m))


COLUMNS = (
    "image",
    "reflector on the sand, dB",
    "width along track, cm",
    "width in range, cm",
    "sand over shadow, dB",
)


def rows(device: str | None = None) -> Iterator[list[str]]:
    """Yield the measures of every image, with the reflector relative to the true track's image."""
    shadow = wreck.Shadow(wreck.scene())
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", ClsasWarning)
        images = Images.of(recorded(), Path(folder), device)
    level_of_true_db = level_db(images.true)
    for name, image in (
        ("with the true track", images.true),
        ("as recorded", images.given),
        ("after `navigate`", images.processed),
    ):
        try:
            found = Measures.of(image, shadow)
            widths = [f"{100 * each:.1f}" for each in (found.azimuth_m, found.range_m)]
        except ValueError:
            widths = ["no peak"] * 2
        level = f"{level_db(image) - level_of_true_db:.1f}"
        yield [name, level, *widths, f"{shadow.contrast_db(image, POINT_M[:2]):.1f}"]
