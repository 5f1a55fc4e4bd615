"""Sonars: the pulse, and the elements with their positions on the platform.

Equations in brackets are those of the thesis (Ødegaard 2004).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsas.engine.data import reprs, validate
from clsas.engine.data.declared import Number, check_fields
from clsas.engine.data.fourier import fourier_integral
from clsas.engine.data.lines import bank_members, banks_of, checked_bank_numbers
from clsas.engine.data.sound_speed import USUAL_M_S
from clsas.engine.data.validate import ArgumentError

BARKER_13 = (1, 1, 1, 1, 1, -1, -1, 1, 1, -1, 1, -1, 1)

PASSBAND = 0.8
"""Share of the sampled band that the receiver passes unchanged. Above it, the anti-alias filter
falls smoothly to zero at half the sample rate."""

# Length of a pulse, and cycles of its band within it, from which on together milliseconds are
# taken for seconds. Pulses of 30 kHz last up to 20 ms (600 cycles), those of 1 kHz up to 4 s, and
# those of radars far below a millisecond.
_LONG_S, _MOST_PRODUCT = 0.1, 20_000.0


@dataclass(frozen=True)
class Pulse:
    """Transmitted pulse: a linear chirp or a binary phase code.

    The pulse lasts from t = 0 to `duration_s`. Its complex envelope p(t), relative to the carrier,
    has amplitude 1 (Ødegaard 2004, equation [5] and section 2.1).

    Parameters
    ----------
    carrier_hz : float
        Centre frequency, hertz.
    bandwidth_hz : float
        Bandwidth of a chirp, or chips/duration of a phase code, hertz. At most twice `carrier_hz`.
    duration_s : float
        Length of the pulse, seconds.
    code : {"up", "down"} or tuple of +1 and -1
        Chirp with rising or falling frequency, or the chips of a binary phase code.
    taper : float
        Fraction of the duration, 0 to 1, with a cosine (Tukey) taper, half of it at each end. With
        0 the envelope is rectangular.

    Raises
    ------
    TypeError, ValueError
        If a value is not a number or is outside its limits, or chips are not +1 and -1.

    Examples
    --------
    A chirp of 1 ms and 20 kHz on 100 kHz, and a Barker code of the same length:

    >>> import clsas
    >>> clsas.Pulse(carrier_hz=100e3, bandwidth_hz=20e3, duration_s=1e-3)
    Pulse(carrier 100 kHz, bandwidth 20 kHz, duration 1 ms, code 'up', taper 0)
    >>> clsas.Pulse.phase_code(100e3, 1e-3).bandwidth_hz
    13000.0
    """

    carrier_hz: Annotated[float, Number("Hz", above=0.0, help="Centre frequency.")]
    bandwidth_hz: Annotated[
        float, Number("Hz", above=0.0, help="Band that a chirp sweeps.", default="chips/duration")
    ]
    duration_s: Annotated[float, Number("s", above=0.0, help="Length.")]
    code: str | tuple[int, ...] = "up"
    taper: Annotated[
        float,
        Number(
            least=0.0,
            most=1.0,
            help="Share of the duration over which a cosine taper rises and falls.",
        ),
    ] = 0.0

    __repr__ = reprs.of_fields

    def __post_init__(self) -> None:  # noqa: D105
        check_fields(self)
        band, duration = self.bandwidth_hz, self.duration_s
        validate.number("bandwidth_hz", band, "Hz", most=2 * self.carrier_hz)
        if isinstance(self.code, str):
            validate.one_of("code", self.code, ("up", "down"))
        else:
            chips = _chips("code", self.code)
            object.__setattr__(self, "code", chips)
            if not np.isclose(band * duration, len(chips)):
                raise ArgumentError(
                    "bandwidth_hz",
                    f"be chips/duration = {len(chips) / duration:g} Hz for a phase code",
                    f"{band:g} Hz",
                )
        if duration >= _LONG_S and band * duration > _MOST_PRODUCT:
            validate.warn(
                f"`duration_s` is {duration:g} s, {band * duration:.3g} cycles of its band; pulses "
                "of sonars last milliseconds. Give it in seconds, not in milliseconds"
            )

    @classmethod
    def phase_code(
        cls,
        carrier_hz: float,
        duration_s: float,
        chips: tuple[int, ...] = BARKER_13,
        *,
        taper: float = 0.0,
    ) -> Pulse:
        """Return a binary phase code whose chips divide the duration evenly.

        Parameters
        ----------
        carrier_hz : float
            Centre frequency, hertz.
        duration_s : float
            Length of the pulse, seconds.
        chips : tuple of +1 and -1
            The code; by default the Barker code of 13 chips.
        taper : float
            As for `Pulse`.

        Raises
        ------
        TypeError, ValueError
            As for `Pulse`, or if a chip is shorter than half a period of the carrier.
        """
        duration = validate.positive("duration_s", duration_s, "s")
        chips = _chips("chips", chips)
        carrier = validate.positive("carrier_hz", carrier_hz, "Hz")
        if len(chips) > 2 * carrier * duration:
            allowed = f"be at least chips / (2 `carrier_hz`) = {len(chips) / (2 * carrier):g} s"
            raise ArgumentError("duration_s", allowed, f"{duration:g} s")
        return cls(carrier, len(chips) / duration, duration, chips, taper)

    def envelope(self, time_s: ArrayLike) -> NDArray[np.complex128]:
        """Return the complex envelope p(t), which is zero before t = 0 and after the duration.

        Parameters
        ----------
        time_s : array_like
            Times from the start of the pulse, seconds.

        Raises
        ------
        TypeError, ValueError
            If the times are not finite real numbers.
        """
        t = validate.array("time_s", time_s, np.float64, None)
        duration = self.duration_s
        inside = (t >= 0) & (t <= duration)
        if isinstance(self.code, str):
            rate = self.bandwidth_hz / duration * (1 if self.code == "up" else -1)
            value = np.exp(1j * np.pi * rate * (t - duration / 2) ** 2)
        else:
            chip = np.clip((t / duration * len(self.code)).astype(int), 0, len(self.code) - 1)
            value = np.asarray(self.code)[chip].astype(np.complex128)
        if self.taper:
            edge = self.taper * duration / 2
            from_end = np.clip(np.minimum(t, duration - t) / edge, 0, 1)
            value = value * np.sin(np.pi / 2 * from_end) ** 2
        return np.where(inside, value, 0)

    def spectrum(self, frequency_hz: ArrayLike) -> NDArray[np.complex128]:
        """Return the spectrum P(f), the integral of p(t) exp(-j 2 pi f t) dt, seconds.

        Parameters
        ----------
        frequency_hz : array_like
            Frequencies relative to the carrier, hertz.

        Raises
        ------
        TypeError, ValueError
            If the frequencies are not finite real numbers, or are so high that the quadrature does
            not fit into memory.

        Notes
        -----
        The quadrature runs between the edges of chips and taper. It is accurate to 1e-12 of the
        largest value returned.
        """
        frequency = validate.array("frequency_hz", frequency_hz, np.float64, None)
        chips = 1 if isinstance(self.code, str) else len(self.code)
        edge = self.taper * self.duration_s / 2
        edges = np.unique(
            np.concatenate(
                [
                    np.linspace(0, self.duration_s, chips + 1),
                    [edge, self.duration_s - edge],
                ]
            )
        )
        return fourier_integral(
            self.envelope, edges, frequency, sign=-1, rate=self.bandwidth_hz / 2
        )


@dataclass(frozen=True, eq=False)
class Sonar:
    """Transmitter and receivers of a platform.

    Positions are in the frame of the platform: x forward, y to port (the side of a broadside beam),
    z up.

    Parameters
    ----------
    pulse : Pulse
        Transmitted pulse.
    rx_m : array_like, [receivers, 3]
        Receiver positions, metres.
    tx_m : array_like, [3]
        Transmitter position, metres; by default the origin.
    sample_rate_hz : float, optional
        Rate of the complex baseband samples, hertz. The default is twice the bandwidth of the
        pulse. It must be at least 1.25 bandwidths, so that the filter of the receiver passes the
        band unchanged.
    sound_speed_m_s : float
        Speed of sound, metres per second.
    tx_length_m, rx_length_m : float, optional
        Element lengths along x, metres. An element without a length is omnidirectional in azimuth.
    tx_height_m, rx_height_m : float, optional
        Element heights, metres. An element without a height is omnidirectional in elevation.
    bank_numbers : array_like of int, [receivers], optional
        Bank of each receiver, for several rows of receivers at different heights: 0 for those of
        the first bank, 1 for the second, and so on. Every bank has the same number of receivers.
        None means that all receivers are one bank.

    Raises
    ------
    TypeError, ValueError
        If a value has the wrong type or shape, is not finite or is outside its limits, or if banks
        are not numbered from 0 or differ in their number of receivers.

    Examples
    --------
    >>> import clsas
    >>> pulse = clsas.Pulse(carrier_hz=100e3, bandwidth_hz=20e3, duration_s=1e-3)
    >>> clsas.Sonar(pulse, rx_m=[[-0.1, 0, 0], [0.1, 0, 0]], rx_length_m=0.2)
    Sonar(2 receivers over 0.2 m, carrier 100 kHz, bandwidth 20 kHz, elements of 0.2 m)

    Two rows of 8 receivers, 0.25 m above each other:

    >>> row_m = clsas.engine.data.system.line_array(8, spacing_m=0.05)
    >>> rx_m = [*row_m, *(row_m + [0, 0, 0.25])]
    >>> clsas.Sonar(pulse, rx_m, bank_numbers=[0] * 8 + [1] * 8)
    Sonar(2 banks of 8 receivers over 0.35 m, carrier 100 kHz, bandwidth 20 kHz)
    """

    pulse: Pulse
    rx_m: NDArray[np.float64]
    tx_m: NDArray[np.float64] = (0.0, 0.0, 0.0)  # type: ignore[assignment]
    sample_rate_hz: float = None  # type: ignore[assignment]
    sound_speed_m_s: Annotated[float, Number("m/s", above=0.0, help="Speed of sound.")] = USUAL_M_S
    tx_length_m: Annotated[
        float | None,
        Number("m", above=0.0, help="Length of the transmitter along x.", default="no directivity"),
    ] = None
    rx_length_m: Annotated[
        float | None,
        Number("m", above=0.0, help="Length of the receivers along x.", default="no directivity"),
    ] = None
    tx_height_m: Annotated[
        float | None,
        Number("m", above=0.0, help="Height of the transmitter.", default="no directivity"),
    ] = None
    rx_height_m: Annotated[
        float | None,
        Number("m", above=0.0, help="Height of the receivers.", default="no directivity"),
    ] = None
    bank_numbers: NDArray[np.int64] | None = None

    def __post_init__(self) -> None:  # noqa: D105
        validate.instance("pulse", self.pulse, Pulse)
        check_fields(self)
        band = self.pulse.bandwidth_hz
        rate = 2 * band if self.sample_rate_hz is None else self.sample_rate_hz
        # A rate of exactly 1.25 bandwidths may be rounded down.
        least = band / PASSBAND * (1 - 1e-12)
        fields: dict[str, Any] = {
            "rx_m": validate.array("rx_m", self.rx_m, np.float64, (None, 3)),
            "tx_m": validate.array("tx_m", self.tx_m, np.float64, (3,)),
            "sample_rate_hz": validate.number("sample_rate_hz", rate, "Hz", least=least),
        }
        if self.bank_numbers is not None:
            fields["bank_numbers"] = _checked_banks(self.bank_numbers, len(fields["rx_m"]))
        for name, value in fields.items():
            object.__setattr__(self, name, value)

    def __repr__(self) -> str:
        """Return the array's size, the pulse's band and the elements' length."""
        pulse, length_m = self.pulse, float(np.ptp(self.rx_m, axis=0).max())
        element_m, each = self.element_length_m, self.receivers // self.banks
        several = f"{self.banks} banks of " if self.banks > 1 else ""
        return reprs.summary(
            self,
            f"{several}{each} receiver{'s' * (each > 1)} over {reprs.quantity(length_m, 'm')}",
            f"carrier {reprs.quantity(pulse.carrier_hz, 'Hz')}",
            f"bandwidth {reprs.quantity(pulse.bandwidth_hz, 'Hz')}",
            None if element_m is None else f"elements of {reprs.quantity(element_m, 'm')}",
        )

    @property
    def receivers(self) -> int:
        """Number of receivers."""
        return len(self.rx_m)

    @property
    def banks(self) -> int:
        """Number of receiver banks."""
        return len(banks_of(self.bank_numbers))

    def bank(self, number: int) -> Sonar:
        """Return the sonar with the receivers of one bank only, whose `bank_numbers` are None.

        Parameters
        ----------
        number : int
            Number of the bank, counted from 0.

        Raises
        ------
        TypeError, ValueError
            If there is no such bank.

        Examples
        --------
        >>> import clsas
        >>> clsas.Sonar.hisas_1030().bank(1).receivers
        32
        """
        index = bank_members(self.bank_numbers, number)
        if self.bank_numbers is None:
            return self
        return replace(self, rx_m=self.rx_m[index], bank_numbers=None)

    def channel_banks(self, pings: int) -> NDArray[np.int64] | None:
        """Return the bank of every channel, [pings * receivers]; None for one bank.

        Parameters
        ----------
        pings : int
            Number of pings. Channels are in ping-major order, as those of `clsas.channels`.

        Raises
        ------
        TypeError, ValueError
            If `pings` is not a positive whole number, or the channels do not fit into memory.
        """
        pings = validate.count("pings", pings)
        validate.memory("pings", 8 * pings * self.receivers)
        return None if self.bank_numbers is None else np.tile(self.bank_numbers, pings)

    @property
    def wavelength_m(self) -> float:
        """Wavelength of the carrier, metres."""
        return self.sound_speed_m_s / self.pulse.carrier_hz

    @property
    def element_length_m(self) -> float | None:
        """Length of the longer element, which has the narrower beam; None if neither has one."""
        lengths = [size for size in (self.tx_length_m, self.rx_length_m) if size is not None]
        return max(lengths, default=None)

    @property
    def is_omnidirectional(self) -> bool:
        """True if no element has a size."""
        sizes = (self.tx_length_m, self.rx_length_m, self.tx_height_m, self.rx_height_m)
        return all(size is None for size in sizes)

    @classmethod
    def thesis_wide_beam(cls) -> Sonar:
        """Return the wide-beam sonar of Ødegaard (2004, chapter 5).

        It has 64 receivers of 15 mm at 1 MHz (wavelength 1.5 mm). The 640 phase centres of 10 pings
        over 5.28 m are 8.25 mm apart, so receivers are 16.5 mm apart and the platform advances
        0.528 m per ping. The thesis gives neither bandwidth nor pulse. A chirp of 1 ms and 100 kHz
        is chosen here, which resolves 7.5 mm in range, as the elements do in azimuth.
        """
        pulse = Pulse(carrier_hz=1e6, bandwidth_hz=100e3, duration_s=1e-3)
        return cls(pulse, line_array(64, 16.5e-3), tx_length_m=15e-3, rx_length_m=15e-3)

    @classmethod
    def edgetech(cls) -> Sonar:
        """Return the Edgetech SAS on HUGIN (Ødegaard 2004, chapter 6).

        It has 6 receivers with a total length of 1.2012 m at 125 kHz, and a bandwidth of 15 kHz.
        They resolve 5 cm in range (c/2B) and 10 cm in azimuth (L/2); the thesis quotes a
        theoretical resolution of 10 cm by 10 cm. It gives neither the pulse nor the transmitter.
        The chirp of 5 ms, and a transmitter as long as a receiver in the middle of the array, are
        choices.
        """
        pulse = Pulse(carrier_hz=125e3, bandwidth_hz=15e3, duration_s=5e-3)
        length = 1.2012 / 6
        return cls(pulse, line_array(6, length), tx_length_m=length, rx_length_m=length)

    @classmethod
    def sensotek(cls) -> Sonar:
        """Return one receiver bank of the SENSOTEK SAS for HUGIN (Ødegaard 2004, chapter 6).

        It has 96 elements of one wavelength. The thesis does not give the carrier. 100 kHz follows
        from "270 m range at 1.5 m/s with an overlap of 24 elements", that is 72 phase centres of
        half a wavelength in 2 * 270/1500 s. The bandwidth is "up to 50 kHz"; 37.5 kHz gives the
        quoted resolution of 2 cm. The chirp of 5 ms and a transmitter like a receiver are choices.
        """
        pulse = Pulse(carrier_hz=100e3, bandwidth_hz=37.5e3, duration_s=5e-3)
        length = 1500.0 / 100e3
        return cls(pulse, line_array(96, length), tx_length_m=length, rx_length_m=length)

    @classmethod
    def hisas_1030(cls) -> Sonar:
        """Return an interferometric SAS with two banks, after Kongsberg's HISAS 1030 [1]_.

        The published sonar works between 60 and 120 kHz with a bandwidth of typically 30 kHz, to
        200 m at 2 m/s. Its two banks are 1.2 m long, have 32 receivers each, and lie about 20
        wavelengths above each other. Elements of 1.2 m/32 = 37.5 mm resolve 2 cm along the track;
        the bandwidth resolves 2.5 cm in range.

        Choices are a carrier of 100 kHz, so that the baseline of 20 wavelengths is 0.3 m; a chirp
        of 5 ms; and a transmitter as long as a receiver in the middle between both banks, in place
        of a phased array that steers in elevation. Bank 0 is the lower one.

        References
        ----------
        .. [1] Hansen, Callow, Sæbø, Synnes, "Challenges in seafloor imaging and mapping with
           synthetic aperture sonar", IEEE Transactions on Geoscience and Remote Sensing 49, 2011.
        """
        pulse = Pulse(carrier_hz=100e3, bandwidth_hz=30e3, duration_s=5e-3)
        length, baseline = 1.2 / 32, 20 * 1500.0 / 100e3
        rx_m, numbers = stacked(line_array(32, length), (-baseline / 2, baseline / 2))
        return cls(pulse, rx_m, tx_length_m=length, rx_length_m=length, bank_numbers=numbers)


def _checked_banks(value: ArrayLike, receivers: int) -> NDArray[np.int64]:
    """Return the bank of every receiver, [receivers]; raises TypeError or ValueError."""
    numbers = checked_bank_numbers(value, receivers, "receivers")
    counts = np.bincount(numbers)
    if not counts.all():
        allowed = "count banks from 0 without a gap"
        raise ArgumentError("bank_numbers", allowed, banks_of(numbers))
    if np.ptp(counts):
        allowed = "give every bank the same number of receivers"
        raise ArgumentError("bank_numbers", allowed, ", ".join(map(str, counts)))
    return numbers


def _chips(name: str, value: object) -> tuple[int, ...]:
    """Return the chips of a phase code as ints; raises TypeError or ValueError."""
    try:
        given = np.asarray(value)
    except (TypeError, ValueError):
        given = np.zeros(0)
    is_code = given.ndim == 1 and given.size > 0 and given.dtype.kind in "iuf"
    if not is_code or not np.isin(given, (1, -1)).all():
        allowed = f"be {'up, down or ' * (name == 'code')}chips of +1 and -1"
        raise ArgumentError(name, allowed, validate.shown(value))
    return tuple(given.astype(int).tolist())


def line_array(receivers: int, spacing_m: float) -> NDArray[np.float64]:
    """Return the positions of equally spaced receivers along x, centred on the origin, [n, 3]."""
    receivers = validate.count("receivers", receivers)
    validate.memory("receivers", 240 * receivers)  # including the paths of one ping
    spacing = validate.positive("spacing_m", spacing_m, "m")
    positions = np.zeros((receivers, 3))
    positions[:, 0] = spacing * (np.arange(receivers) - (receivers - 1) / 2)
    return positions


def stacked(
    row_m: NDArray[np.float64], heights_m: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return a row of receivers [n, 3] repeated at several heights, and their bank numbers."""
    heights_m = validate.array("heights_m", heights_m, np.float64, (None,))
    validate.memory("heights_m", 240 * len(row_m) * len(heights_m))
    rows_m = row_m + np.multiply.outer(heights_m, [0.0, 0.0, 1.0])[:, None]
    return rows_m.reshape(-1, 3), np.repeat(np.arange(len(heights_m)), len(row_m))


def element_pattern(
    size_m: float,
    sine: ArrayLike,
    frequency_hz: ArrayLike,
    sound_speed_m_s: float,
    dtype: type[np.floating] = np.float64,
) -> NDArray[np.floating]:
    """Return the amplitude pattern sinc(L/lambda sin theta) of one element; [9]-[12].

    Parameters
    ----------
    size_m : float
        Length L of the element along an axis, metres.
    sine : array_like
        sin theta, the component of the direction along this axis.
    frequency_hz : array_like
        Acoustic frequency (carrier included), hertz; broadcasts with `sine`.
    sound_speed_m_s : float
        Speed of sound, metres per second.
    dtype : numpy.float64 or numpy.float32
        Type of the result. Single precision is several times faster, with errors of at most 1e-7.

    Returns
    -------
    array of `dtype`
        1 on the beam axis, negative in every other side lobe.
    """
    phase = np.multiply(np.pi * size_m / sound_speed_m_s * np.asarray(frequency_hz), sine)
    # The phase is rounded only here, where sine and denominator have the same x: the error of
    # sin(x) due to rounding x grows with x, that of sin(x)/x does not. The smallest positive number
    # replaces 0 and gives exactly 1.
    x = np.maximum(np.abs(phase).astype(dtype), np.finfo(dtype).tiny)
    return np.sin(x) / x
