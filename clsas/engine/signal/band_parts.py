"""Range lines of parts of their band, whose images are independent looks at a scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import fft

from clsas.engine.data import validate
from clsas.engine.data.fourier import filtered
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.validate import ArgumentError
from clsas.engine.signal.spectrum import measure_spectrum

_MOST = 64  # parts of a band: a plain choice, far beyond what leaves any resolution


def sub_bands(lines: RangeLines, count: int) -> tuple[RangeLines, ...]:
    """Return range lines of equal parts of the occupied band, from low to high frequencies.

    Images of the parts resolve `count` times less in range. Their speckle is nearly independent, so
    that `multilook` reduces it. The lines of all parts add up to the lines given.

    Parameters
    ----------
    lines : RangeLines
        Lines whose band is divided.
    count : int
        Number of parts, 2 to 64.

    Returns
    -------
    tuple of RangeLines
        Lines with the carrier and the range step of those given.

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type, the number is outside its limits, a part would contain
        less than one cycle per line, or the lines do not fit into memory.

    See Also
    --------
    multilook : Mean power of several images.

    Notes
    -----
    The occupied band is measured, and divided into parts of equal width. From the middle of a part
    to that of the next, the filter of the one falls as the squared cosine that the other lacks to
    1, so that inner parts have Hann windows, whose side lobes in range are -31 dB. With edges that
    are steep, bright echoes would fill the shadows beside them. Neighbouring parts have a
    correlation of 1/6, and their intensities one of 1/36. Frequencies below the band belong to the
    first part, and those above it to the last.

    Examples
    --------
    >>> import clsas
    >>> import numpy as np
    >>> tx_m = [[0, 0, 0], [0.5, 0, 0]]
    >>> scene = clsas.PointTargets([[0, 40, 0]])
    >>> lines = clsas.simulate_lines(tx_m, tx_m, scene, carrier_hz=100e3, bandwidth_hz=30e3)
    >>> low, high = clsas.sub_bands(lines, 2)
    >>> bool(np.allclose(low.samples + high.samples, lines.samples, atol=1e-6))
    True
    >>> f"{np.abs(low.samples).max() / np.abs(lines.samples).max():.2f}"
    '0.50'
    """
    validate.instance("lines", lines, RangeLines)
    count = validate.count("count", count, least=2, most=_MOST)
    found = measure_spectrum(lines)
    width = 1 / max(found.oversampling, 1.0)  # cycles per sample
    if width * lines.length < count:
        most = f"{int(width * lines.length)} parts of lines of {lines.length} samples"
        raise ArgumentError("count", f"leave a cycle per line in every part, at most {most}", count)
    padded = fft.next_fast_len(2 * lines.length)
    # Lines, and their filters, of which three arrays exist while they are computed.
    validate.memory("count", 8 * count * (lines.samples.size + 3 * padded))
    distance = np.mod(fft.fftfreq(padded) - found.centre + 0.5, 1.0) - 0.5
    place = ((distance / width + 0.5) * count).clip(0.5, count - 0.5) - 0.5  # in middles of parts
    from_middle = np.abs(place - np.arange(count)[:, None])
    responses = np.cos(np.pi / 2 * np.minimum(from_middle, 1)) ** 2
    return tuple(replace(lines, samples=each) for each in filtered(lines.samples, responses))
