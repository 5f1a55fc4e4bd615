import numpy as np
import pytest

from clsas.image import holds_any


@pytest.mark.parametrize("shape", [(1,), (3, 5), (300, 400), (70_000,)])
def test_any_pixel_is_found_wherever_it_is(shape):
    pixels = np.zeros(shape, np.complex64)
    assert not holds_any(pixels)
    for index in (0, pixels.size // 2, pixels.size - 1):
        pixels.reshape(-1)[index] = 1e-30j
        assert holds_any(pixels)
        pixels[:] = 0
