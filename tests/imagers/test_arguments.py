"""One table of the arguments that imagers refuse, and of what they say."""

import dataclasses

import numpy as np
import pytest
from contract import narrow

import clsas
from clsas import BeamWindow, Grid, Image

LINES, GRID = narrow().lines, narrow().grid
GOOD = {
    "backproject": {"lines": LINES, "grid": GRID},
    "factorize": {"lines": LINES, "grid": GRID, "plan_or_tolerance": -40},
    "mosaic": {"source": LINES, "grid": GRID},
    "wavenumber": {"lines": LINES, "grid": GRID},
}
EVERY = tuple(GOOD)
IN_PARTS = ("backproject", "factorize")

STRAIGHT = BeamWindow(16, "hann", along=[1, 0, 0])
HUGE = dataclasses.replace(LINES, samples=np.full_like(LINES.samples, 3e37))
NOT_LINES = np.zeros((2, 3), complex)
ZEROS = Image(np.zeros(GRID.shape, complex), GRID)
SHIFTED = dataclasses.replace(GRID, origin_m=GRID.origin_m + [0, 0.01, 0])


def turned(row, column):
    return Grid.oriented([0, 60, 0], row, column, (5, 5))


# (functions, argument, value, exception, message)
REFUSED = [
    # Lines
    (("backproject", "factorize", "wavenumber"), "lines", NOT_LINES, TypeError,
     "lines must be .*RangeLines.*ndarray"),
    (("mosaic",), "source", NOT_LINES, TypeError, "source must be"),
    (("backproject", "factorize", "wavenumber"), "lines", HUGE, ValueError,
     r"samples must be at most .* got 3e\+37"),
    (("wavenumber",), "lines", LINES.select([7]), ValueError,
     "lines must have phase centres at two positions or more"),
    # Grid
    (EVERY, "grid", (5, 5), TypeError, "grid must be .*Grid.*tuple"),
    (IN_PARTS, "grid", Grid.plane((-1, 1, 10**6), (30, 31, 10**6)), ValueError,
     "grid must ask for at most .* GiB"),
    (("mosaic",), "grid", Grid.points([[0.0, 30.0, 0.0]]), ValueError, "grid must have two axes"),
    (("wavenumber",), "grid", Grid.points([[0, 60, 0]]), ValueError,
     "grid must be a plane .*got points"),
    (("wavenumber",), "grid", GRID.with_height(np.zeros(GRID.shape)), ValueError,
     "a plane .*got heights"),
    (("wavenumber",), "grid", turned([0, 0.1, 0], [0.1, 0.01, 0]), ValueError,
     "angle between the grid's rows and the track must be .*<= 5 degrees, got 5.7"),
    (("wavenumber",), "grid", turned([0.1, 0, 0], [0, 0.1, 0]), ValueError,
     "angle between the grid's rows and the track .*got 90"),
    (("wavenumber",), "grid", Grid.plane((0, 1, 5), (0, 1, 5)), ValueError,
     "distance of grid .*>= 0.0075.* m"),
    # Accuracy
    (("backproject",), "accuracy_db", 0, ValueError, "accuracy_db must be .*< 0.*dB.*got 0"),
    (("mosaic",), "accuracy_db", 3, ValueError, "accuracy_db must be .* dB, got 3"),
    (("backproject",), "accuracy_db", -86, ValueError, "accuracy_db must be .*>= -85.*got -86"),
    (("backproject",), "accuracy_db", np.nan, ValueError, "accuracy_db .*finite.*nan"),
    (("backproject",), "accuracy_db", None, TypeError, "accuracy_db must be .*None"),
    (("backproject",), "accuracy_db", "-60 dB", TypeError, "accuracy_db must be .*-60 dB"),
    (("backproject",), "taps", 5, ValueError, r"taps must be one of 2, 4, 6, 8, got 5"),
    (("backproject",), "taps", 0, ValueError, "taps must be one of .*got 0"),
    (("backproject",), "taps", 4.5, ValueError, "taps must be one of .*got 4.5"),
    (("backproject",), "taps", 4.0, (TypeError, ValueError), "taps"),
    (("backproject",), "upsampling", 0.9, ValueError, "upsampling must be .*>= 1.*got 0.9"),
    (("backproject",), "upsampling", 1e9, ValueError, "upsampling must be .*<= 64.*got 1e"),
    (("backproject",), "upsampling", np.inf, ValueError, "upsampling .*finite.*inf"),
    (("factorize",), "plan_or_tolerance", -86, ValueError,
     r"tolerance.* must be .*>= -85 .*dB.*got -86"),
    (("factorize",), "plan_or_tolerance", 0, ValueError,
     r"tolerance.* must be .*<= -10 dB.*got 0"),
    (("factorize",), "plan_or_tolerance", np.nan, ValueError, "tolerance.* must be finite.*nan"),
    (("factorize",), "plan_or_tolerance", "-40 dB", TypeError,
     "plan_or_tolerance must be .*-40 dB"),
    (("factorize",), "plan_or_tolerance", None, TypeError, "plan_or_tolerance must be .*None"),
    (("factorize",), "plan_or_tolerance", [(2, 2)], TypeError,
     r"plan_or_tolerance must be .*\(2, 2\)"),
    (("mosaic",), "tolerance_db", -200, ValueError, r"tolerance_db must be .* got -200"),
    (("mosaic",), "tolerance_wavelengths", -1, ValueError, "tolerance_wavelengths must be"),
    (("mosaic",), "stages", 3, TypeError, "stages must be"),
    # Beam
    (EVERY, "beam", 20.0, TypeError, "beam must be .*BeamWindow.*float"),
    (("wavenumber",), "beam", BeamWindow(8, normalise=True), ValueError, "beam must not normalise"),
    (("wavenumber",), "beam", BeamWindow(8, along=[1, 1, 0]), ValueError,
     "the beam's along .*got 45"),
    # Pieces and progress
    (IN_PARTS, "accumulate", np.zeros(GRID.shape, complex), TypeError,
     "accumulate must be .*Image"),
    *(
        (IN_PARTS, "accumulate", Image(np.zeros(grid.shape, complex), grid), ValueError,
         "accumulate and grid must lie on one grid")
        for grid in (SHIFTED, GRID.window(slice(0, 24), slice(0, 23)))
    ),
    (IN_PARTS, "progress", 5, TypeError, "progress must be a function"),
    # Devices and threads
    (IN_PARTS, "device", 1.5, TypeError, "device must be .*1.5"),
    (IN_PARTS, "device", True, TypeError, "device must be .*True"),
    (("mosaic",), "device", [], ValueError, "device must name at least one device"),
    (("wavenumber",), "motion_compensation", "yes", TypeError,
     "motion_compensation must be .*bool.*str"),
    (("wavenumber",), "workers", 0, ValueError, "workers must be at least 1, got 0"),
    (("wavenumber",), "workers", 1.5, TypeError, "workers must be a whole number"),
    # Patches
    (("mosaic",), "patches", (20, 4), ValueError,
     "patches must all have pixels, got 20 patches of 2 for 24"),
    (("mosaic",), "patches", (25, 4), ValueError, "patches must all have pixels, got 25"),
    (("mosaic",), "patches", (0, 4), ValueError, "every entry of patches must be .* got 0"),
    (("mosaic",), "patches", 4, (TypeError, ValueError),
     r"patches must be \(rows, columns\) of patches, got 4"),
    (("mosaic",), "patches", (1, 2, 3), (TypeError, ValueError),
     r"patches must be \(rows, columns\) of patches"),
    (("mosaic",), "memory_bytes", -1, ValueError, "memory_bytes must be"),
    (("mosaic",), "memory_bytes", 1000, ValueError, "memory_bytes must be at least .* MiB"),
    (("mosaic",), "follow_s", 1.0, ValueError, "source must be a folder if `follow_s` is given"),
]  # fmt: skip
ROWS = [
    pytest.param(name, argument, value, error, says, id=f"{name}-{argument}-{number}")
    for number, (names, argument, value, error, says) in enumerate(REFUSED)
    for name in names
]


@pytest.mark.parametrize(("name", "argument", "value", "error", "says"), ROWS)
def test_an_argument_that_is_not_allowed_is_named(name, argument, value, error, says):
    with pytest.raises(error, match=says):
        getattr(clsas, name)(**(GOOD[name] | {argument: value}))


# (function, arguments that do not go together, exception, message)
TOGETHER = [
    ("backproject", {"accuracy_db": -80, "taps": 2}, ValueError,
     r"accuracy_db must be within reach of `taps=2`, got -80 dB: the best is -\d"),
    ("backproject", {"grid": "grid", "accumulate": ZEROS},
     TypeError, "grid must be"),
    ("mosaic", {"tolerance_db": -40, "accuracy_db": -70}, ValueError,
     "accuracy_db must be left out if `tolerance_db` is given"),
    *(
        (name, {"accumulate": ZEROS,
                "beam": BeamWindow(60, "hann", normalise=True)}, ValueError,
         "accumulate must be None with a beam that normalises")
        for name in IN_PARTS
    ),
    *(
        (name, {"lines": dataclasses.replace(LINES, carrier_hz=0.0),
                "beam": BeamWindow(8, "inverse", element_length_m=0.1)}, ValueError,
         "carrier_hz must be above 0")
        for name in ("backproject", "wavenumber")
    ),
]  # fmt: skip


@pytest.mark.parametrize(("name", "arguments", "error", "says"), TOGETHER)
def test_arguments_that_do_not_go_together_are_named(name, arguments, error, says):
    with pytest.raises(error, match=says):
        getattr(clsas, name)(**(GOOD[name] | arguments))
