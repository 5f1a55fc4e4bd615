"""Files that are damaged at random, and the outcome of loading them."""

import numpy as np

import clsas


def refused(whole, path, *, number, flips, within=None):
    """Return how many of `number` damaged copies are refused, each with an error that names it.

    A copy is cut, or has `flips` bits changed in its first `within` bytes. The others load.
    """
    random = np.random.default_rng(1)
    count = 0
    for _ in range(number):
        content = bytearray(whole)
        if random.random() < 0.3:
            content = content[: random.integers(len(content))]
        else:
            for place in random.integers(0, within or len(content), flips):
                content[place] ^= 1 << random.integers(8)
        path.write_bytes(content)
        said = message_of(path)
        assert said is None or path.name in said
        count += said is not None
    return count


def message_of(path):
    """Return the message of the error that loading a file raises, or None if it is loaded."""
    try:
        clsas.load(path)
    except (ValueError, TypeError) as error:
        return str(error)
    return None
