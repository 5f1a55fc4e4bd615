"""Autofocus by torchbp and by clsas: `scripts/bench peers --autofocus`.

Both codes receive the same lines, with the positions of a track without the sway. Their corrections
are applied to these positions. clsas then forms the images of both, with the corrected and with the
true tracks.
"""

from __future__ import annotations

import itertools
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from peers import scenes
from peers.codes import Code, installed
from peers.workers import worker
from studies import focusing, navigating, tables

import clsas
from clsas.engine.data.lines import wavelength_m

COLUMNS = (
    "scene",
    "code, settings",
    "peak before, dB",
    "after, dB",
    "residual, wavelengths",
    "its smooth part",
    "seconds",
)
PASS = "gotcha/data_3dsar_pass1_az001_HH.mat"
SONAR_SETTINGS = {
    "gpga, wls, pattern": {"former": "gpga", "estimator": "wls", "max_iters": 20},
    "gpga_tde, 4 x 2 blocks, pattern": {
        "former": "gpga_tde",
        "azimuth_divisions": 4,
        "range_divisions": 2,
        "estimate_z": False,
        "max_iters": 20,
    },
}
RADAR_SETTINGS = {
    "gpga, wls": {"former": "gpga", "estimator": "wls", "max_iters": 20},
    "gpga, pd": {"former": "gpga", "estimator": "pd", "max_iters": 20},
}


@dataclass(frozen=True)
class Frame:
    """Frame of torchbp: horizontal axes from the middle of the track, x towards the image."""

    origin_m: NDArray[np.float64]
    axes: NDArray[np.float64]

    @classmethod
    def of(cls, lines: clsas.RangeLines, grid: clsas.Grid) -> Frame:
        """Return the frame of lines and a level grid."""
        corner_m, down_m, across_m = grid.vectors_m
        rows, columns = grid.shape
        middle_m = corner_m + (rows - 1) / 2 * down_m + (columns - 1) / 2 * across_m
        origin_m = lines.tx_m.mean(axis=0) * [1, 1, 0] + middle_m * [0, 0, 1]
        ahead = (middle_m - origin_m) / np.linalg.norm(middle_m - origin_m)
        return cls(origin_m, np.stack([ahead, [-ahead[1], ahead[0], 0], [0, 0, 1]]))

    def of_points(self, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the coordinates of points in this frame, [..., 3]."""
        return (points_m - self.origin_m) @ self.axes.T

    def moved(self, lines: clsas.RangeLines, by_m: NDArray[np.float64]) -> clsas.RangeLines:
        """Return lines moved by displacements in this frame, without their mean and trend.

        A shift or a turn of the track only moves the image, and its peak relative to the pixels.
        """
        seen_m = np.stack(
            [navigating.detrended(each) for each in by_m.T.astype(np.float64)], axis=1
        )
        vectors_m = seen_m @ self.axes
        return replace(lines, tx_m=lines.tx_m + vectors_m, rx_m=lines.rx_m + vectors_m)


def corners_m(grid: clsas.Grid) -> NDArray[np.float64]:
    """Return the corners of a plane grid, metres [2, 2, 3]."""
    rows, columns = grid.shape
    corner_m, down_m, across_m = grid.vectors_m
    down, across = np.array([0, rows - 1]), np.array([0, columns - 1])
    return corner_m + down[:, None, None] * down_m + across[:, None] * across_m


def polar_grid(
    points_m: NDArray[np.float64], range_step_m: float, sine_step: float
) -> dict[str, object]:
    """Return the polar grid that covers points in the frame."""
    x_m, y_m = points_m[..., 0].ravel(), points_m[..., 1].ravel()
    far_m, sine = np.hypot(x_m, y_m).max(), y_m / np.hypot(x_m, y_m)
    near_m = x_m.min()
    return {
        "r": (near_m, far_m),
        "theta": (sine.min(), sine.max()),
        "nr": int(np.ceil((far_m - near_m) / range_step_m)),
        "ntheta": int(np.ceil(np.ptp(sine) / sine_step)),
    }


@dataclass(frozen=True)
class Trial:
    """Lines with wrong positions, their true positions, and the settings of torchbp.

    Attributes
    ----------
    words : str
        Description of the scene.
    true, given : RangeLines
        Lines with their true positions, and with those that both codes are given.
    grid : Grid
        Grid on which clsas focuses.
    peak_db : callable
        Returns the peak of an image of lines over that of the true lines, dB.
    axes : dict
        Grid of torchbp, in its frame.
    others : dict
        Further inputs of torchbp.
    settings : dict
        Settings of torchbp, by their description.
    """

    words: str
    true: clsas.RangeLines
    given: clsas.RangeLines
    grid: clsas.Grid
    peak_db: Callable[[clsas.RangeLines], float]
    axes: dict[str, object]
    others: dict[str, object]
    settings: dict[str, dict]

    @property
    def frame(self) -> Frame:
        """Frame in which torchbp works."""
        return Frame.of(self.given, self.grid)

    def left_m(self, lines: clsas.RangeLines) -> NDArray[np.float64]:
        """Return the residual sway without mean and trend, metres."""
        return navigating.detrended((lines.tx_m - self.true.tx_m) @ self.frame.axes[0])


def sonar_trials(device: str) -> Iterator[Trial]:
    """Yield trials of the scenes of `studies.focusing` on its small grid."""
    small = {name: each for name, each in focusing.SCENES.items() if each.grid is focusing.GRID}
    for name, scene in small.items():
        true, given = focusing.recorded(scene.targets, scene.sway_m)
        frame = Frame.of(given, focusing.GRID)
        sine_step = focusing.WAVELENGTH_M / (2.5 * np.ptp(given.tx_m[:, 0]))
        points_m = frame.of_points(corners_m(focusing.GRID))
        yield Trial(
            f"{name}: {scene.smooth:g} smooth, {scene.white:g} white",
            true,
            given,
            focusing.GRID,
            partial(focusing.peak_db, true=true, device=device),
            polar_grid(points_m, given.range_step_m, sine_step),
            {"element_wavelengths": focusing.SONAR.tx_length_m / focusing.WAVELENGTH_M},
            SONAR_SETTINGS,
        )


def radar_trials(path: Path, device: str) -> Iterator[Trial]:
    """Yield trials of the recorded radar pass, with sways that neither code knows."""
    true, grid = focusing.radar_pass(path), focusing.RADAR_GRID
    given_db = focusing.reflector_db(true, device)
    frame = Frame.of(true, grid)
    middle_m = frame.of_points(corners_m(grid)).mean(axis=(0, 1))
    half_m = np.ptp(grid.axes_m[0]) / 2
    for smooth, white in focusing.RADAR_ERRORS:
        yield Trial(
            f"radar: {smooth:g} smooth, {white:g} white",
            true,
            focusing.swaying(true, smooth, white),
            grid,
            lambda lines: focusing.reflector_db(lines, device) - given_db,
            {
                "x": (middle_m[0] - half_m, middle_m[0] + half_m),
                "y": (middle_m[1] - half_m, middle_m[1] + half_m),
                "nx": grid.shape[0],
                "ny": grid.shape[1],
            },
            {},
            RADAR_SETTINGS,
        )


def rows(trial: Trial, device: str, code: Code | None) -> Iterator[list[str]]:
    """Yield a row for the result of clsas, and rows for those of torchbp."""

    def row(words: str, code: str, lines: clsas.RangeLines, seconds: float) -> list[str]:
        left_m, wave_m = trial.left_m(lines), wavelength_m(lines)
        return [
            words,
            code,
            f"{trial.peak_db(trial.given):.2f}" if words else "",
            f"{trial.peak_db(lines):.2f}",
            f"{focusing.residual_m(left_m) / wave_m:.4f}",
            f"{focusing.smooth_residual_m(left_m) / wave_m:.4f}",
            f"{seconds:.2f}",
        ]

    start = time.perf_counter()
    found = clsas.autofocus(trial.given, trial.grid, device=device)
    yield row(trial.words, f"clsas, {device}", found.lines, time.perf_counter() - start)
    if code is None:
        return
    frame = trial.frame
    with tempfile.TemporaryDirectory() as folder:
        scene_file, moved_file = Path(folder) / "scene.npz", Path(folder) / "moved.npy"
        np.savez(
            scene_file,
            frame_m=frame.of_points(trial.given.tx_m),
            range_step_m=trial.given.range_step_m,
            **scenes.as_profiles(trial.given),
            **trial.axes,
            **trial.others,
        )
        with worker(code.python, code.program, scene_file) as ask:
            for words, settings in trial.settings.items():
                answer = ask(image_file=str(moved_file), **settings)
                if "refused" in answer:
                    yield ["", f"torchbp, {words}", "", f"refused: {answer['refused']}", "", "", ""]
                else:
                    lines = frame.moved(trial.given, np.load(moved_file))
                    yield row("", f"torchbp, {words}", lines, answer["seconds"])


def peers_autofocus(device: str, torchbp: Path | None, recordings: Path | None) -> None:
    """Print peaks and residuals after autofocus by clsas and by torchbp."""
    codes, absent = installed(torchbp)
    code = codes.get("torchbp")
    if code is not None:
        code = Code(code.python, Path(__file__).with_name("focus_with_torchbp.py"))
    trials = sonar_trials(device)
    if recordings is not None:
        trials = itertools.chain(trials, radar_trials(recordings / PASS, device))
    found = itertools.chain.from_iterable(rows(trial, device, code) for trial in trials)
    tables.table(COLUMNS, found)
    if "torchbp" in absent:
        print(f"\ntorchbp is not measured: {absent['torchbp']}")
