"""Ranges of known points as functions of time offset, sound speed and lever arm.

The lines' own time axis and sound speed define the ranges. A point at the range rho from the
corrected positions is expected at (c0/c) rho - c0 dt/2, where c0 is the sound speed of the lines, c
the corrected one, and dt the time that must be added to the lines.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.geometry import pairwise_range_m
from clsas.engine.data.lines import RangeLines

UNKNOWNS = ("time_offset", "sound_speed", "forward", "port", "up")


@dataclass(frozen=True, eq=False)
class Model:
    """Ranges of points as functions of the corrections of `UNKNOWNS`, float64 [5].

    Attributes
    ----------
    lines : RangeLines
    points_m : float64 [points, 3]
    axes : float64 [3, channels, 3]
        Unit vectors forward, to port and up.
    """

    lines: RangeLines
    points_m: NDArray[np.float64]
    axes: NDArray[np.float64]

    def corrected(self, state: NDArray[np.float64]) -> RangeLines:
        """Return the lines with the corrections applied."""
        lines = self.lines
        speed_m_s = lines.sound_speed_m_s + float(state[1])
        ratio = speed_m_s / lines.sound_speed_m_s
        shift_m = np.einsum("u,uci->ci", state[2:], self.axes)
        first_m = lines.first_range_m + lines.sound_speed_m_s / 2 * state[0]
        return replace(
            lines,
            first_range_m=ratio * first_m,
            range_step_m=ratio * lines.range_step_m,
            tx_m=lines.tx_m + shift_m,
            rx_m=lines.rx_m + shift_m,
            sound_speed_m_s=speed_m_s,
        )

    def range_m(
        self, state: NDArray[np.float64], channels: NDArray[np.int64] | slice = slice(None)
    ) -> NDArray[np.float64]:
        """Return the expected ranges on the lines' own axis, [channels, points]."""
        lines, speed_m_s = self.lines, self.lines.sound_speed_m_s + float(state[1])
        shift_m = np.einsum("u,uci->ci", state[2:], self.axes[:, channels])
        velocity = lines.rx_velocity_m_s
        path_m = pairwise_range_m(
            self.points_m,
            lines.tx_m[channels] + shift_m,
            lines.rx_m[channels] + shift_m,
            None if velocity is None else velocity[channels],
            speed_m_s,
        ).T
        return lines.sound_speed_m_s * (path_m / speed_m_s - state[0] / 2)

    def gradient(
        self, state: NDArray[np.float64], channels: NDArray[np.int64] | slice = slice(None)
    ) -> NDArray[np.float64]:
        """Return the derivatives of `range_m`, [5, channels, points]."""
        lines, speed_m_s = self.lines, self.lines.sound_speed_m_s + float(state[1])
        axes = self.axes[:, channels]
        shift_m = np.einsum("u,uci->ci", state[2:], axes)
        ray = np.zeros((axes.shape[1], len(self.points_m), 3))
        for antenna_m in (lines.tx_m, lines.rx_m):
            leg_m = self.points_m - (antenna_m[channels] + shift_m)[:, None]
            ray += leg_m / np.maximum(np.linalg.norm(leg_m, axis=-1, keepdims=True), 1e-9) / 2
        by_speed = -self.range_m(state, channels) / speed_m_s
        by_speed -= lines.sound_speed_m_s * state[0] / (2 * speed_m_s)
        by_time = np.full_like(by_speed, -lines.sound_speed_m_s / 2)
        by_lever = -np.einsum("ucj,cpj->ucp", axes, ray) * lines.sound_speed_m_s / speed_m_s
        return np.stack([by_time, by_speed, *by_lever])
