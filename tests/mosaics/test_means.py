import numpy as np
import pytest

from clsas.mosaics.means import block_means

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
@pytest.mark.parametrize("dtype", [np.float32, np.complex128])
def test_blocks_at_the_ends_of_other_sides_are_smaller(blocks, expected, dtype):
    found = block_means(VALUES.astype(dtype), np.ones(VALUES.shape), *blocks)
    assert found.dtype == dtype
    np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.parametrize("hidden", [0.0, np.nan, 1e30])
@pytest.mark.parametrize("empty", [0.0, np.nan])
def test_only_what_was_received_counts(hidden, empty):
    received = np.array([[1, 1, 0], [0, 1, 0], [1, 0, 1]], bool)
    values = np.where(received, [[1.0, 2, 0], [0, 6, 0], [4, 0, 5]], hidden)
    found = block_means(values, received, empty=empty)
    np.testing.assert_allclose(found, [[3.0, empty], [4.0, 5.0]])


def test_weights():
    found = block_means(np.array([[1.0, 4.0]]), np.array([[3.0, 1.0]]))
    np.testing.assert_allclose(found, [[1.75]])
