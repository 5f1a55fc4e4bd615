"""Tracks, lines and grids that factorized images are tested on."""

from __future__ import annotations

import dataclasses
import weakref
from functools import cache

import numpy as np
import pyopencl as cl
from cases import along_x, lines_over

from clsas import plan
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Image
from clsas.engine.device.device import open_device
from clsas.engine.factorized.costs import Costs
from clsas.engine.imaging import backproject

EXACT_IS_SLOW = Costs(pixel_ns=1e6, point_ns=1e6)
"""Plans for small images divide them only if nothing else is fast."""
SPEED = 1500.0
BAND = 0.2  # of the carrier
CARRIER = 120e3
TRACK = along_x(600, 0.014)
HANN = BeamWindow(12, "hann")
BEAMS = (HANN, BeamWindow(25, "hann"), BeamWindow(10, "hann", squint_deg=3.0))


def around(x, y, *, pixel_m=(0.015, 0.015), shape=(150, 160), z=0.0):
    """A plane about (x, y)."""
    (rows, columns), (down, right) = shape, pixel_m
    return Grid.oriented(
        [x - (columns - 1) / 2 * right, y - (rows - 1) / 2 * down, z],
        [0, down, 0],
        [right, 0, 0],
        shape,
    )


def over(grid, tx=TRACK, rx=None, *, carrier_hz=CARRIER, band=BAND, **more):
    step_m = 0.8 * SPEED / (2 * band * carrier_hz)
    return lines_over(grid, tx, rx, carrier_hz=carrier_hz, step_m=step_m, **more), grid


def straight():
    return over(around(0, 40))


def near():
    return over(around(0, 10, pixel_m=(0.0075, 0.006)), along_x(800, 0.006), band=0.5)


def swaying():
    turn = np.linspace(0, 3 * np.pi, len(TRACK))
    return over(
        around(0, 40),
        TRACK + 0.1 * np.stack([0 * turn, np.sin(turn), 0.5 * np.cos(turn)], axis=1),
    )


def bistatic_array():
    """Pings of 6 receivers, whose phase centres overlap."""
    tx = np.repeat(along_x(100, 0.07), 6, axis=0)
    return over(around(0, 40), tx, tx + np.tile(along_x(6, 0.028), (100, 1)))


def moving_array():
    lines, grid = bistatic_array()
    return dataclasses.replace(lines, rx_velocity_m_s=[2.0, 0, 0]), grid


def swaying_while_moving():
    """Every receiver moves otherwise during flight."""
    lines, grid = swaying()
    turn = np.linspace(0, 3 * np.pi, lines.channels)
    velocity = np.stack([2 + 0 * turn, 0.1 * np.cos(turn), -0.05 * np.sin(turn)], axis=1)
    return dataclasses.replace(lines, rx_velocity_m_s=velocity), grid


def arc():
    """A sixth of a circle, 5 m above the plane."""
    turn = np.radians(np.linspace(-30, 30, 700)) - np.pi / 2
    track = np.stack([30 * np.cos(turn), 30 * np.sin(turn), 0 * turn + 5], axis=1)
    return over(around(1, 2, pixel_m=(0.006, 0.006)), track)


def hills():
    """A sloping seabed with dunes, higher than the pixels are apart."""
    grid = around(0, 40, z=-12)
    row, column = np.indices(grid.shape)
    return over(grid.with_height(0.2 * np.sin(row / 20) * np.cos(column / 30) + 0.004 * row))


@cache
def made(case):
    return case()


@cache
def exact(case, beam=None):
    lines, grid = made(case)
    if beam is None:
        return backproject(lines, grid, accuracy_db=-85)
    # Point by point, a window is evaluated for every pixel.
    points = Grid.points(grid.positions_m())
    return Image(backproject(lines, points, accuracy_db=-85, beam=beam).pixels, grid)


@cache
def planned(case, tolerance_db, beam=None):
    return plan(*made(case), tolerance_db=tolerance_db, beam=beam, costs=EXACT_IS_SLOW)


def with_gap(channels, spacing_m, gap_m):
    track_m = along_x(channels, spacing_m)
    track_m[:, 0] += np.sign(track_m[:, 0]) * gap_m / 2
    return track_m


def peak_device_bytes(monkeypatch, run, image_shape):
    """Return the most bytes that buffers of the default device hold at once during a run.

    Where it sets pixels in the host's memory, these are not counted.
    """
    device = open_device()
    held, peak = [0], [0]

    class Buffer(cl.Buffer):
        pass

    def counted(flags, size=0, hostbuf=None):
        buffer = Buffer(device.context, flags, size, hostbuf)
        held[0] += buffer.size
        peak[0] = max(peak[0], held[0])
        weakref.finalize(buffer, lambda size: held.__setitem__(0, held[0] - size), buffer.size)
        return buffer

    flags = cl.mem_flags.READ_WRITE
    copied = flags | cl.mem_flags.COPY_HOST_PTR
    monkeypatch.setattr(device, "buffer", lambda size: counted(flags, max(int(size), 4)))

    def uploaded(array):
        if not array.size:
            return device.buffer(0)
        return counted(copied, hostbuf=np.ascontiguousarray(array))

    monkeypatch.setattr(device, "upload", uploaded)
    share = device.share

    def shared(array):
        if array.shape == image_shape:
            return share(array)
        return counted(copied, hostbuf=np.ascontiguousarray(array))

    monkeypatch.setattr(device, "share", shared)
    run()
    return peak[0]


def changed(chosen, **fields):
    """A plan with other values of some fields of its method."""
    method = dataclasses.replace(chosen.method, **fields)
    return dataclasses.replace(chosen, method=method)
