"""Arrays that images of one geometry have in common, kept while they take little memory."""

from __future__ import annotations

from collections.abc import Callable

from numpy.typing import NDArray

Arrays = dict[str, NDArray]
Key = tuple[int, ...]


class Kept:
    """Arrays by the parts and channels that they are for, up to some memory in all.

    Parameters
    ----------
    most_bytes : int
        Most memory of all arrays. What does not fit is computed anew each time.
    """

    def __init__(self, most_bytes: int) -> None:
        self._arrays: dict[Key, Arrays] = {}
        self._free_bytes = most_bytes

    def get(self, key: Key, compute: Callable[[], Arrays]) -> Arrays:
        """Return the arrays of a key, which nobody may change; `compute` makes them."""
        found = self._arrays.get(key)
        if found is None:
            found = compute()
            size = sum(array.nbytes for array in found.values())
            if size <= self._free_bytes:
                self._arrays[key], self._free_bytes = found, self._free_bytes - size
        return found
