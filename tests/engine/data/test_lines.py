import dataclasses

import numpy as np
import pytest

from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Image
from clsas.engine.data.lines import RangeLines
from clsas.engine.signal.echoes import Echoes


def make(**changes):
    rng = np.random.default_rng(1)
    fields = {
        "samples": rng.normal(size=(4, 6)) + 1j * rng.normal(size=(4, 6)),
        "first_range_m": [10.0, 11.0, 12.0, 13.0],
        "range_step_m": 0.25,
        "tx_m": rng.normal(size=(4, 3)),
        "rx_m": rng.normal(size=(4, 3)),
        "carrier_hz": 120e3,
        "sound_speed_m_s": 1500.0,
    }
    return RangeLines(**(fields | changes))


def test_types_and_shapes():
    lines = make()
    assert (lines.channels, lines.length) == (4, 6)
    assert lines.samples.dtype == np.complex64
    assert lines.samples.flags.c_contiguous
    assert lines.tx_m.dtype == lines.rx_m.dtype == lines.first_range_m.dtype == np.float64
    assert lines.rx_velocity_m_s is None
    assert lines.wavenumber_rad_m == pytest.approx(2 * np.pi / 0.0125, rel=1e-15)
    np.testing.assert_array_equal(lines.last_range_m, [11.25, 12.25, 13.25, 14.25])


def test_one_value_stands_for_every_channel():
    lines = make(first_range_m=5, tx_m=[1, 2, 3], rx_velocity_m_s=[2.0, 0, 0])
    np.testing.assert_array_equal(lines.first_range_m, [5.0] * 4)
    np.testing.assert_array_equal(lines.tx_m, [[1.0, 2, 3]] * 4)
    np.testing.assert_array_equal(lines.rx_velocity_m_s, [[2.0, 0, 0]] * 4)


def test_look_directions_become_unit_vectors_once():
    lines = make(look_direction=[0, 3, -4])
    np.testing.assert_allclose(lines.look_direction, [[0, 0.6, -0.8]] * 4, atol=1e-16)
    assert not lines.look_direction.flags.writeable
    again = dataclasses.replace(lines, carrier_hz=1e5)
    assert again.look_direction.tobytes() == lines.look_direction.tobytes()
    huge = make(look_direction=np.array([[1e300, 1e300, 0], [1e-300, 0, 0], [0, 0, 9], [1, 0, 0]]))
    np.testing.assert_allclose(np.linalg.norm(huge.look_direction, axis=1), 1)


def test_carrier_may_be_zero():
    assert make(carrier_hz=0).wavenumber_rad_m == 0


def test_non_contiguous_samples_are_converted():
    samples = np.asfortranarray(make().samples)
    lines = make(samples=samples)
    assert lines.samples.flags.c_contiguous
    np.testing.assert_array_equal(lines.samples, samples)


def test_it_cannot_be_changed():
    samples = np.ones((4, 6), np.complex64)
    lines = make(samples=samples)
    with pytest.raises(ValueError, match="read-only"):
        lines.samples[0, 0] = 0
    with pytest.raises(dataclasses.FrozenInstanceError):
        lines.carrier_hz = 1.0
    samples[0, 0] = 2  # the caller's array stays writeable


@pytest.mark.parametrize(
    "channels", [slice(1, 3), [1, 2], np.array([False, True, True, False]), np.array([1, 2])]
)
def test_select(channels):
    lines = make(rx_velocity_m_s=np.arange(12.0).reshape(4, 3), look_direction=np.eye(4, 3) + 1)
    some = lines.select(channels)
    for field in dataclasses.fields(lines):
        before, after = getattr(lines, field.name), getattr(some, field.name)
        np.testing.assert_array_equal(after, before[1:3] if np.ndim(before) else before)


def test_select_shares_the_samples_of_a_slice():
    lines = make()
    assert np.shares_memory(lines.select(slice(1, 3)).samples, lines.samples)


def test_select_keeps_the_axis_of_one_channel():
    assert make().select(2).samples.shape == (1, 6)


def test_select_refuses_nothing_and_beyond():
    with pytest.raises(ValueError, match="channels must select at least one line, got none"):
        make().select(slice(2, 2))
    with pytest.raises(ValueError, match="channels must select at least one line, got none"):
        make().select([])
    with pytest.raises(TypeError, match=r"channels must be a slice, whole .* got \[1\.5\]"):
        make().select([1.5])
    with pytest.raises(ValueError, match="channels must be from"):
        make().select([4])


def with_bad(shape, value):
    array = np.zeros(shape)
    array.flat[-1] = value
    return array


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"samples": np.ones((4, 6))}, TypeError, "samples must be complex.*no phase"),
        ({"samples": np.ones(6, complex)}, ValueError, "samples must have shape"),
        ({"samples": np.ones((0, 6), complex)}, ValueError, "samples.*no empty axis"),
        ({"samples": np.ones((4, 0), complex)}, ValueError, "samples.*no empty axis"),
        ({"samples": with_bad((4, 6), np.nan) + 0j}, ValueError, "samples must be finite"),
        ({"samples": with_bad((4, 6), np.inf) + 0j}, ValueError, "samples must be finite"),
        ({"samples": np.ones((3, 6), complex)}, ValueError, r"first_range_m.*\(3\).*\(4,\)"),
        ({"first_range_m": np.nan}, ValueError, "first_range_m must be finite"),
        ({"first_range_m": [1.0, 2.0]}, ValueError, "first_range_m must have shape"),
        ({"range_step_m": 0.0}, ValueError, "range_step_m must be finite and > 0 m, got 0"),
        ({"range_step_m": -0.1}, ValueError, "range_step_m"),
        ({"range_step_m": [0.1, 0.1]}, TypeError, "range_step_m must be one real number in m"),
        ({"tx_m": np.zeros((5, 3))}, ValueError, r"tx_m must have shape \(4, 3\)"),
        ({"rx_m": 0.0}, ValueError, r"rx_m must have shape \(4, 3\)"),
        ({"rx_m": with_bad((4, 3), np.inf)}, ValueError, "rx_m must be finite"),
        ({"tx_m": np.zeros((4, 3), complex)}, TypeError, "tx_m must be real"),
        ({"carrier_hz": -1.0}, ValueError, "carrier_hz must be finite and >= 0 Hz"),
        ({"carrier_hz": "1 MHz"}, TypeError, "carrier_hz must be one real number in Hz"),
        ({"sound_speed_m_s": 0}, ValueError, "sound_speed_m_s must be finite and > 0 m/s"),
        ({"sound_speed_m_s": np.nan}, ValueError, "sound_speed_m_s"),
        ({"rx_velocity_m_s": [1.0, 2.0]}, ValueError, "rx_velocity_m_s must have shape"),
        ({"rx_velocity_m_s": [0, 1500.0, 0]}, ValueError, "rx_velocity_m_s must be.* < 1500 m/s"),
        ({"look_direction": "port"}, TypeError, "look_direction must be real numbers"),
        ({"look_direction": [0.0, 1.0]}, ValueError, r"look_direction must have shape \(4, 3\)"),
        ({"look_direction": np.eye(4, 3)}, ValueError, "look_direction must not have .* length 0"),
    ],
)
def test_bad_input_is_named(changes, error, words):
    with pytest.raises(error, match=words):
        make(**changes)


def test_it_is_shown_in_one_line():
    text = repr(make())
    assert text.startswith("RangeLines(4 channels of ")
    assert len(text) < 200


def test_samples_that_float32_does_not_hold_are_refused():
    for scale in (1e-50, 1e50):
        samples = scale * np.ones((2, 3), np.complex128)
        with pytest.raises(
            ValueError, match=r"samples must have .* got 1e[+-]50: scale the values"
        ):
            RangeLines(samples, 1.0, 0.1, (0, 0, 0), (0, 0, 0), 1e5, 1500.0)
        with pytest.raises(ValueError, match="scale the values"):
            Echoes(samples, 0.0, 1e5, 1e5, (0, 0, 0), (0, 0, 0), 1500.0)
        with pytest.raises(ValueError, match="scale the values"):
            Echoes(samples.real, 0.0, 1e5, 1e5, (0, 0, 0), (0, 0, 0), 1500.0)
        with pytest.raises(ValueError, match="scale the values"):
            Image(samples, Grid.plane((0, 1, 3), (0, 1, 2)))
