"""Range lines: pulse-compressed echoes with their geometry, the input of every imager."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft

from clsas.engine.data import pings, reprs, validate
from clsas.engine.data.declared import Choice, Count, Number, check_declared
from clsas.engine.data.fourier import EDGE_PRODUCT, filtered, smooth_edge
from clsas.engine.data.geometry import pairwise_range_m
from clsas.engine.data.georeference import Georeference
from clsas.engine.data.sound_speed import SoundSpeed, check_reaches
from clsas.engine.data.validate import ArgumentError, ArgumentTypeError

_PER_CHANNEL = (
    "first_range_m",
    "tx_m",
    "rx_m",
    "rx_velocity_m_s",
    "look_direction",
    "bank_numbers",
)
GOLDEN = (np.sqrt(5) - 1) / 2
"""Golden ratio minus 1. Modulo 1, its multiples fill [0, 1) evenly, but never in regular steps."""

TAPER = Number("m", above=0.0, help="Fade the lines over this range at either end.")
"""Declares the length of tapers, of which a line has room for two."""
STATISTICS = ("mean", "median")
"""Estimates of the background that all pings have in common."""

_UNIT = 1e-12  # error of a unit vector's length, far above rounding
REACH = 8
"""Samples by which an interpolated line extends beyond its ends. With 8 taps, 4 samples are kept
there, and pixels up to 4 samples farther out read them."""
_MOST_BANKS = 1000  # far more than any sonar has: a plain choice
_LEAST_CYCLES = 0.02  # per sample, at the middle of a band that shows the carrier
_Number = TypeVar("_Number", float, NDArray[np.float64])

EQUAL_RANGE = 1e-3
"""Steps by which the first ranges of pings may differ. The resulting error is -50 dB."""
SAMPLED_CHANNELS = 128
"""Number of channels that represent all in estimates of geometry and coverage. Half or twice as
many change predicted errors by less than 0.2 dB (`scripts/bench sensitivity`)."""


@dataclass(frozen=True, eq=False)
class RangeLines:
    """Pulse-compressed complex echoes of every channel, with the channels' geometry.

    A channel is one (ping, receiver) pair, in ping-major order. Range is half the two-way path,
    rho(x) = (|x - tx| + |x - rx|) / 2. For a monostatic sonar this is the distance to the point. A
    point of amplitude A at range rho appears in a line as

        A p(r - rho) exp(-j 2 k rho),   k = 2 pi carrier_hz / sound_speed_m_s,

    with sample n of channel i at r = first_range_m[i] + n range_step_m.

    Parameters
    ----------
    samples : array_like of complex, shape [channels, length]
        Samples, stored as complex64.
    first_range_m : float or array_like, shape [channels]
        Range of each channel's first sample, metres. One number applies to all channels.
    range_step_m : float
        Range between samples, metres: sound_speed_m_s / (2 sample rate).
    tx_m, rx_m : array_like of float, shape [channels, 3] or [3]
        Transmitter and receiver positions (x, y, z) at transmission, metres, stored as float64. One
        position applies to all channels. For a monostatic sonar give `rx_m=tx_m`.
    carrier_hz : float
        Frequency that was mixed out, hertz; 0 if the lines are still on their carrier.
    sound_speed_m_s : float
        Speed of the waves, metres per second.
    rx_velocity_m_s : array_like of float, shape [channels, 3] or [3], optional
        Velocity of the receivers while the sound travels, metres per second. None means
        stop-and-hop.
    look_direction : array_like of float, shape [channels, 3] or [3], optional
        Direction in which the beam of each channel looks (x, y, z): the normal of the elements'
        face. Vectors of any length are stored as unit vectors. None means that the direction is
        unknown, or that the elements look to all sides. It does not change images, but imagers
        warn if pixels lie behind the elements.
    georeference : Georeference, optional
        Where the coordinates lie on Earth. Images of these lines have it too.
    bank_numbers : array_like of int, shape [channels], optional
        Receiver bank of each channel, counted from 0, for sonars with several rows of receivers at
        different heights. None means that all receivers are one bank.
    sound_speed : SoundSpeed, optional
        Sound speed over depth. Imagers then account for refraction, and `sound_speed_m_s` only
        converts times to ranges: range r belongs to the two-way delay 2 r / sound_speed_m_s. None
        means that the speed is `sound_speed_m_s` everywhere.

    Raises
    ------
    TypeError
        If an argument has the wrong type. This includes real samples, which have no phase.
    ValueError
        If shapes disagree, an array is empty, a value is NaN or infinite, a step or speed is not
        positive, the carrier is negative, a receiver is not slower than the waves, a direction has
        length zero, or the largest sample is too large or too small for complex64.

    See Also
    --------
    compress : Range lines of recorded echoes.
    from_phase_history : Range lines of samples over frequency.
    from_full_matrix : Range lines of an array whose elements transmit in turn.

    Notes
    -----
    Samples are large, so arrays that need no conversion are not copied. The fields are read-only
    views of them. Do not write into your arrays afterwards, because new values are not checked.

    Examples
    --------
    Two pings of a monostatic sonar, half a metre apart:

    >>> import clsas
    >>> import numpy as np
    >>> lines = clsas.RangeLines(
    ...     np.ones((2, 101), complex), first_range_m=40.0, range_step_m=0.05,
    ...     tx_m=[[0, 0, 0], [0.5, 0, 0]], rx_m=[[0, 0, 0], [0.5, 0, 0]],
    ...     carrier_hz=100e3, sound_speed_m_s=1500.0,
    ... )
    >>> lines
    RangeLines(2 channels of 101 samples, range 40 to 45 m in steps of 50 mm, carrier 100 kHz)
    >>> lines.ping_starts
    array([0, 1])
    """

    samples: NDArray[np.complex64]
    first_range_m: NDArray[np.float64]
    range_step_m: float
    tx_m: NDArray[np.float64]
    rx_m: NDArray[np.float64]
    carrier_hz: float
    sound_speed_m_s: float
    rx_velocity_m_s: NDArray[np.float64] | None = None
    look_direction: NDArray[np.float64] | None = None
    georeference: Georeference | None = None
    bank_numbers: NDArray[np.int64] | None = None
    sound_speed: SoundSpeed | None = None

    if TYPE_CHECKING:  # the constructor converts array_like arguments

        def __init__(
            self,
            samples: ArrayLike,
            first_range_m: ArrayLike,
            range_step_m: float,
            tx_m: ArrayLike,
            rx_m: ArrayLike,
            carrier_hz: float,
            sound_speed_m_s: float,
            rx_velocity_m_s: ArrayLike | None = None,
            look_direction: ArrayLike | None = None,
            georeference: Georeference | None = None,
            bank_numbers: ArrayLike | None = None,
            sound_speed: SoundSpeed | None = None,
        ) -> None: ...

    def __post_init__(self) -> None:
        """Check every field and convert it."""

        def put(name: str, value: object) -> None:
            object.__setattr__(self, name, value)

        put("samples", validate.array("samples", self.samples, np.complex64, (None, None)))
        put("range_step_m", validate.positive("range_step_m", self.range_step_m, "m"))
        for name, value in checked_channels(self, "first_range_m").items():
            put(name, value)

    def __repr__(self) -> str:
        """Return sizes and extents, because the arrays are long."""
        range_m = float(self.first_range_m.min()), float(self.last_range_m.max())
        return reprs.summary(
            self,
            f"{self.channels} channels of {self.length} samples",
            f"{self.banks} banks" if self.banks > 1 else None,
            f"range {reprs.span(*range_m, 'm')} in steps of "
            f"{reprs.quantity(self.range_step_m, 'm')}",
            f"carrier {reprs.quantity(self.carrier_hz, 'Hz')}",
        )

    @property
    def per_channel(self) -> dict[str, Any]:
        """Fields with an entry per channel, by name, without those that are None.

        Code that selects, joins or compares lines takes the fields from here.
        """
        fields = {name: getattr(self, name) for name in _PER_CHANNEL}
        return {name: values for name, values in fields.items() if values is not None}

    @property
    def channels(self) -> int:
        """Number of channels."""
        return self.samples.shape[0]

    @property
    def length(self) -> int:
        """Samples per channel."""
        return self.samples.shape[1]

    @property
    def banks(self) -> int:
        """Number of receiver banks that the channels belong to."""
        return len(banks_of(self.bank_numbers))

    @property
    def is_monostatic(self) -> bool:
        """True if every channel transmits and receives at one position, but for its motion."""
        return np.array_equal(self.tx_m, self.rx_m)

    @property
    def paths_differ(self) -> bool:
        """True if echoes return on other paths, because receivers lie elsewhere or move."""
        return self.rx_velocity_m_s is not None or not self.is_monostatic

    @property
    def phase_centres_m(self) -> NDArray[np.float64]:
        """Midpoints between transmitters and receivers, metres, shape [channels, 3]."""
        return (self.tx_m + self.rx_m) / 2

    @property
    def ping_starts(self) -> NDArray[np.int64]:
        """First channel of every ping, int64 [pings].

        Consecutive channels with one transmitter position are a ping. Several transmissions from
        one position therefore count as one; `clsas.engine.data.pings.Transmissions` separates them.
        """
        return pings.ping_starts(self.tx_m)

    @property
    def ping_numbers(self) -> NDArray[np.int64]:
        """Number of every channel's ping, from 0, shape [channels]."""
        return pings.ping_numbers(self.ping_starts, self.channels)

    @property
    def ping_centres_m(self) -> NDArray[np.float64]:
        """Mean phase centre of every ping, metres, shape [pings, 3]."""
        return pings.means(self.phase_centres_m, self.ping_starts)

    @property
    def wavenumber_rad_m(self) -> float:
        """Wavenumber k of the carrier, radians per metre (one way)."""
        return 2 * np.pi * self.carrier_hz / self.sound_speed_m_s

    @property
    def carrier_cycles_per_m(self) -> float:
        """Phase of the carrier per metre of range (two-way), cycles per metre."""
        return 2 * self.carrier_hz / self.sound_speed_m_s

    @property
    def highest_cycles_per_m(self) -> float:
        """Two-way phase per metre of range at the highest frequency sampled, cycles per metre.

        Lines whose carrier was mixed out contain half the sample rate beyond it; those on their
        carrier, up to the whole rate.
        """
        return self.carrier_cycles_per_m + 1 / self.range_step_m

    @property
    def last_range_m(self) -> NDArray[np.float64]:
        """Range of each channel's last sample, metres, shape [channels]."""
        return self.first_range_m + (self.length - 1) * self.range_step_m

    def select(self, channels: slice | ArrayLike) -> RangeLines:
        """Return the lines of some channels.

        Parameters
        ----------
        channels : slice or array_like
            Indices, a mask of bools, or a slice, with which samples are shared and not copied.

        Raises
        ------
        TypeError
            If `channels` is neither a slice nor whole numbers nor bools.
        ValueError
            If an index is out of range, a mask is not one bool per channel, or no channel is
            selected.
        """
        index = self._index(channels)
        if len(range(self.channels)[index] if isinstance(index, slice) else index) == 0:
            raise ArgumentError("channels", "select at least one line", "none")
        return self._selected(index)

    def bank(
        self,
        number: Annotated[int, Count(0, help="Receiver bank to use, from 0.", default="all banks")],
    ) -> RangeLines:
        """Return the lines of one receiver bank, whose `bank_numbers` are None.

        Parameters
        ----------
        number : int
            Number of the bank, one of `bank_numbers`, or 0 if these are None.

        Raises
        ------
        TypeError, ValueError
            If there is no such bank.

        Examples
        --------
        Three pings of a sonar with two banks, 0.3 m apart, of two receivers each:

        >>> import clsas
        >>> import numpy as np
        >>> pulse = clsas.Pulse(carrier_hz=100e3, bandwidth_hz=20e3, duration_s=1e-3)
        >>> rx_m = [[0, 0, 0], [0.1, 0, 0], [0, 0, 0.3], [0.1, 0, 0.3]]
        >>> sonar = clsas.Sonar(pulse, rx_m, bank_numbers=[0, 0, 1, 1])
        >>> track = clsas.Track.straight([0, 0, 10], [2, 0, 0], pings=3, ping_interval_s=0.05)
        >>> point = clsas.PointTargets([[0.1, 40, 0]])
        >>> lines = clsas.compress(clsas.simulate(sonar, track, point))
        >>> lines.channels, lines.banks
        (12, 2)
        >>> upper = lines.bank(1)
        >>> upper.channels, float(upper.rx_m[:, 2].min())
        (6, 10.3)
        """
        index = bank_members(self.bank_numbers, number)
        return self if self.bank_numbers is None else self._selected(index, bank_numbers=None)

    def _selected(self, index: slice | NDArray[np.int64], **changes: Any) -> RangeLines:
        """Return some channels, with fields replaced."""
        of_channels = {name: values[index] for name, values in self.per_channel.items()}
        return replace(self, samples=self.samples[index], **(of_channels | changes))

    def _index(self, channels: slice | ArrayLike) -> slice | NDArray[np.int64]:
        """Return the channels, checked, as a slice or as indices [n]."""
        if isinstance(channels, slice):
            return validate.selection("channels", channels)
        try:
            given = np.atleast_1d(channels)
        except ValueError as error:
            raise ArgumentError("channels", "be a regular array", hint=str(error)) from None
        if given.ndim != 1:
            raise ArgumentError("channels", "have one axis", f"shape {given.shape}")
        given = given if given.size else given.astype(int)
        if given.dtype.kind not in "iub":
            got = validate.shown(channels)
            raise ArgumentTypeError("channels", "be a slice, whole numbers or bools", got)
        if given.dtype.kind != "b":
            return validate.indices("channels", given, self.channels, least=-self.channels)
        if len(given) != self.channels:
            allowed = f"be one bool for each of {self.channels} channels"
            raise ArgumentError("channels", allowed, len(given))
        return np.flatnonzero(given)

    def high_passed(
        self,
        cutoff_hz: Annotated[
            float,
            Number(
                "Hz",
                above=0.0,
                help="Keep frequencies of the recorded signal above this one, and remove those "
                "below half of it.",
            ),
        ],
    ) -> RangeLines:
        """Return the lines without frequencies below a cutoff.

        Recorders add constants and slow drifts. In lines on their carrier these lie near 0 Hz,
        where they add up coherently over a whole image.

        Parameters
        ----------
        cutoff_hz : float
            Cutoff frequency in the recorded signal, before `carrier_hz` was mixed out, hertz.
            Frequencies from the cutoff upwards pass unchanged. The filter falls to zero at half the
            cutoff, or at the lowest frequency that the samples represent if that is higher. It has
            no delay.

        Raises
        ------
        TypeError, ValueError
            If the cutoff is not a number, is outside the sampled band (carrier_hz plus or minus
            half the sample rate), or is below one cycle per line.
        """
        rate = self.sound_speed_m_s / (2 * self.range_step_m)
        lowest = max(0.0, self.carrier_hz - rate / 2)
        cutoff = check_declared(RangeLines.high_passed, {"cutoff_hz": cutoff_hz})["cutoff_hz"]
        if cutoff <= lowest:
            raise ArgumentError(
                "cutoff_hz",
                f"be finite and > {lowest:g} and < {lowest + rate:g} Hz",
                f"{cutoff:g}",
                f"lines on a carrier of {self.carrier_hz:g} Hz contain nothing below {lowest:g} Hz",
            )
        validate.number("cutoff_hz", cutoff, "Hz", above=lowest, below=lowest + rate)
        if cutoff * self.length < rate:
            allowed = f"be at least one cycle per line, {rate / self.length:g} Hz"
            raise ArgumentError("cutoff_hz", allowed, f"{cutoff:g} Hz")
        # The edge begins at half the cutoff, or at the lowest frequency of the band if that is
        # higher.
        width = min(cutoff / 2, cutoff - lowest)
        padded = fft.next_fast_len(self.length + int(np.ceil(EDGE_PRODUCT * rate / width)))
        validate.memory("cutoff_hz", 16 * padded)
        frequency = np.abs(self.carrier_hz + fft.fftfreq(padded, 1 / rate))
        response = smooth_edge((cutoff - frequency) / width)
        return replace(self, samples=filtered(self.samples, response[None])[0])

    def tapered_ends(
        self,
        length_m: Annotated[float, TAPER],
    ) -> RangeLines:
        """Return the lines with both ends faded to zero.

        Lines that end abruptly within strong echoes cannot be interpolated well, even far from
        their ends.

        Parameters
        ----------
        length_m : float
            Length over which a raised cosine falls from 1 to 0 at each end, metres. At most half a
            line.

        Raises
        ------
        TypeError, ValueError
            If the length is not a number, or is outside its limits.
        """
        half_m = (self.length - 1) * self.range_step_m / 2
        length_m = replace(TAPER, most=half_m).check("length_m", length_m)
        from_end_m = np.arange(self.length) * self.range_step_m
        from_end_m = np.minimum(from_end_m, from_end_m[::-1])
        taper = np.sin(np.pi / 2 * np.minimum(from_end_m / length_m, 1)) ** 2
        return replace(self, samples=self.samples * taper.astype(np.float32))

    def without_background(
        self,
        statistic: Annotated[
            str, Choice(STATISTICS, help="Subtract this statistic of all pings from every ping.")
        ] = "mean",
        *,
        receivers: int | None = None,
    ) -> RangeLines:
        """Return the lines without the background that all pings have in common.

        Direct arrivals, ringing and interference of the electronics lie at the same delay in every
        ping. Echoes of points move through the lines and mostly remain. A reflector at constant
        range, such as a flat seabed seen vertically, is removed as well.

        Parameters
        ----------
        statistic : {"mean", "median"}
            Estimate of the background over the pings, for every receiver and sample. The median (of
            real and imaginary parts) is less affected by strong echoes.
        receivers : int, optional
            Number of channels per ping. By default consecutive channels with one transmitter
            position are a ping.

        Raises
        ------
        TypeError, ValueError
            If there are fewer than 2 pings, pings have different numbers of channels, or the lines
            of a receiver do not begin at the same range in all pings.
        """
        check_declared(RangeLines.without_background, {"statistic": statistic})
        if receivers is None:
            counts = pings.channels_per_ping(self.ping_starts, self.channels)
            if np.ptp(counts):
                raise ArgumentError(
                    "receivers",
                    "be given",
                    hint="pings (consecutive channels with one transmitter position) have from "
                    f"{counts.min()} to {counts.max()} channels",
                )
            receivers = int(counts[0])
        receivers = validate.count("receivers", receivers)
        number, rest = divmod(self.channels, receivers)
        if rest or number < 2:
            got = f"{receivers} receivers and {self.channels} channels"
            raise ArgumentError("receivers", "divide the channels into at least 2 pings", got)
        first_m = self.first_range_m.reshape(number, receivers)
        spread_m = float(np.ptp(first_m, axis=0).max())
        if spread_m > EQUAL_RANGE * self.range_step_m:
            raise ArgumentError(
                "first_range_m",
                "be the same in all pings of a receiver",
                f"ranges that differ by up to {spread_m:g} m",
                "a background lies at one delay",
            )
        samples = np.array(self.samples).reshape(number, receivers, self.length)
        for receiver in range(receivers):
            own = samples[:, receiver]
            if statistic == "mean":
                background = own.mean(axis=0, dtype=np.complex128)
            else:
                background = np.median(own.real, axis=0) + 1j * np.median(own.imag, axis=0)
            own -= background.astype(np.complex64)
        return replace(self, samples=samples.reshape(self.samples.shape))

    def without_still_pings(self, least_advance_m: float | None = None) -> RangeLines:
        """Return the lines without pings taken standing still.

        A platform that stands still repeats one view of the scene. Hundreds of equal pings add up
        to bright circles around their position, which hide the image formed by the moving pings.
        The first ping of every halt is kept.

        Parameters
        ----------
        least_advance_m : float, optional
            A ping is dropped if it lies closer than this to the last ping that was kept, metres.
            The default is a tenth of the usual advance, the median over the pings that move.
            Because noise in positions brings single pings together, the default drops only halts of
            five pings or more, and pings that repeat the position of the one before exactly.

        Raises
        ------
        TypeError, ValueError
            If the distance is not a positive number, or only one of several pings would be kept.
        """
        if least_advance_m is not None:
            least_advance_m = validate.positive("least_advance_m", least_advance_m, "m")
        found = pings.Transmissions.of(self.tx_m, self.rx_m)
        kept = found.advancing(least_advance_m)
        if kept.sum() < min(2, found.count):
            near = (
                "are at one position"
                if least_advance_m is None
                else f"lie within `least_advance_m` = {least_advance_m:g} m"
            )
            raise ArgumentError(
                "lines",
                "come from a platform that moves",
                hint=f"of {found.count} pings ({self.channels} lines) only the first would stay, "
                f"because all {near}; check the positions",
            )
        return self if kept.all() else self.select(found.channels(kept))

    def weighted(self, weights: ArrayLike) -> RangeLines:
        """Return the lines, each multiplied by a weight.

        Parameters
        ----------
        weights : array_like of float or complex, shape [channels]
            Gains, apodization or phase corrections; 0 silences a channel.

        Raises
        ------
        TypeError, ValueError
            If the weights are not finite numbers, one per channel, or weighted samples exceed
            float32.
        """
        factors = validate.real_or_complex("weights", weights, np.complex64, (self.channels,))
        with np.errstate(over="ignore", invalid="ignore"):
            samples = self.samples * factors[:, None]
        if not np.isfinite(samples).all():
            largest = float(np.abs(factors).max())
            allowed = f"keep the samples within float32, up to {np.finfo(np.float32).max:.2g}"
            raise ArgumentError("weights", allowed, f"weights up to {largest:.3g}")
        return replace(self, samples=samples)

    def without_samples(self) -> RangeLines:
        """Return the geometry of these lines, with a single sample of zero per channel."""
        return replace(self, samples=np.zeros((self.channels, 1), np.complex64))


def checked_channels(received: Any, start: str) -> dict[str, Any]:
    """Return the fields that range lines and echoes share, checked and converted.

    Parameters
    ----------
    received : RangeLines or Echoes
        Object whose `samples` have been checked.
    start : str
        Name of the field that has the first range or time of every channel.

    Raises
    ------
    TypeError, ValueError
        If a field has the wrong type or shape, or is outside its limits.
    """
    validate.instance("georeference", received.georeference, Georeference, type(None))
    validate.instance("sound_speed", received.sound_speed, SoundSpeed, type(None))
    channels = received.samples.shape[0]
    shapes: dict[str, tuple[int, ...]] = {start: (channels,)}
    shapes |= {"tx_m": (channels, 3), "rx_m": (channels, 3)}
    for name in ("rx_velocity_m_s", "look_direction"):
        if getattr(received, name) is not None:
            shapes[name] = (channels, 3)
    checked: dict[str, Any] = {
        name: validate.array(name, getattr(received, name), np.float64, shape, broadcast=True)
        for name, shape in shapes.items()
    }
    checked["carrier_hz"] = validate.number("carrier_hz", received.carrier_hz, "Hz", least=0.0)
    speed_m_s = validate.positive("sound_speed_m_s", received.sound_speed_m_s, "m/s")
    checked["sound_speed_m_s"] = speed_m_s
    if "rx_velocity_m_s" in checked:
        fastest_m_s = float(np.linalg.norm(checked["rx_velocity_m_s"], axis=1).max())
        validate.number("the speed of rx_velocity_m_s", fastest_m_s, "m/s", below=speed_m_s)
    if received.bank_numbers is not None:
        checked["bank_numbers"] = checked_bank_numbers(received.bank_numbers, channels, "channels")
    if "look_direction" in checked:
        checked["look_direction"] = _unit_vectors("look_direction", checked["look_direction"])
    if received.sound_speed is not None:
        for name in ("tx_m", "rx_m"):
            check_reaches(received.sound_speed, checked[name][:, 2], f"`{name}`")
    return checked


def _unit_vectors(name: str, vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return vectors scaled to length 1. Those that have it already are returned bit for bit."""
    largest = np.abs(vectors).max(axis=1, keepdims=True)
    if not largest.all():
        raise ArgumentError(name, "not have a vector of length 0")
    scaled = vectors / largest  # avoids overflow and underflow in the norm
    length = np.linalg.norm(scaled, axis=1, keepdims=True)
    if np.abs(length * largest - 1).max() < _UNIT:
        return vectors
    scaled /= length
    scaled.flags.writeable = False
    return scaled


def checked_bank_numbers(value: ArrayLike, count: int, of: str) -> NDArray[np.int64]:
    """Return bank numbers as a read-only array [count]; `of` says what has one each.

    Raises
    ------
    TypeError, ValueError
        If they are not whole numbers from 0, or not one for each.
    """
    numbers = validate.indices("bank_numbers", value, _MOST_BANKS)
    if numbers.shape != (count,):
        allowed = f"be one number for each of {count} {of}"
        raise ArgumentError("bank_numbers", allowed, f"shape {numbers.shape}")
    numbers = numbers.view()
    numbers.flags.writeable = False
    return numbers


def banks_of(numbers: NDArray[np.int64] | None) -> list[int]:
    """Return the numbers of the banks that occur, ascending."""
    return [0] if numbers is None else [int(each) for each in np.unique(numbers)]


def bank_members(numbers: NDArray[np.int64] | None, number: int) -> slice | NDArray[np.int64]:
    """Return which receivers or channels belong to a bank, as indices.

    Raises
    ------
    TypeError, ValueError
        If `number` is not that of a bank.
    """
    number = validate.count("number", number, least=0)
    known = banks_of(numbers)
    if number not in known:
        names = f"one of the banks {', '.join(map(str, known))}"
        if len(known) == 1:
            names = f"{known[0]}, since there is one bank"
        raise ArgumentError("number", f"be {names}", number)
    return slice(None) if numbers is None else np.flatnonzero(numbers == number)


def first_two_banks(numbers: NDArray[np.int64] | None) -> tuple[int, int]:
    """Return the banks from which heights are measured: the first two.

    Parameters
    ----------
    numbers : int64 [channels] or None
        Bank of each channel.

    Raises
    ------
    ValueError
        If there is only one bank.

    Warns
    -----
    ClsasWarning
        If there are more than two banks, with the two that are used.
    """
    first, *others = banks_of(numbers)
    if not others:
        raise ArgumentError("lines", "have at least 2 receiver banks", "1")
    second, *unused = others
    if unused:
        words = f"bank {unused[0]} is"
        if len(unused) > 1:
            words = f"banks {', '.join(map(str, unused[:-1]))} and {unused[-1]} are"
        validate.warn(
            f"heights are measured from banks {first} and {second}; {words} not used. "
            "To choose others, give lines of one bank each: `lines.bank(n)`"
        )
    return first, second


def some_channels(count: int, most: int = SAMPLED_CHANNELS) -> NDArray[np.int64]:
    """Return up to `most` of `count` channels, spread evenly but at irregular intervals.

    With regular intervals, all of them could belong to one receiver of an array.
    """
    if count <= most:
        return np.arange(count)
    number = np.arange(most)
    return ((number + number * GOLDEN % 1) * count / most).astype(np.int64)


def antennas_of(
    lines: RangeLines, channels: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64] | None, float]:
    """Return the transmitters, receivers and velocities of some channels, and the sound speed.

    Functions of ranges take them after the points.
    """
    velocity = lines.rx_velocity_m_s
    moving = None if velocity is None else velocity[channels]
    return lines.tx_m[channels], lines.rx_m[channels], moving, lines.sound_speed_m_s


def reached_m(
    lines: RangeLines, centre_m: NDArray[np.float64], half_m: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return between which ranges lines must have samples to contribute to a box, [channels].

    Parameters
    ----------
    lines : RangeLines
    centre_m : float64 [3]
        Centre of the box.
    half_m : float64 [n, 3]
        Half of its edges as vectors. If they are not orthogonal, the result is that of an
        orthogonal box around it.
    """
    axes = np.linalg.qr(half_m.T, mode="complete").Q
    extent_m = np.abs(half_m @ axes).sum(axis=0)
    near_m, far_m = np.zeros(lines.channels), np.zeros(lines.channels)
    for antennas_m in (lines.tx_m, lines.rx_m):
        away_m = np.abs((antennas_m - centre_m) @ axes)
        near_m += np.linalg.norm(np.maximum(away_m - extent_m, 0.0), axis=1) / 2
        far_m += np.linalg.norm(away_m + extent_m, axis=1) / 2
    beyond_m = REACH * lines.range_step_m
    if lines.rx_velocity_m_s is not None:
        # Motion changes the ranges to the box nearly as much as that to its centre. Per metre from
        # there the change differs by at most twice the speed over that of sound.
        antennas = lines.tx_m, lines.rx_m
        velocity = lines.rx_velocity_m_s, lines.sound_speed_m_s
        moved_m = pairwise_range_m(centre_m[None], *antennas, *velocity)[0]
        moved_m -= pairwise_range_m(centre_m[None], *antennas)[0]
        near_m, far_m = near_m + moved_m, far_m + moved_m
        beyond_m += 3 * (steepest(lines) - 1) * float(np.linalg.norm(extent_m))
    return near_m - beyond_m, far_m + beyond_m


def steepest(lines: RangeLines) -> float:
    """Return an upper bound on the change of range per metre that a point moves.

    With unit vectors u from both antennas, the gradient of range is (u_tx + u_rx) / 2 divided by
    1 + u_rx . velocity / c.
    """
    return 1 / (1 - min(fastest(lines), 0.999))


def fastest(lines: RangeLines) -> float:
    """Return the speed of the fastest receiver divided by the sound speed."""
    if lines.rx_velocity_m_s is None:
        return 0.0
    return float(np.linalg.norm(lines.rx_velocity_m_s, axis=1).max()) / lines.sound_speed_m_s


def wavelength_m(lines: RangeLines) -> float:
    """Return the wavelength of the carrier, metres; infinite for lines without a carrier.

    Element patterns, beams that correct for them, and limits of the spacing of channels, which a
    sonar has without lines, use this wavelength. Lengths in lines, such as a track error, are
    compared with `band_wavelength_m`, which does not depend on what was mixed out.
    """
    return lines.sound_speed_m_s / lines.carrier_hz if lines.carrier_hz else math.inf


def band_wavelength_m(lines: RangeLines, centre: float) -> float:
    """Return the wavelength in the middle of the band that lines occupy, metres.

    Lines whose band lies about 0 Hz do not show their carrier. Their wavelength is that of the
    highest frequency sampled.

    Parameters
    ----------
    lines : RangeLines
    centre : float
        Middle of the band, cycles per sample: `Spectrum.centre`, or that of a plan's lines.
    """
    if is_about_zero(lines, centre):
        return 4 * lines.range_step_m
    return 2 / abs(cycles_per_m_at(lines, centre))


def wavelength_between_m(lines: RangeLines, low_hz: float, high_hz: float) -> float:
    """Return the wavelength at the mean frequency of a band, metres.

    All frequencies count as positive. The mean is that of the ends, unless the band reaches below
    0 Hz: the middle of such a band is arbitrary, and the wavelength there could be infinite.

    Parameters
    ----------
    lines : RangeLines
    low_hz, high_hz : float
        Ends of the band in the recorded signal, before `carrier_hz` was mixed out.
    """
    if low_hz * high_hz >= 0:
        mean_hz = abs(low_hz + high_hz) / 2
    else:
        mean_hz = (low_hz**2 + high_hz**2) / (2 * (high_hz - low_hz))
    return lines.sound_speed_m_s / mean_hz


def is_about_zero(lines: RangeLines, centre: float) -> bool:
    """Return whether a band lies so close to 0 Hz that it does not show the lines' carrier."""
    return abs(cycles_per_m_at(lines, centre)) * lines.range_step_m <= _LEAST_CYCLES


def cycles_per_m_at(lines: RangeLines, frequency: _Number) -> _Number:
    """Return the two-way phase per metre of range, cycles.

    Parameters
    ----------
    lines : RangeLines
    frequency : float or float64 array
        Frequency in the samples, cycles per sample.
    """
    return lines.carrier_cycles_per_m + frequency / lines.range_step_m
