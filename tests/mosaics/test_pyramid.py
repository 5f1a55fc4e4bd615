import numpy as np
import pytest

from clsas.mosaics.pyramid import block_means, decibels, eight_bits

VALUES = np.arange(1.0, 16.0).reshape(3, 5)


@pytest.mark.parametrize(
    ("blocks", "expected"),
    [
        ((2, 2), [[4.0, 6.0, 7.5], [11.5, 13.5, 15.0]]),
        ((1, 2), [[1.5, 3.5, 5.0], [6.5, 8.5, 10.0], [11.5, 13.5, 15.0]]),
        ((2, 1), [[3.5, 4.5, 5.5, 6.5, 7.5], [11.0, 12.0, 13.0, 14.0, 15.0]]),
        ((3, 5), [[8.0]]),
        ((4, 9), [[8.0]]),
    ],
)
@pytest.mark.parametrize("dtype", [np.float32, np.complex64])
def test_blocks_at_the_ends_of_other_sides_are_smaller(blocks, expected, dtype):
    found = block_means("pixels", VALUES.astype(dtype), 1.0, *blocks)
    assert found.dtype == np.result_type(dtype, np.float64)
    np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.parametrize("hidden", [0.0, np.nan, 1e30])
def test_only_pixels_that_received_something_count(hidden):
    received = np.array([[1, 1, 0], [0, 1, 0], [1, 0, 1]], bool)
    values = np.where(received, [[1.0, 2, 0], [0, 6, 0], [4, 0, 5]], hidden)
    found = block_means("pixels", values, received)
    np.testing.assert_allclose(found, [[3.0, 0.0], [4.0, 5.0]])


@pytest.mark.parametrize(
    ("kind", "expected"), [("height_m", [[3.0, np.nan], [4.0, 5.0]]), ("sd_m", None)]
)
def test_only_heights_that_are_known_count(kind, expected):
    values = np.array([[1.0, 2, np.nan], [np.nan, 6, np.nan], [4, np.nan, 5]])
    root_of_squares = [[np.sqrt(41 / 3), np.nan], [4.0, 5.0]]
    np.testing.assert_allclose(block_means(kind, values), expected or root_of_squares)


def test_amplitudes_are_averaged_by_power():
    found = block_means("amplitude", np.array([[3e-30, 1e-30], [0, 0]], np.float32))
    np.testing.assert_allclose(found, [[np.sqrt(5) * 1e-30]])


def test_weights():
    found = block_means("height_m", np.array([[1.0, 4.0]]), np.array([[3.0, 1.0]]))
    np.testing.assert_allclose(found, [[1.75]])


def test_blocks_of_which_too_little_is_known_have_no_value():
    values = np.array([[2.0, 2.0, 2.0, 0.0], [0.0, 0.0, 0.0, 0.0]])
    assert block_means("amplitude", values, least=2.0).tolist() == [[2.0, 0.0]]


def test_8_bit_levels_are_steps_of_decibels_below_the_reference():
    amplitude = np.array([0.0, 1e-40, 0.002, 0.2, 1.99, 2.0, 5.0])
    level = decibels(amplitude, 2.0)
    np.testing.assert_array_equal(np.isnan(level), amplitude == 0)
    np.testing.assert_allclose(level[2:4], [-60, -20])
    found = eight_bits(amplitude, 2.0, 0.5)
    assert found.dtype == np.uint8
    assert found.tolist() == [0, 1, 135, 215, 255, 255, 255]
