"""Measured replicas of the transmitted pulse."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsas.engine.data import reprs, validate
from clsas.engine.data.fourier import fourier_series
from clsas.engine.data.validate import ArgumentError, ArgumentTypeError


@dataclass(frozen=True, eq=False)
class Replica:
    """Pulse as measured in a tank, at a hydrophone, or through a loop of the electronics.

    Sample n was taken n/sample_rate_hz after the start of transmission. An echo that equals A times
    these samples becomes a point of amplitude A in the compressed lines.

    Parameters
    ----------
    samples : array_like of complex, [length]
        Complex baseband, relative to the carrier of the echoes.
    sample_rate_hz : float
        Sample rate, hertz. It may differ from that of the echoes.

    Raises
    ------
    TypeError, ValueError
        If the samples are real (form the analytic signal and mix it down first), not finite, all
        zero or fewer than two, or the rate is not positive.

    See Also
    --------
    compress : Compression of echoes, which accepts a replica.

    Examples
    --------
    >>> import clsas
    >>> import numpy as np
    >>> pulse = clsas.Pulse(carrier_hz=100e3, bandwidth_hz=20e3, duration_s=1e-3)
    >>> clsas.Replica(pulse.envelope(np.arange(50) / 50e3), 50e3)
    Replica(50 samples at 50 kHz)
    """

    samples: NDArray[np.complex128]
    sample_rate_hz: float

    def __post_init__(self) -> None:
        """Check every field and convert it."""
        if not np.iscomplexobj(validate.real_or_complex("samples", self.samples)):
            raise ArgumentTypeError(
                "samples",
                "be complex numbers, relative to the carrier",
                "real ones",
                "form the analytic signal (`scipy.signal.hilbert`) and multiply it by "
                "exp(-2j pi carrier t)",
            )
        samples = validate.array("samples", self.samples, np.complex128, (None,))
        if len(samples) < 2 or not samples.any():
            given = f"{len(samples)} with a largest amplitude of {np.abs(samples).max():g}"
            raise ArgumentError("samples", "be at least 2 and not all zero", given)
        object.__setattr__(self, "samples", samples)
        rate = validate.positive("sample_rate_hz", self.sample_rate_hz, "Hz")
        object.__setattr__(self, "sample_rate_hz", rate)

    def __repr__(self) -> str:
        """Return length and rate, because the array is long."""
        return reprs.summary(
            self,
            f"{len(self.samples)} samples at {reprs.quantity(self.sample_rate_hz, 'Hz')}",
        )

    @property
    def duration_s(self) -> float:
        """Time from the first to the last sample, seconds."""
        return (len(self.samples) - 1) / self.sample_rate_hz

    def spectrum(self, frequency_hz: ArrayLike) -> NDArray[np.complex128]:
        """Return P(f), the sum of p_n exp(-j 2 pi f t_n) divided by the sample rate, seconds.

        Parameters
        ----------
        frequency_hz : array_like
            Frequencies relative to the carrier, within half the sample rate, hertz.

        Raises
        ------
        TypeError, ValueError
            If the frequencies are not finite real numbers.
        """
        frequency = validate.array("frequency_hz", frequency_hz, np.float64, None)
        cycles = frequency.ravel() / self.sample_rate_hz
        values = fourier_series(self.samples, -cycles) / self.sample_rate_hz
        return np.reshape(values, frequency.shape)
