import numpy as np
import pytest

from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Image, holds_any


@pytest.mark.parametrize("shape", [(1,), (3, 5), (300, 400), (70_000,)])
def test_any_pixel_is_found_wherever_it_is(shape):
    pixels = np.zeros(shape, np.complex64)
    assert not holds_any(pixels)
    for index in (0, pixels.size // 2, pixels.size - 1):
        pixels.reshape(-1)[index] = 1e-30j
        assert holds_any(pixels)
        pixels[:] = 0


PIXELS = np.arange(6).reshape(2, 3) + 1j
IMAGE = Image(PIXELS, Grid.plane((0, 1, 3), (0, 1, 2)))


def test_numpy_takes_an_image_as_its_pixels():
    assert np.asarray(IMAGE).dtype == np.complex64
    assert np.shares_memory(np.asarray(IMAGE), IMAGE.pixels)
    np.testing.assert_array_equal(IMAGE, PIXELS)
    np.testing.assert_allclose(np.abs(IMAGE), np.abs(PIXELS), rtol=1e-6)
    assert np.asarray(IMAGE, np.complex128).dtype == np.complex128


def test_a_copy_is_made_when_asked_for():
    copied = np.array(IMAGE)
    copied[:] = 0  # may be written, unlike the image's own
    assert np.asarray(IMAGE).any()
    assert not np.shares_memory(IMAGE.__array__(copy=True), IMAGE.pixels)
    assert np.shares_memory(IMAGE.__array__(copy=False), IMAGE.pixels)
    with pytest.raises(ValueError, match="copy must not be False if complex64 is to become"):
        IMAGE.__array__(np.complex128, copy=False)


def test_phases_are_not_lost():
    with pytest.raises(TypeError, match="dtype must be complex, as pixels are, got float64"):
        np.asarray(IMAGE, float)


def test_levels_are_in_decibels():
    level = IMAGE.db()
    assert level.dtype == np.float32
    np.testing.assert_allclose(
        level, 20 * np.log10(np.abs(PIXELS) / np.abs(PIXELS).max()), atol=1e-5
    )
    np.testing.assert_allclose(
        IMAGE.db(reference=2.0), 20 * np.log10(np.abs(PIXELS) / 2), atol=1e-5
    )
    assert IMAGE.shape == level.shape == (2, 3)


def test_levels_of_nothing_are_infinitely_low():
    pixels = np.array([[0, 1e-30, 1]], complex)
    np.testing.assert_allclose(
        Image(pixels, Grid.plane((0, 1, 3), (0, 0, 1))).db(), [[-np.inf, -600, 0]], atol=1e-3
    )
    nothing = Image(0 * PIXELS, IMAGE.grid)
    for reference in (None, 3.0):
        assert (nothing.db(reference=reference) == -np.inf).all()


@pytest.mark.parametrize("reference", [0, -1, np.nan, np.inf])
def test_a_reference_is_positive(reference):
    with pytest.raises(ValueError, match="reference must be finite and > 0"):
        IMAGE.db(reference=reference)
    with pytest.raises(TypeError, match="reference must be one real number"):
        IMAGE.db(reference="max")
