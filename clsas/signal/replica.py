"""Measured replicas of the transmitted pulse."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsas.core import reprs, validate
from clsas.core.extras import needed


@dataclass(frozen=True, eq=False)
class Replica:
    """Pulse as it was measured: in a tank, at a hydrophone, or through a loop of the electronics.

    Sample n was taken n/sample_rate_hz after the start of transmission. A point of amplitude A in
    the compressed lines is an echo of A times these samples.

    Parameters
    ----------
    samples : array_like of complex, [length]
        Complex baseband, relative to the carrier of the echoes.
    sample_rate_hz : float
        Samples per second; may differ from that of the echoes.

    Raises
    ------
    TypeError, ValueError
        If the samples are real (form the analytic signal and mix it down first), not finite, all
        zero or fewer than two, or the rate is not positive.
    """

    samples: NDArray[np.complex128]
    sample_rate_hz: float

    if TYPE_CHECKING:  # arrays are converted: the constructor takes what holds numbers

        def __init__(self, samples: ArrayLike, sample_rate_hz: float) -> None: ...

    def __post_init__(self) -> None:
        """Check every field and convert it."""
        if not np.iscomplexobj(validate.real_or_complex("samples", self.samples)):
            raise TypeError(
                "samples must be complex numbers, relative to the carrier, got real ones: form the "
                "analytic signal (scipy.signal.hilbert) and multiply it by exp(-2j pi carrier t)"
            )
        samples = validate.array("samples", self.samples, np.complex128, (None,))
        if len(samples) < 2 or not samples.any():
            raise ValueError(
                "samples must be at least 2 and not all zero, "
                f"got {len(samples)} with the maximum {np.abs(samples).max():g}"
            )
        object.__setattr__(self, "samples", samples)
        rate = validate.positive("sample_rate_hz", self.sample_rate_hz, "Hz")
        object.__setattr__(self, "sample_rate_hz", rate)

    def __repr__(self) -> str:
        """Return length and rate: the array is long."""
        return reprs.summary(
            self,
            f"{len(self.samples)} samples at {reprs.quantity(self.sample_rate_hz, 'Hz')}",
        )

    @property
    def duration_s(self) -> float:
        """Time from the first to the last sample."""
        return (len(self.samples) - 1) / self.sample_rate_hz

    def spectrum(self, frequency_hz: ArrayLike) -> NDArray[np.complex128]:
        """Return P(f), the sum of p_n exp(-j 2 pi f t_n) over the sample rate, in seconds.

        Frequencies are relative to the carrier, within half the sample rate.

        Raises
        ------
        TypeError, ValueError
            If the frequencies are not finite real numbers.
        """
        with needed("pulse compression"):
            import finufft  # slow to import

        frequency = validate.array("frequency_hz", frequency_hz, np.float64, None)
        cycles = frequency.ravel() / self.sample_rate_hz
        # The transform counts from the middle of the samples.
        middle = len(self.samples) // 2
        values = finufft.nufft1d2(2 * np.pi * cycles, self.samples, isign=-1, eps=1e-13, nthreads=1)
        values = values * np.exp(-2j * np.pi * cycles * middle) / self.sample_rate_hz
        return np.reshape(values, frequency.shape)
