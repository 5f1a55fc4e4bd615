"""Files damaged at random, and what loading them comes to."""

import numpy as np

import clsas


def refused(whole, path, *, number, flips, within=None):
    """How many of `number` damaged copies of a file are refused; each by an error that names it.

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
    """The message of the one error that loading a file may end in, or None."""
    try:
        clsas.load(path)
    except (ValueError, TypeError) as error:
        return str(error)
    return None
