"""Raw echoes, before pulse compression."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import reprs, validate
from clsas.engine.data.georeference import Georeference
from clsas.engine.data.lines import checked_channels
from clsas.engine.data.sound_speed import SoundSpeed
from clsas.engine.data.system import Pulse
from clsas.engine.data.validate import ArgumentError


@dataclass(frozen=True, eq=False)
class Echoes:
    """Raw echoes of every channel, with the channels' geometry.

    Sample n of channel i was taken start_time_s[i] + n/sample_rate_hz after the start of
    transmission. In complex baseband, a point of amplitude A at the two-way delay tau gives
    A p(t - tau) exp(-j 2 pi fc tau), where p is the envelope of the pulse and fc the carrier. In
    passband it gives the real part of A p(t - tau) exp(+j 2 pi fc (t - tau)).

    Parameters
    ----------
    samples : array_like, [channels, length]
        Complex baseband (stored as complex64), or real passband (stored as float32).
    start_time_s : array_like, [channels] or scalar
        Time of the first sample after the start of transmission, seconds.
    sample_rate_hz : float
        Sample rate, hertz.
    carrier_hz : float
        Frequency by which complex samples were mixed down, hertz. For real samples, the frequency
        of their carrier.
    tx_m, rx_m : array_like, [channels, 3] or [3]
        Transmitter and receiver positions at transmission, metres.
    sound_speed_m_s : float
        Speed of sound, metres per second.
    pulse : Pulse, optional
        Transmitted pulse, with the same carrier as the samples. Leave it out if the pulse is too
        short to need compression.
    rx_velocity_m_s : array_like, [channels, 3] or [3], optional
        Velocity of the receivers while the sound travels, metres per second. None means
        stop-and-hop.
    look_direction : array_like, [channels, 3] or [3], optional
        Direction in which the beam of each channel looks, as for `RangeLines`.
    georeference : Georeference, optional
        Where the coordinates lie on Earth.
    bank_numbers : array_like of int, [channels], optional
        Receiver bank of each channel, as for `RangeLines`.
    sound_speed : SoundSpeed, optional
        Sound speed over depth, as for `RangeLines`.

    Raises
    ------
    TypeError, ValueError
        If an array has the wrong type or shape, is empty or not finite, a number is outside its
        limits, the pulse has another carrier, or the largest sample is too large or too small for
        float32.

    See Also
    --------
    compress : Range lines of echoes.
    simulate : Echoes of a scene.

    Examples
    --------
    >>> import clsas
    >>> import numpy as np
    >>> samples = np.zeros((4, 1000), complex)
    >>> clsas.Echoes(samples, 0.0, 60e3, 100e3, [0, 0, 0], [0, 0, 0], 1500.0)
    Echoes(4 channels of 1000 samples at 60 kHz, carrier 100 kHz)
    """

    samples: NDArray[np.complex64] | NDArray[np.float32]
    start_time_s: NDArray[np.float64]
    sample_rate_hz: float
    carrier_hz: float
    tx_m: NDArray[np.float64]
    rx_m: NDArray[np.float64]
    sound_speed_m_s: float
    pulse: Pulse | None = None
    rx_velocity_m_s: NDArray[np.float64] | None = None
    look_direction: NDArray[np.float64] | None = None
    georeference: Georeference | None = None
    bank_numbers: NDArray[np.int64] | None = None
    sound_speed: SoundSpeed | None = None

    def __post_init__(self) -> None:
        """Check every field and convert it."""

        def put(name: str, value: object) -> None:
            object.__setattr__(self, name, value)

        samples = validate.real_or_complex("samples", self.samples, np.complex64, (None, None))
        put("samples", samples)
        put("sample_rate_hz", validate.positive("sample_rate_hz", self.sample_rate_hz, "Hz"))
        for name, value in checked_channels(self, "start_time_s").items():
            put(name, value)
        if self.pulse is not None:
            validate.instance("pulse", self.pulse, Pulse)
            if self.pulse.carrier_hz != self.carrier_hz:
                allowed = f"be the pulse's {self.pulse.carrier_hz:g} Hz"
                raise ArgumentError("carrier_hz", allowed, f"{self.carrier_hz:g} Hz")

    def __repr__(self) -> str:
        """Return sizes and rates, because the arrays are long."""
        return reprs.summary(
            self,
            f"{self.channels} channels of {self.length} samples at "
            f"{reprs.quantity(self.sample_rate_hz, 'Hz')}",
            f"carrier {reprs.quantity(self.carrier_hz, 'Hz')}",
        )

    @property
    def channels(self) -> int:
        """Number of channels."""
        return self.samples.shape[0]

    @property
    def length(self) -> int:
        """Samples per channel."""
        return self.samples.shape[1]

    @property
    def is_passband(self) -> bool:
        """True if the samples are real and still on their carrier."""
        return self.samples.dtype.kind == "f"
