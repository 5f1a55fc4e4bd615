"""Autofocus by torchbp beside that of clsas: `scripts/bench peers --autofocus`.

Both get the same lines, said to be on a track without the sway. What they find moves the lines, and
one judge forms the images of both: clsas, along the corrected and along the true track.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from peers import scenes
from peers.codes import Code, installed
from peers.workers import Ask, worker

import clsas
from clsas.trials import focusing, navigating, tables

COLUMNS = ("scene", "code, settings", "peak before, dB", "after, dB", "residual, wavelengths")
PASS = "gotcha/data_3dsar_pass1_az001_HH.mat"
SONAR_SETTINGS = {
    "gpga, wls, pattern": {"former": "gpga", "estimator": "wls", "max_iters": 20},
    "gpga, pd, pattern": {"former": "gpga", "estimator": "pd", "max_iters": 20},
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
    """torchbp's frame: horizontal axes from the middle of the track, x towards the image."""

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
        """Return points in this frame, [..., 3]."""
        return (points_m - self.origin_m) @ self.axes.T

    def moved(self, lines: clsas.RangeLines, by_m: NDArray[np.float64]) -> clsas.RangeLines:
        """Return lines moved by displacements in this frame, less what no image shows of them.

        A shift or a turn of the track moves the image, and its peak between other pixels.
        """
        seen_m = np.stack(
            [navigating.detrended(each) for each in by_m.T.astype(np.float64)], axis=1
        )
        vectors_m = seen_m @ self.axes
        return replace(lines, tx_m=lines.tx_m + vectors_m, rx_m=lines.rx_m + vectors_m)


def corners_m(grid: clsas.Grid) -> NDArray[np.float64]:
    """Return the corners of a plane grid, [2, 2, 3]."""
    rows, columns = grid.shape
    corner_m, down_m, across_m = grid.vectors_m
    down, across = np.array([0, rows - 1]), np.array([0, columns - 1])
    return corner_m + down[:, None, None] * down_m + across[:, None] * across_m


def polar_grid(
    points_m: NDArray[np.float64], range_step_m: float, sine_step: float
) -> dict[str, object]:
    """Return the polar grid that holds points in the frame."""
    x_m, y_m = points_m[..., 0].ravel(), points_m[..., 1].ravel()
    far_m, sine = np.hypot(x_m, y_m).max(), y_m / np.hypot(x_m, y_m)
    near_m = x_m.min()
    return {
        "r": (near_m, far_m),
        "theta": (sine.min(), sine.max()),
        "nr": int(np.ceil((far_m - near_m) / range_step_m)),
        "ntheta": int(np.ceil(np.ptp(sine) / sine_step)),
    }


def write(
    path: Path, lines: clsas.RangeLines, frame: Frame, grid: dict[str, object], **others: object
) -> None:
    """Write lines said to be on a track, and the grid on which torchbp focuses."""
    np.savez(
        path,
        frame_m=frame.of_points(lines.tx_m),
        range_step_m=lines.range_step_m,
        **scenes.as_profiles(lines),
        **grid,
        **others,
    )


def _others(
    ask: Ask, folder: Path, settings: dict[str, dict]
) -> Iterator[tuple[str, float, NDArray[np.float32] | str]]:
    """Yield what torchbp finds with several settings: words, seconds, and displacements."""
    for words, each in settings.items():
        answer = ask(image_file=str(folder / "moved.npy"), **each)
        if "refused" in answer:
            yield f"torchbp, {words}", 0.0, answer["refused"]
        else:
            yield f"torchbp, {words}", answer["seconds"], np.load(folder / "moved.npy")


def sonar_rows(device: str, code: Code | None) -> Iterator[list[str]]:
    """Yield a row per scene of `clsas.trials.focusing` and code."""
    for name, scene in focusing.SCENES.items():
        sway_m = scene.sway_m
        true, told = focusing.recorded(scene.targets, sway_m)
        before_db = focusing.peak_db(told, true, device)

        def row(
            code: str, lines: clsas.RangeLines, seconds: float, first: str, before_db: float,
            true: clsas.RangeLines, sway_m: NDArray[np.float64],
        ) -> list[str]:  # fmt: skip
            left_m = navigating.detrended(lines.tx_m[:, 1] - true.tx_m[:, 1])
            return [
                first,
                code,
                f"{before_db:.2f}",
                f"{focusing.peak_db(lines, true, device):.2f}",
                f"{np.std(left_m) / focusing.WAVELENGTH_M:.4f}",
                f"{seconds:.2f}",
            ]

        start = time.perf_counter()
        found = clsas.autofocus(told, focusing.GRID, device=device)
        seconds = time.perf_counter() - start
        first = f"{name}: {scene.smooth:g} smooth, {scene.white:g} white"
        yield row(f"clsas, {device}", found.lines, seconds, first, before_db, true, sway_m)
        if code is None:
            continue
        frame = Frame.of(told, focusing.GRID)
        sine_step = focusing.WAVELENGTH_M / (2.5 * np.ptp(told.tx_m[:, 0]))
        points_m = frame.of_points(corners_m(focusing.GRID))
        grid = polar_grid(points_m, told.range_step_m, sine_step)
        length = focusing.SONAR.tx_length_m / focusing.WAVELENGTH_M
        with tempfile.TemporaryDirectory() as name_of_folder:
            folder = Path(name_of_folder)
            write(folder / "scene.npz", told, frame, grid, element_wavelengths=length)
            with worker(code.python, code.program, folder / "scene.npz") as ask:
                for words, seconds, moved in _others(ask, folder, SONAR_SETTINGS):
                    if isinstance(moved, str):
                        yield ["", words, "", f"refused: {moved}", "", ""]
                        continue
                    lines = frame.moved(told, moved)
                    yield row(words, lines, seconds, "", before_db, true, sway_m)


def peers_autofocus(device: str, torchbp: Path | None, recordings: Path | None) -> None:
    """Print peaks and residuals after autofocus by clsas and by torchbp."""
    codes, absent = installed(torchbp)
    code = codes.get("torchbp")
    if code is not None:
        code = Code(code.python, Path(__file__).with_name("focus_with_torchbp.py"))
    tables.table([*COLUMNS, "seconds"], sonar_rows(device, code))
    for name, reason in absent.items():
        print(f"\n{name} is not measured: {reason}")
