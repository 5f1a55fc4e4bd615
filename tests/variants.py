"""The devices that tests run on, and which tests run on more than one of them.

A test takes the fixture `platform` where its outcome can depend on a driver, and `device` where it
can also depend on how a CPU's kernels are built: floats of a vector, and permutations. The tables
below say which cases are worth repeating. All cases run on the default device, which is the fastest
one here; the whole suite would take four times as long if all of them ran on all.
"""

from functools import cache

from clsas.engine.device.device import DeviceError, choose, list_devices, open_device
from clsas.selftest.accuracy import driven, other_builds


def _named(ways, infos):
    return {
        f"{infos[index].platform.replace('(', ' ').split()[0]}-{width}{'-permute' * permute}": (
            index,
            width,
            permute,
        )
        for index, width, permute in ways
    }


def _variants():
    """(index, lanes, permute) of one device per platform, and of one CPU driven in every way."""
    infos = list_devices()
    first = {info.platform: info for info in reversed(infos)}.values()
    own = _named([(info.index, info.width, info.permute) for info in first], infos)
    # Of the CPUs' compilers PoCL's is the fastest.
    cpus = sorted((info for info in first if info.kind == "cpu"), key=lambda i: i.platform)[-1:]
    forced = _named(
        [(info.index, *way) for info in cpus for way in other_builds(info)],
        infos,
    )
    # Without any device the tests fail, with the message that says how to get one.
    return own or {"none": (None, None, None)}, forced


@cache
def variant(index, width, permute):
    """A device that is driven in a given way; its kernels are built once."""
    return driven(open_device(index), width, permute)


OWN, OTHERS = _variants()


def _default():
    """Name of the device that is chosen unless one is asked for."""
    try:
        chosen = choose()[0]
    except DeviceError:
        return next(iter(OWN))
    labels = {info.index: info.platform for info in list_devices()}
    return next(name for name, way in OWN.items() if labels[way[0]] == chosen.platform)


DEFAULT = _default()

EVERY_CASE = ("",)

EVERY_VARIANT = {
    # Exact kernels: tiles and groups of pixels, antennas of each kind, filters of each length.
    "test_backprojection.py::test_rounding_stays_below_80_db": (
        "thesis", "bistatic", "moving", "height_map", "points",
    ),
    "test_backprojection.py::test_rounding_does_not_depend_on_the_interpolator": EVERY_CASE,
    "test_backprojection.py::test_samples_are_looked_up_wherever_pixels_lie": ("-permute-",),
    "test_backprojection.py::test_any_number_of_channels": EVERY_CASE,
    "test_backprojection.py::test_any_shape_of_grid": EVERY_CASE,
    "test_backprojection.py::test_a_point_beyond_a_line_gets_exactly_nothing": EVERY_CASE,
    "test_backprojection.py::test_far_parts_of_a_grid_get_exactly_nothing": EVERY_CASE,
    "test_rounding.py::test_a_pixel_at_an_antenna_is_a_pixel_like_others": EVERY_CASE,
    "test_rounding.py::test_rounding_stays_below_80_db": ("inside_the_aperture", "fast_receivers"),
    "test_rounding.py::test_one_channel_rounds_no_more_than_many": ("-0.0-0.0065",),
    # A beam's weights: one cubic a block, a cubic a pixel, and a sum that is divided by.
    "test_beam.py::test_an_image_is_the_weighted_sum": (
        "straight", "edges", "moving", "heights", "normalised points", "inverse",
    ),
    "test_beam.py::test_a_window_open_on_all_sides_changes_nothing": (),
    # Ranges of groups of pixels that are corrected along rays.
    "test_corrected_ranges.py::test_corrections_on_every_device": EVERY_CASE,
    # Stages and leaves, in single and in half precision, with filters of each length.
    "test_stages.py::test_the_error_is_what_was_asked_for": ("--20", "--60"),
    "test_stages.py::test_pixels_much_coarser_than_the_resolution": ("--40",),
    "test_stages.py::test_half_precision_adds_what_is_predicted": EVERY_CASE,
    "test_stages.py::test_a_plan_serves_another_device": EVERY_CASE,
    "test_stages.py::test_overlapping_pings_of_a_swaying_array": ("--45-beam", "beam--45"),
    # All of them read buffers that are padded to whole vectors.
    "test_unused_memory.py::test_what_unused_memory_holds_does_not_matter": (
        "exact--80", "factorized", "plane-half",
    ),
    "test_buffers.py::test_the_error_is_as_predicted": ("--60",),
    "test_kernels.py::test_the_vector_widths_give_their_values": EVERY_CASE,
    # Plans know a device's width, without running anything.
    "test_planner.py::test_half_precision_is_for_tolerances_and_devices_that_allow_it": EVERY_CASE,
}  # fmt: skip
"""Tests that run on every way to drive a CPU: cases, by a part of their names, that do so there."""

SOME_ELSEWHERE = {
    "test_accuracy.py::test_exact": (
        "flat spectrum", "relief", "bistatic", "moving", "normalised", "lines of different starts",
        "30 kHz on the carrier", "one channel",
    ),
    "test_accuracy.py::test_factorized": (
        "flat spectrum", "relief of 10 cm rms--50", "moving receivers--35",
        "normalised, squint 3 degrees--50", "sway of 2 cm rms--50",
        "closed track, 300 channels--50",
    ),
    "test_rounding.py::test_the_origin_of_coordinates_does_not_matter": (
        "thesis", "moving_over_height_map",
    ),
}  # fmt: skip
"""Tests of which some cases run on platforms other than the default one; of others all do."""


EVERY_CHANGE = (
    "test_buffers.py", "test_device.py", "test_kernels.py", "test_unused_memory.py",
    "test_stages.py::test_overlapping_pings_of_a_swaying_array",
)  # fmt: skip
"""Tests whose repetitions run for every change; those of others run with all tests only."""


def repeated_in(test, case, name):
    """Mark of a test's case, both by name, on a device that is not the default one, or None."""
    cases = EVERY_VARIANT[test] if name in OTHERS else SOME_ELSEWHERE.get(test, EVERY_CASE)
    if not any(part in case for part in cases):
        return None
    return "slow" if test.startswith(EVERY_CHANGE) else "exhaustive"
