"""Kernels do not read uninitialised memory: its contents do not change any image."""

from functools import cache

import numpy as np
import pyopencl as cl
import pytest
from dense import scene
from factorizing import EXACT_IS_SLOW, changed
from tiers import thinned

from clsas.engine.data.beam import BeamWindow
from clsas.engine.device.device import Device
from clsas.engine.imaging import factorize, plan
from clsas.selftest import accuracy, extremes
from clsas.selftest.extremes import along_x

BEAM = BeamWindow(12, "hann", along=[1, 0, 0], normalise=True)
SCENES = {
    "plane": lambda: extremes.ultrasonic(70, shape=(37, 29)),
    "relief": lambda: extremes.ultrasonic(70, shape=(37, 29), relief_m=0.05),
    "beam": lambda: extremes.ultrasonic(track=along_x(90, 0.1), beam=BEAM, shape=(21, 19)),
    "moving": lambda: extremes.array(moving=True, shape=(53, 47)),
}
REQUESTS = (("exact", -80.0), ("exact", -40.0), ("factorized", -55.0), ("half precision", -30.0))


@cache
def made(name):
    return SCENES[name]()


@pytest.fixture
def poison(monkeypatch):
    """Return a function that fills new buffers with NaN from then on, and lists their sizes."""
    filled = []
    make = Device.buffer

    def poisoned(self, bytes_):
        buffer = make(self, bytes_)
        cl.enqueue_fill_buffer(self.queue, buffer, np.uint8(255), 0, buffer.size).wait()
        filled.append(buffer.size)
        return buffer

    def switch_on():
        monkeypatch.setattr(Device, "buffer", poisoned)
        return filled

    return switch_on


@pytest.mark.slow
@pytest.mark.parametrize(("name", "request_"), thinned(SCENES, REQUESTS))
def test_what_unused_memory_holds_does_not_matter(name, request_, device, poison):
    imager, asked_db = request_
    known = made(name)
    wanted = accuracy.form(imager, known, asked_db, device).pixels
    filled = poison()
    found = accuracy.form(imager, known, asked_db, device).pixels
    assert filled
    assert known.error_db(found) <= asked_db
    assert found.tobytes() == wanted.tobytes()


@pytest.mark.slow
@pytest.mark.parametrize("tolerance_db", [-25, -60])
@pytest.mark.parametrize("name", ["helix", "planar"])
def test_nor_does_it_for_a_sheet_of_channels(name, tolerance_db, poison):
    """Lines between stages are zero when they are made; the next test is about those."""
    lines, grid = scene(name)
    chosen = plan(lines, grid, tolerance_db=tolerance_db, costs=EXACT_IS_SLOW)
    assert chosen.factorization.aperture.shape == "sheet"
    wanted = factorize(lines, grid, chosen).pixels
    filled = poison()
    found = factorize(lines, grid, chosen).pixels
    assert filled
    assert found.tobytes() == wanted.tobytes()


@pytest.mark.slow
@pytest.mark.parametrize("tolerance_db", [-40, -60])
def test_lines_that_an_earlier_batch_left_do_not_matter(tolerance_db):
    """Stages of sheets add to lines that they set to zero, which roots formed before have used."""
    lines, grid = scene("helix")
    chosen = plan(lines, grid, tolerance_db=tolerance_db, costs=EXACT_IS_SLOW)
    assert chosen.factorization.aperture.shape == "sheet"
    assert chosen.factorization.roots_at_once > 1
    one_by_one = changed(chosen, roots_at_once=1, roots_prepared=1)
    wanted = factorize(lines, grid, chosen).pixels
    assert factorize(lines, grid, one_by_one).pixels.tobytes() == wanted.tobytes()
