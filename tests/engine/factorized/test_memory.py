"""The buffers that a run allocates are those that its prediction of memory adds up."""

from dataclasses import replace

import pytest
from factorizing import (
    BEAMS,
    EXACT_IS_SLOW,
    hills,
    made,
    moving_array,
    peak_device_bytes,
    straight,
)

from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.image_error import relative_error_db
from clsas.engine.data.sound_speed import SoundSpeed
from clsas.engine.device.buffers import Slot
from clsas.engine.factorized import candidates, costs
from clsas.engine.imaging import backproject, factorize, plan
from clsas.engine.water.refraction import homogeneous


def refracted_hills():
    """Hills below a profile in which the ranges of groups are corrected."""
    lines, grid = made(hills)
    profile = SoundSpeed([0, 10, 11, 15], [1500, 1500, 1470, 1470], surface_z_m=1.0)
    assert homogeneous(replace(lines, sound_speed=profile), grid, None, -60).corrections is not None
    return replace(lines, sound_speed=profile), grid


TOLERANCE = {"tolerance_db": -40, "costs": EXACT_IS_SLOW}
NORMALISING = BeamWindow(20, "hann", normalise=True)
CASES = {
    "plane": (straight, TOLERANCE),
    "relief": (hills, TOLERANCE),
    "relief in a profile": (refracted_hills, TOLERANCE | {"tolerance_db": -60}),
    "moving receivers": (moving_array, TOLERANCE),
    "beam": (straight, TOLERANCE | {"beam": BEAMS[0]}),
    "normalising beam": (straight, TOLERANCE | {"beam": NORMALISING}),
    "normalising beam, relief": (hills, TOLERANCE | {"beam": NORMALISING}),
    "stages": (straight, {"stages": [(4, 2)]}),
}


@pytest.fixture(params=CASES.values(), ids=CASES)
def case(request, monkeypatch):
    """Lines, grid, plan, and the sizes of its buffers that were predicted."""
    make, request_ = request.param
    predicted = {}

    def batches_within(sizes, *others):
        batches = costs.batches_within(sizes, *others)
        predicted[batches.memory_bytes] = sizes
        return batches

    monkeypatch.setattr(candidates, "batches_within", batches_within)
    lines, grid = made(make)
    chosen = plan(lines, grid, **request_)
    assert not chosen.is_exact
    return lines, grid, chosen, predicted[chosen.memory_bytes]


def sizes_of(buffers):
    return {name: buffer.nbytes for name, buffer in buffers.items()}


@pytest.fixture
def allocated(monkeypatch):
    """Largest sizes of the buffers that a run allocates, by name."""
    sizes, at_least = {}, Slot._at_least

    def recorded(self, name, bytes_, make):
        sizes[name] = max(sizes.get(name, 0), bytes_)
        return at_least(self, name, bytes_, make)

    monkeypatch.setattr(Slot, "_at_least", recorded)
    return sizes


@pytest.mark.slow
def test_a_run_allocates_what_was_predicted(case, allocated):
    lines, grid, chosen, sizes = case
    factorize(lines, grid, chosen)
    image = chosen.factorization
    work = sizes_of(sizes.work(image.roots_at_once))
    tables = sizes_of(sizes.tables(image.roots_prepared))
    # On a CPU pixels may be set in the image itself, and a sonar at one place needs no ramp.
    needless = {"tile_centres", "pixels", "ramp"}
    assert allocated.keys() - needless == (work | tables).keys() - needless
    for name, bytes_ in allocated.items():
        assert bytes_ <= (work | tables)[name], name
    for level in range(len(chosen.sides)):
        assert allocated[f"lines{level}"] == work[f"lines{level}"]


def test_the_predicted_memory_is_an_upper_bound(case, monkeypatch):
    lines, grid, chosen, _ = case
    peak = peak_device_bytes(monkeypatch, lambda: factorize(lines, grid, chosen), grid.shape)
    assert 0.5 * chosen.memory_bytes <= peak <= chosen.memory_bytes


def test_memory_is_the_sum_of_all_buffers(case):
    *_, chosen, sizes = case
    image = chosen.factorization
    total = costs.total_bytes(sizes.constant()) + costs.total_bytes(sizes.work(image.roots_at_once))
    roots = min(image.roots_prepared, chosen.stages[0].subimages)
    total += 2 * costs.total_bytes(sizes.tables(roots))
    assert chosen.memory_bytes == total


def test_batches_of_roots_make_the_same_image(platform):
    """In a profile too, where every root has corrections of its own."""
    lines, grid = refracted_hills()
    request = {"tolerance_db": -60, "costs": EXACT_IS_SLOW, "device": platform}
    whole = plan(lines, grid, **request)
    parted = plan(lines, grid, memory_bytes=int(0.8 * whole.memory_bytes), **request)
    assert parted.sides == whole.sides
    images = [factorize(lines, grid, each, device=platform) for each in (parted, whole)]
    assert relative_error_db(*images) < -110


@pytest.mark.slow
@pytest.mark.parametrize("beam", [None, BEAMS[0], NORMALISING], ids=str)
@pytest.mark.parametrize("make", [straight, hills, moving_array])
def test_an_exact_run_allocates_what_was_predicted(make, beam, allocated, monkeypatch):
    predicted = {}

    def recorded(find):
        def find_buffers(*sizes):
            buffers = find(*sizes)
            for name, bytes_ in sizes_of(buffers).items():
                predicted[name] = max(predicted.get(name, 0), bytes_)
            return buffers

        return find_buffers

    for find in (costs.block_buffers, costs.part_buffers):
        monkeypatch.setattr(costs, find.__name__, recorded(find))
    lines, grid = made(make)
    plan(lines, grid, stages=[], beam=beam)
    backproject(lines, grid, accuracy_db=-60, beam=beam)
    assert allocated.keys() == predicted.keys()
    most = 1.1 if make is hills else 1.0  # groups of points are estimated
    for name, bytes_ in allocated.items():
        assert 0.5 * predicted[name] <= bytes_ <= most * predicted[name], name
