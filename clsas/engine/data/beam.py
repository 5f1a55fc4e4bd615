"""Beam weights: the weight of a channel in a pixel as a function of the aspect angle.

The aspect angle is measured from the direction of the track at the channel, which follows from the
phase centres (`track_directions`).
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import correlate1d

from clsas.engine.data import reprs, validate
from clsas.engine.data.decibels import amplitude
from clsas.engine.data.declared import Choice, Count, Flag, Number, check_fields
from clsas.engine.data.geometry import unit_vectors
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.pings import PASS_JUMP
from clsas.engine.data.system import element_pattern
from clsas.engine.data.validate import ArgumentError
from clsas.engine.data.visibility import is_within, sine_width

SHAPES = ("rectangular", "hann", "hamming", "taylor", "tukey", "inverse")
"""Shapes of a beam. Each states its weights in `BeamWindow._inside`, whether they end with a step
in `jumps`, how wide their edges are in `edge`, and what one cubic over a block of pixels misses in
`block_error`. Weights must have a continuous slope between the limits, since tables of cubics and
`wavenumber` differentiate them."""

INTERVALS = 1024
"""Number of cubics in a table of weights: enough for the kinks of a Tukey window."""

SHORTEST_LEG = 5
"""Pings of the shortest leg of a track: those that a cubic needs, and one more."""

LEAST_WEIGHT_SUM = 0.01
"""Normalised pixels whose weights sum to less than this fade to 0."""

MOST_TRACK_PINGS = 101
"""Most pings over which the track's direction is smoothed by default."""

_NARROWEST = 1e-3  # narrowest beam, degrees; float32 resolves a hundredth of it
# Limit of beams that reach end-fire. Rounding never makes a sine this large.
_END_FIRE = 2.0
_HALF_POWER = 0.442946  # argument at which sinc^2 is 1/2
_MOST_WEIGHT = 100.0  # largest weight of an inverse beam: 40 dB
_TAYLOR_TERMS, _TAYLOR_SIDE_LOBES_DB = 4, 30.0  # as in SciPy
_STEEP_TAPER = 0.1  # largest taper with which the errors of "tukey" are those of a step

# Of the direction of the track
_SMOOTHED_SHARE = 4  # by default a cubic is fitted to a quarter of the pings
_JUMPS = 0.05  # share of steps to other places from which on pings are out of order; of legs of 20
_WINDING = 4.0  # length of a track over its extent up to which the order is not questioned
_MOST_SORTED = 20_000  # pings, which take 2 s


@dataclass(frozen=True, eq=False)
class BeamWindow:
    """Weights of the channels by aspect angle, which restrict an image to part of the beam.

    The weight of a channel in a pixel x is a function of theta - squint. The aspect angle theta,
    measured from broadside, follows from the phase centre p of the channel and the unit direction t
    of the track:

        sin(theta) = t . (x - p)/|x - p|,   p = (tx + rx)/2.

    If the lines have a profile of the sound speed, (x - p)/|x - p| is replaced by the direction in
    which the ray to x leaves p.

    Parameters
    ----------
    width_deg : float
        Full width, 0.001 to 180 degrees. The weight is 0 beyond half the width on either side.
    shape : str
        "rectangular", "hann", "hamming", "taylor" (4 terms, side lobes at -30 dB), "tukey" or
        "inverse". All but "inverse" depend on (theta - squint)/width and are 1 in the middle.
        "inverse" divides by the two-way pattern sinc^2(L/lambda sin(theta - squint)) of elements
        of length L, at the carrier of the lines.
    squint_deg : float
        Squint angle of the beam's axis, positive forward. The whole beam must lie within +-90
        degrees.
    taper : float
        For "tukey": fraction of the width, 0 to 1, that the two raised-cosine edges take together.
        Below 1/512 there are no edges.
    element_length_m : float, optional
        For "inverse": element length L, metres. The weights may amplify by 40 dB at most.
    along : array_like, [3] or [channels, 3], optional
        Direction of the track, as a vector of any length. The default is the direction of a smooth
        curve through the phase centres of the lines, in any order; see `directions`. Shuffled
        pings do not tell forward from backward, which matters to a beam with a squint.
    track_pings : int, optional
        Number of pings over which the direction of the track is smoothed, at least 5. The default
        is a quarter of all pings, and at most 101.
    normalise : bool
        If True, multiply every pixel by channels / sum_i w_i(x), with w_i the weights. A point then
        has the amplitude that it would have without a beam, even near the ends of the aperture,
        where fewer channels receive from it. Noise grows there by the square root of that factor.
        The sum includes channels whose lines do not reach the pixel. Pixels with a sum below 0.01
        fade to 0.

    Raises
    ------
    TypeError, ValueError
        If a value has the wrong type or is outside its limits.

    Examples
    --------
    >>> import clsas
    >>> beam = clsas.BeamWindow(20, "hann")
    >>> beam.weights([0.0, 0.1, 0.2]).round(3)
    array([1.   , 0.385, 0.   ])

    A beam as wide as the half-power beam of an element of 15 mm at a wavelength of 1.5 mm:

    >>> f"{clsas.BeamWindow.of_element(15e-3, 1.5e-3).width_deg:.2f} degrees"
    '5.08 degrees'
    """

    width_deg: Annotated[
        float,
        Number(
            "degrees",
            least=_NARROWEST,
            most=180.0,
            help="Full width of the beam, beyond which channels have no weight.",
        ),
    ]
    shape: Annotated[
        str, Choice(SHAPES, help="Shape of the beam. Images with 'hann' are the fastest.")
    ] = "rectangular"
    squint_deg: Annotated[
        float, Number("degrees", help="Squint of the beam's axis, positive forward.")
    ] = 0.0
    taper: Annotated[
        float,
        Number(least=0.0, most=1.0, help="For 'tukey': share of the width that both edges take."),
    ] = 0.5
    element_length_m: Annotated[
        float | None,
        Number(
            "m",
            above=0.0,
            help="For 'inverse', which divides by the two-way pattern: length of the elements.",
        ),
    ] = None
    along: NDArray[np.float64] | None = None
    normalise: Annotated[bool, Flag("Divide every pixel by the mean weight of the channels.")] = (
        False
    )
    track_pings: Annotated[
        int | None,
        Count(
            5,
            help="Pings over which the direction of the track is smoothed.",
            default=f"a quarter of all, at most {MOST_TRACK_PINGS}",
        ),
    ] = None

    __repr__ = reprs.of_fields

    def __post_init__(self) -> None:  # noqa: D105
        check_fields(self)
        room = 90 - self.width_deg / 2
        validate.number("squint_deg", self.squint_deg, "degrees", least=-room, most=room)
        if self.shape == "inverse" and self.element_length_m is None:
            raise ArgumentError("element_length_m", "be given for `shape='inverse'`")
        if self.along is not None:
            along = validate.array("along", self.along, np.float64, None)
            shape = (3,) if along.ndim == 1 else (None, 3)
            along = validate.array("along", along, np.float64, shape)
            largest = np.abs(along).max(axis=-1, keepdims=True)
            if not largest.all():
                raise ArgumentError("along", "not have a direction of length zero")
            # Division by the largest part avoids overflow and underflow in the norm.
            object.__setattr__(self, "along", unit_vectors(along / largest))

    @classmethod
    def of_element(
        cls, length_m: float, wavelength_m: float, shape: str = "rectangular", **others: Any
    ) -> BeamWindow:
        """Return weights as wide as the half-power beam of an element.

        The edges lie where the pattern of one element is -3 dB, and the two-way pattern -6 dB:
        sin(width/2) = 0.443 wavelength/length. This is the textbook beamwidth of 0.886
        wavelength/length, which gives an azimuth resolution of half an element. An element shorter
        than 0.443 wavelengths has no such edge, and the beam is then 180 degrees wide.

        Parameters
        ----------
        length_m : float
            Length of the element along the track, metres.
        wavelength_m : float
            Wavelength of the carrier, metres.
        shape : str
            Shape, as for `BeamWindow`.
        **others
            Further parameters of `BeamWindow`. `element_length_m` is `length_m` unless given.

        Raises
        ------
        TypeError, ValueError
            As for `BeamWindow`.
        """
        length = validate.positive("length_m", length_m, "m")
        wavelength = validate.positive("wavelength_m", wavelength_m, "m")
        width = 2 * math.degrees(math.asin(min(_HALF_POWER * wavelength / length, 1.0)))
        if width < _NARROWEST:
            raise ArgumentError(
                "length_m",
                f"make a beam of at least {_NARROWEST:g} degrees",
                f"{length:g} m, which makes {width:g} degrees at `wavelength_m` = {wavelength:g} m",
            )
        return cls(width, shape, **({"element_length_m": length} | others))

    def divided(self, count: int) -> tuple[BeamWindow, ...]:
        """Return beams that divide this one into equal parts, from aft to forward.

        Images with these beams are looks from different aspects: their speckle is independent, and
        shadows fall in other directions. They resolve `count` times less along the track.

        Parameters
        ----------
        count : int
            Number of parts, at least 1. All are equally wide in the sine of the aspect angle, that
            is along the track.

        Raises
        ------
        TypeError, ValueError
            If the number is not a positive whole number, the parts are too narrow, or the shape is
            "inverse", whose weights do not follow from the width.

        See Also
        --------
        clsas.multilook : Mean power of several looks.

        Examples
        --------
        >>> import clsas
        >>> [f"{each.squint_deg:.2f}" for each in clsas.BeamWindow(20).divided(3)]
        ['-6.66', '0.00', '6.66']
        """
        count = validate.count("count", count)
        if self.shape == "inverse":
            raise ArgumentError(
                "shape",
                "not be 'inverse' to divide a beam",
                hint="its weights follow from the angle to the axis, and not from the width",
            )
        low, high = (math.sin(angle) for angle in self.limits_rad)
        if (high - low) / count < math.radians(_NARROWEST):
            allowed = f"leave parts of at least {_NARROWEST:g} degrees"
            raise ArgumentError("count", allowed, f"{count} parts of {self.width_deg:g} degrees")
        edges_deg = np.degrees(np.arcsin(np.linspace(low, high, count + 1).clip(-1, 1)))
        return tuple(
            replace(self, width_deg=float(last - first), squint_deg=float(first + last) / 2)
            for first, last in itertools.pairwise(edges_deg)
        )

    @property
    def limits_rad(self) -> tuple[float, float]:
        """Aspect angles at which the beam begins and ends, radians."""
        return (
            math.radians(self.squint_deg - self.width_deg / 2),
            math.radians(self.squint_deg + self.width_deg / 2),
        )

    @property
    def limits(self) -> tuple[float, float]:
        """Sines of `limits_rad`, between which weights are not 0. A limit at end-fire is -+2."""
        low, high = (math.sin(angle) for angle in self.limits_rad)
        return (low if low > -1 + 1e-12 else -_END_FIRE), (high if high < 1 - 1e-12 else _END_FIRE)

    @property
    def edge(self) -> float:
        """Approximate extent, in sine, over which the weights rise from 0 to 1."""
        share = max(self.taper, 0.02) if self.shape == "tukey" else 1.0
        return sine_width(self.limits) / 2 * share

    @property
    def jumps(self) -> bool:
        """True if the weights begin and end with a step, or nearly so."""
        return self.shape != "hann" and not (self._has_taper and self.taper > _STEEP_TAPER)

    @property
    def _has_taper(self) -> bool:
        """True for the shape "tukey" if its edges are at least as wide as a table interval."""
        return self.shape == "tukey" and self.taper * INTERVALS >= 2

    def block_error(self, reach: float) -> float:
        """Return the relative rms error if one cubic replaces the weights over a block of pixels.

        `reach` is the largest change of the sine from the middle of the block. The edges of "tukey"
        begin with a kink that no cubic follows. The other shapes are smooth between the limits.
        """
        reach = validate.number("reach", reach, least=0.0)
        width = sine_width(self.limits)
        if not self._has_taper:
            return 0.01 * (math.pi * reach / self.edge) ** 4
        x = math.pi * reach / (width / 2 * self.taper)
        return 0.04 * x**2 * math.sqrt(min(8 * reach / width, 1.0))

    def plane_error(self, reach: float, wavelength_m: float = math.inf) -> float:
        """Return the relative rms error if the sine is interpolated bilinearly over a longer block.

        Over a block of half length r at distance R, the sine deviates from linear by at most
        0.6 (r/R)^2, where r/R is `reach`. This shifts the edges of the beam. Where the weights
        begin with a step, the shift adds or drops channels.
        """
        reach = validate.number("reach", reach, least=0.0, most=1e6)
        square = self._all(wavelength_m) ** 2
        jump = (square[0] + square[-1]) / 2 / square.mean()
        bend = reach**2 / self.edge
        return math.hypot(0.5 * bend, math.sqrt(0.3 * jump * bend))

    def fullness(
        self, sine: NDArray[np.float64], wavelength_m: float = math.inf, share: float = 1.0
    ) -> float:
        """Return the rms of the weights that an image uses over the rms of all weights, at most 1.

        Relative errors grow by the inverse of the fullness. It is small for an image that only the
        edge of the beam covers. Normalising lowers it further, because it amplifies poorly covered
        pixels.

        Parameters
        ----------
        sine : float64 [channels, points]
            Sines of the aspect angles at which some channels receive from some points.
        wavelength_m : float
            Wavelength of the carrier, metres; used by "inverse".
        share : float
            Number of channels in `sine` over the number of all channels.
        """
        share = validate.positive("share", share)
        sine = validate.array("sine", sine, np.float64, None)
        weights = self.weights(sine, wavelength_m)
        visible = weights[weights > 0]
        if not visible.size:
            return 1.0
        rms, of_all = (np.sqrt(np.mean(each**2)) for each in (visible, self._all(wavelength_m)))
        result = float(min(rms / of_all, 1.0))
        if self.normalise:
            sums = weights.sum(axis=0) / share
            # If a point is not covered at all, the sums of pixels between it and covered ones take
            # all small values.
            least = [] if sums.all() else [LEAST_WEIGHT_SUM]
            amplified = sums.max() / np.maximum(np.append(sums[sums > 0], least), LEAST_WEIGHT_SUM)
            result /= float(np.sqrt(np.mean(amplified**2)))
        return result

    def _all(self, wavelength_m: float) -> NDArray[np.float64]:
        """Return the weights at 65 sines, spread evenly over the whole beam."""
        wavelength_m = _positive_or_infinite(wavelength_m)
        low, high = np.clip(self.limits, -1, 1)
        return self._inside(np.linspace(float(low), float(high), 65), wavelength_m)

    def weights(self, q: ArrayLike, wavelength_m: float = math.inf) -> NDArray[np.float64]:
        """Return the weights at sines of the aspect angle.

        Parameters
        ----------
        q : array_like
            Sines of the aspect angle.
        wavelength_m : float
            Wavelength of the carrier, metres; used by "inverse".

        Returns
        -------
        float64 array of the shape of `q`

        Raises
        ------
        TypeError, ValueError
            If `q` does not consist of finite real numbers, or the wavelength is not positive.
        """
        q = validate.array("q", q, np.float64, None)
        wavelength_m = _positive_or_infinite(wavelength_m)
        inside = is_within(q, self.limits)
        weights = np.zeros(q.shape)
        weights[inside] = self._inside(q[inside], wavelength_m)
        return weights

    def table(self, wavelength_m: float = math.inf) -> NDArray[np.float32]:
        """Return the weights as a table of cubics, float32 [INTERVALS, 4], constant terms first.

        The cubics cover equal intervals of the sine between `limits` (or -1 and 1). The argument of
        each cubic runs from 0 to 1. Blocks of pixels also evaluate a cubic beyond its interval, so
        the cubic of an interval with a kink follows the side on which its middle lies.

        Raises
        ------
        ValueError
            If "inverse" would amplify by more than 40 dB.
        """
        wavelength_m = _positive_or_infinite(wavelength_m)
        low, high = np.clip(self.limits, -1, 1)
        nodes = np.array([0.0, 0.25, 0.75, 1.0])
        number = np.arange(INTERVALS)[:, None]
        q, middle = (
            low + (high - low) * (number + each) / INTERVALS for each in (nodes, np.array([0.5]))
        )
        values = self._inside(q, wavelength_m, middle)
        if not values.max() <= _MOST_WEIGHT:
            raise ArgumentError(
                "width_deg",
                f"keep 'inverse' within -40 dB of an element of {self.element_length_m:g} m at a "
                f"wavelength of {wavelength_m:g} m",
                f"{self.width_deg:g} degrees",
            )
        cubics = np.linalg.solve(np.vander(nodes, increasing=True), values.T).T
        return cubics.astype(np.float32)

    def directions(self, lines: RangeLines) -> NDArray[np.float64]:
        """Return the unit direction of the track at every channel, float64 [channels, 3].

        This is `along` if it was given. Otherwise it follows from the phase centres of the lines,
        smoothed over `track_pings` pings; see `track_directions`.

        Raises
        ------
        TypeError
            If `lines` is not a RangeLines.
        ValueError
            If `along` has another number of channels than the lines. If `along` is None, and there
            is only one ping or the platform stands still.
        """
        validate.instance("lines", lines, RangeLines)
        if self.along is None:
            return track_directions(lines, self.track_pings)
        if self.along.ndim == 2 and len(self.along) != lines.channels:
            allowed = f"have one direction, or one for each of {lines.channels} channels"
            raise ArgumentError("along", allowed, len(self.along))
        return np.broadcast_to(self.along, (lines.channels, 3))

    def _inside(
        self, q: NDArray[np.float64], wavelength_m: float, around: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Return the weights at sines `q`, continued smoothly beyond the limits.

        With `around`, they are also continued beyond the kinks of "tukey", from the side of the
        kink on which `around` lies.
        """
        angle, u = self._from_axis(q)
        if self.shape == "hann":
            return np.cos(np.pi * u) ** 2
        if self.shape == "hamming":
            return 0.54 + 0.46 * np.cos(2 * np.pi * u)
        if self.shape == "taylor":
            return _taylor(u)
        if self.shape == "tukey":
            if not self._has_taper:
                return np.ones_like(q)
            share, of_side = (
                np.maximum((0.5 - np.abs(each)) / self.taper, 0.0)
                for each in (u, u if around is None else self._from_axis(around)[1])
            )
            return np.sin(np.pi * np.where(of_side < 0.5, share, 0.5)) ** 2
        if self.shape == "inverse":
            assert self.element_length_m is not None  # as __post_init__ checked
            one_way = element_pattern(self.element_length_m, np.sin(angle), 1.0, wavelength_m)
            return 1 / np.maximum(one_way**2, 1e-30)
        assert self.shape == "rectangular"
        return np.ones_like(q)

    def _from_axis(self, q: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the angles from the beam's axis at sines `q`, in radians and in beam widths."""
        angle = np.arcsin(np.clip(q, -1, 1)) - math.radians(self.squint_deg)
        return angle, angle / math.radians(self.width_deg)


def _positive_or_infinite(wavelength_m: float) -> float:
    """Return a wavelength, checked; lines that are still on their carrier have an infinite one."""
    if isinstance(wavelength_m, float) and wavelength_m == math.inf:
        return math.inf
    return validate.positive("wavelength_m", wavelength_m, "m")


def _taylor(u: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the Taylor window at u from -0.5 to 0.5, scaled to 1 in the middle.

    The window is 1 + sum_m F_m cos(2 pi m u). Taylor's factors F_m give the nearest side lobes
    equal heights (Carrara, Goodman and Majewski 1995, pages 512-513).
    """
    terms = np.arange(1, _TAYLOR_TERMS)
    a = math.acosh(amplitude(_TAYLOR_SIDE_LOBES_DB)) / np.pi
    stretch = _TAYLOR_TERMS**2 / (a**2 + (_TAYLOR_TERMS - 0.5) ** 2)
    found = []
    for m in terms:
        zeros = np.prod(1 - m**2 / stretch / (a**2 + (terms - 0.5) ** 2))
        others = np.prod([1 - m**2 / n**2 for n in terms if n != m])
        found.append((-1) ** (m + 1) * zeros / others)
    factors = np.array(found)
    total = 1 + np.cos(2 * np.pi * np.asarray(u)[..., None] * terms) @ factors
    return total / (1 + factors.sum())


def normalising(sums: NDArray[np.floating], channels: int) -> NDArray[np.floating]:
    """Return the factors by which a normalising beam multiplies pixels with given weight sums."""
    return (channels / np.maximum(sums, LEAST_WEIGHT_SUM)).astype(sums.dtype)


def scale_to_all(beam: BeamWindow | None, channels: int, all_channels: int) -> np.float32:
    """Return the factor for an image of some channels that is a part of the image of all.

    It is 1 unless the beam normalises, which multiplies pixels by the number of their channels.
    """
    is_normalised = beam is not None and beam.normalise
    return np.float32(all_channels / channels if is_normalised else 1.0)


def track_directions(lines: RangeLines, pings: int | None = None) -> NDArray[np.float64]:
    """Return the unit direction of the track at every channel, float64 [channels, 3].

    Local cubics are fitted to the mean phase centres of the pings by least squares (Savitzky and
    Golay 1964). Their tangents are interpolated to each channel. Legs of a track that are far apart
    are smoothed separately. Channels may be in any order: if pings jump, each follows the nearest
    one, in the direction in which most of them advance.

    Parameters
    ----------
    lines : RangeLines
    pings : int, optional
        Number of pings that each fit spans. The default is a quarter of all pings, between 5 and
        101.

    Raises
    ------
    ValueError
        If there is only one ping, or the platform stands still.
    """
    if (order := _along_track(lines)) is not None:
        found = np.empty((lines.channels, 3))
        found[order] = _directions(lines.without_samples().select(order), pings)
        return found
    return _directions(lines, pings)


def _directions(lines: RangeLines, pings: int | None) -> NDArray[np.float64]:
    """Return the direction of the track at every channel, whose order follows the track."""
    channels_m = lines.phase_centres_m
    count = len(lines.ping_starts)
    if count < 2:
        hint = f"{lines.channels} channels with one transmitter position have no track"
        raise ArgumentError("along", "be given", hint=hint)
    centres_m = lines.ping_centres_m
    span = pings or min(max(count // _SMOOTHED_SHARE, 5), MOST_TRACK_PINGS)
    tangent = np.concatenate([_tangents(leg_m, span) for leg_m in _legs(centres_m)])
    speed = np.linalg.norm(tangent, axis=1)
    extent_m = np.linalg.norm(np.ptp(centres_m, axis=0))
    if not speed.min() > 1e-3 * extent_m / count:
        raise ArgumentError(
            "along",
            "be given",
            hint=f"the phase centres of the lines stand still around ping {speed.argmin()}; "
            "`lines.without_still_pings()` drops such pings",
        )
    tangent /= speed[:, None]
    # The front channels of a long array lie where the middle of later pings will be.
    ping = lines.ping_numbers
    steps_m = np.linalg.norm(np.diff(centres_m, axis=0), axis=1)
    travelled_m = np.concatenate([[0.0], np.cumsum(steps_m)])
    ahead_m = channels_m - centres_m[ping]
    at_m = travelled_m[ping] + np.einsum("ci,ci->c", ahead_m, tangent[ping])
    found = np.stack([np.interp(at_m, travelled_m, each) for each in tangent.T], axis=-1)
    return unit_vectors(found)


def _along_track(lines: RangeLines) -> NDArray[np.int64] | None:
    """Return the order in which channels follow the track; None if theirs does."""
    centres_m = lines.ping_centres_m
    steps_m = np.linalg.norm(np.diff(centres_m, axis=0), axis=1)
    if steps_m.sum() <= _WINDING * np.linalg.norm(np.ptp(centres_m, axis=0)):
        return None
    pings_m, ping = np.unique(lines.tx_m, axis=0, return_inverse=True)
    if not 2 * SHORTEST_LEG < len(pings_m) <= _MOST_SORTED:
        return None
    ping = ping.ravel()
    from scipy.spatial import cKDTree  # slow to import

    apart_m = np.median(cKDTree(pings_m).query(pings_m, k=2)[0][:, 1])
    if np.mean(steps_m > PASS_JUMP * apart_m) <= _JUMPS:
        return None
    rank = np.empty(len(pings_m), np.int64)
    left_m = pings_m.copy()
    at = int(np.argmax(np.linalg.norm(pings_m - pings_m.mean(axis=0), axis=1)))  # an end
    for number in range(len(pings_m)):
        rank[at] = number
        here_m, left_m[at] = pings_m[at], np.inf
        at = int(np.argmin(np.sum((left_m - here_m) ** 2, axis=1)))
    if np.count_nonzero(np.diff(rank[ping]) < 0) > np.count_nonzero(np.diff(rank[ping]) > 0):
        rank = rank.max() - rank
    return np.argsort(rank[ping], kind="stable")


def _legs(centres_m: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Return the phase centres of the pings, [n, 3], split where the track jumps."""
    steps_m = np.linalg.norm(np.diff(centres_m, axis=0), axis=1)
    median_m = np.median(steps_m)
    starts = [0]
    for start in np.flatnonzero(steps_m > PASS_JUMP * median_m) + 1 if median_m else ():
        if min(start - starts[-1], len(centres_m) - start) >= SHORTEST_LEG:
            starts.append(int(start))
    return np.split(centres_m, starts[1:])


def _tangents(centres_m: NDArray[np.float64], pings: int) -> NDArray[np.float64]:
    """Return the tangents of local cubics through `pings` pings of one leg, [n, 3]."""
    count = len(centres_m)
    # The filter needs an odd number of pings, and a cubic at least four.
    window = min(2 * (pings // 2) + 1, count - 1 + count % 2)
    if window < 2:
        return np.diff(centres_m, axis=0).repeat(2, axis=0)
    # scipy.signal has this filter, but importing it takes longer than planning most images.
    half = window // 2
    powers = np.vander(np.arange(-half, half + 1), min(3, window - 1) + 1, increasing=True)
    fit = np.linalg.pinv(powers.astype(np.float64))  # coefficients of the cubic, from positions
    tangents = correlate1d(centres_m, fit[1], axis=0)
    # The first and the last cubic are also used for the pings before and after their middle.
    orders = np.arange(powers.shape[1])
    slopes = orders[1:] * np.vander(np.arange(-half, half + 1), len(orders) - 1, increasing=True)
    tangents[: half + 1] = slopes[: half + 1] @ (fit @ centres_m[:window])[1:]
    tangents[-half - 1 :] = slopes[half:] @ (fit @ centres_m[-window:])[1:]
    return tangents
