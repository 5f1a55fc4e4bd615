"""Dense apertures that factorized images are tested on, and grids below them."""

from functools import cache

import numpy as np
from factorizing import around, over

from clsas.engine.data.grid import Grid
from clsas.selftest.cases import helix as positions_on_helix

CARRIER = 30e3
WAVELENGTH = 1500.0 / CARRIER


def helix():
    """24 turns of 180 channels."""
    return positions_on_helix(24, 180, 1.2, 0.3, 0.02)


def jittered_helix():
    return helix() + np.random.default_rng(3).normal(0, 2e-3, (24 * 180, 3))


def raster():
    """48 lines of 64 channels, to and fro."""
    row, column = np.mgrid[0:48, 0:64]
    column = np.where(row % 2, 63 - column, column)
    position_m = 0.05 * np.stack([column - 31.5, row - 23.5, 0 * row], axis=-1)
    return position_m.reshape(-1, 3) + [0, 0, 6]


def spiral():
    """40 turns in a plane."""
    share = np.sqrt(np.arange(1, 3001) / 3000)
    angle = 80 * np.pi * share
    return 1.5 * np.stack([share * np.cos(angle), share * np.sin(angle), 4 + 0 * share], axis=1)


def planar():
    """Channels anywhere in a plane, in any order."""
    random = np.random.default_rng(7)
    return np.column_stack([random.uniform(-1.5, 1.5, (3000, 2)), random.normal(6, 1e-3, 3000)])


def passes():
    """8 passes on 3 headings and 4 heights."""
    along_m = 0.03 * (np.arange(200) - 99.5)
    found = []
    for number in range(8):
        heading = np.radians(60 * (number % 3))
        ahead = np.array([np.cos(heading), np.sin(heading), 0])
        aside = np.array([np.sin(heading), -np.cos(heading), 0])
        beside_m = (20 + 0.4 * number) * aside + [0, 0, 5 + 1.5 * (number % 4)]
        found.append(along_m[:, None] * ahead + beside_m)
    return np.concatenate(found)


TRACKS = {
    "helix": helix,
    "jittered helix": jittered_helix,
    "raster": raster,
    "spiral": spiral,
    "planar": planar,
    "passes": passes,
}


def turning(tx_m):
    """Headings around the vertical axis."""
    angle = np.arctan2(tx_m[:, 1], tx_m[:, 0])
    return np.stack([-np.sin(angle), np.cos(angle), 0 * angle], axis=1)


def to_and_fro():
    """Headings of the raster's lines."""
    return np.repeat([1.0, -1.0] * 24, 64)[:, None] * [1.0, 0.0, 0.0]


def headings(name, squint_deg=0.0):
    """Directions of the beam for an aperture; None for those of its passes."""
    if name == "passes":
        return None
    if name == "planar":
        return np.array([0.6, 0.8, 0.0])
    if name == "raster":  # with a squint, a beam and its opposite differ
        return to_and_fro() if squint_deg == 0 else np.array([1.0, 0.0, 0.0])
    return turning(TRACKS[name]())


def pixel_m(name):
    return 0.004 if "helix" in name else 0.02


@cache
def scene(name, kind="plane", side=96):
    """Noise in every channel of an aperture, and a grid around the origin."""
    step_m, tx = pixel_m(name), TRACKS[name]()
    grid = around(0, 0, pixel_m=(step_m, step_m), shape=(side, side))
    options = {}
    if kind == "hills":
        row, column = np.indices(grid.shape)
        grid = grid.with_height(6 * step_m * np.sin(row / 20) * np.cos(column / 30))
    elif kind == "volume":
        plane_m = grid.positions_m()[::3, ::3]
        grid = Grid.points(np.stack([plane_m + [0, 0, 6 * step_m * n] for n in (-1, 0, 1)]))
    elif kind == "bistatic":
        options["rx"] = tx + [0.02, 0.03, 0]
    elif kind == "moving":
        options["velocity"] = [[1.0, 0.5, 0]] * len(tx)
    carrier_hz = 2 * CARRIER if name == "passes" else CARRIER
    return over(grid, tx, options.pop("rx", None), carrier_hz=carrier_hz, band=0.3, **options)
