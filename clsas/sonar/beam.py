"""Beam windows: what a channel weighs in a pixel, by the angle at which it sees it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.distance import cdist

from clsas.core import reprs, validate
from clsas.core.lines import RangeLines
from clsas.sonar.system import element_pattern

SHAPES = ("rectangular", "hann", "hamming", "taylor", "tukey", "inverse")

INTERVALS = 1024
"""Cubics of a table: enough for the kinks of a Tukey window."""

HARDLY_SEEN = 0.01
"""A sum of weights below which normalised pixels fade to 0."""

MOST_TRACK_PINGS = 101
"""Pings over which a track's direction is smoothed at most, unless told otherwise."""

_NARROWEST = 1e-3  # degrees: float32 holds a hundredth of it
_BEYOND = 2.0  # for a limit at end-fire: a sine that rounding does not reach
_HALF_POWER = 0.442946  # sinc^2 is 1/2 here
_MOST_WEIGHT = 100.0
_TAYLOR_TERMS, _TAYLOR_SIDE_LOBES_DB = 4, 30.0  # SciPy's choice
_TRACK_SHARE = 4  # the track's direction is that of cubics through this part of the pings
_JUMP, _SHORTEST_LEG = 10.0, 5  # steps in usual ones between legs, and pings of a leg
_ROUNDING = 1e-5  # of sines on the device, amply
_CHANNELS_TOGETHER = 16
_NEARLY_A_STEP = 0.1  # of the width of a window: what its edges take


@dataclass(frozen=True, eq=False)
class BeamWindow:
    """Weights of the channels by aspect angle, so that an image uses a part of the beam only.

    A pixel x is seen by a channel at the aspect angle theta from broadside,

        sin(theta) = t . (x - p)/|x - p|,   p = (tx + rx)/2,

    with t the unit direction of the track, and weighs a function of theta - squint.

    Parameters
    ----------
    width_deg : float
        Full width, 0.001 to 180 degrees; beyond half of it on either side the weight is 0.
    shape : str
        "rectangular", "hann", "hamming", "taylor" (4 terms, side lobes at -30 dB), "tukey" or
        "inverse"; all but the last are 1 in the middle, and functions of (theta - squint)/width.
        "inverse" divides by the two-way pattern sinc^2(L/lambda sin(theta - squint)) of elements
        of length L at the lines' carrier.
    squint_deg : float
        Middle of the window, degrees ahead of broadside; the whole window lies within +-90.
    taper : float
        For "tukey": which part of the width, 0 to 1, its two raised-cosine edges take together;
        below 1/512 it has none.
    element_length_m : float, optional
        For "inverse": L. It may amplify by 40 dB at most.
    along : array_like, [3] or [channels, 3], optional
        Direction of the track, of any length. Unless given it is that of a smooth curve through
        the lines' phase centres, see `directions`.
    track_pings : int, optional
        Over how many pings the direction of the track is smoothed, from 5; a quarter of them, 101
        at most, unless given.
    normalise : bool
        Multiply every pixel by channels / sum_i w_i(x), w_i the weights: a point has the amplitude
        it has without a window, also near the ends of the aperture, where fewer channels see it.
        (Noise there grows, by the root of that.) Channels weigh in the sum whether or not the
        pixel lies within their lines. Below a sum of 0.01 pixels fade to 0.

    Raises
    ------
    TypeError, ValueError
        If a value is of a wrong kind or outside its limits.
    """

    width_deg: float
    shape: str = "rectangular"
    squint_deg: float = 0.0
    taper: float = 0.5
    element_length_m: float | None = None
    along: NDArray[np.float64] | None = None
    normalise: bool = False
    track_pings: int | None = None

    if TYPE_CHECKING:  # arrays are converted: the constructor takes what holds numbers

        def __init__(
            self,
            width_deg: float,
            shape: str = "rectangular",
            squint_deg: float = 0.0,
            taper: float = 0.5,
            element_length_m: float | None = None,
            along: ArrayLike | None = None,
            normalise: bool = False,
            track_pings: int | None = None,
        ) -> None: ...

    __repr__ = reprs.of_fields

    def __post_init__(self) -> None:  # noqa: D105
        width = validate.number(
            "width_deg", self.width_deg, "degrees", least=_NARROWEST, most=180.0
        )
        room = 90 - width / 2
        fields = {
            "width_deg": width,
            "shape": validate.one_of("shape", self.shape, SHAPES),
            "squint_deg": validate.number(
                "squint_deg", self.squint_deg, "degrees", least=-room, most=room
            ),
            "taper": validate.number("taper", self.taper, least=0.0, most=1.0),
        }
        if self.element_length_m is not None:
            length = validate.positive("element_length_m", self.element_length_m, "m")
            fields["element_length_m"] = length
        elif self.shape == "inverse":
            raise ValueError("element_length_m must be given for the shape 'inverse'")
        if self.along is not None:
            shape = (3,) if np.ndim(self.along) == 1 else (None, 3)
            along = validate.array("along", self.along, np.float64, shape)
            largest = np.abs(along).max(axis=-1, keepdims=True)
            if not largest.all():
                raise ValueError("along must hold directions of some length, got zeros")
            along = along / largest  # so that no square overflows or vanishes
            fields["along"] = along / np.linalg.norm(along, axis=-1, keepdims=True)
        if self.track_pings is not None:
            fields["track_pings"] = validate.count("track_pings", self.track_pings, least=5)
        if not isinstance(self.normalise, (bool, np.bool_)):
            raise TypeError(
                f"normalise must be True or False, got {validate.shown(self.normalise)}"
            )
        for name, value in fields.items():
            object.__setattr__(self, name, value)

    @classmethod
    def of_element(
        cls, length_m: float, wavelength_m: float, shape: str = "rectangular", **others: Any
    ) -> BeamWindow:
        """Return the window as wide as an element's beam.

        Its edges are where one element's pattern is at -3 dB and the two-way one at -6 dB,
        sin(width/2) = 0.443 wavelength/length: the half-power beamwidth of the textbooks, 0.886
        wavelength/length, which resolves half an element. An element shorter than 0.443
        wavelengths has no such edge: the window is 180 degrees wide.

        Parameters
        ----------
        length_m : float
            Of the element along the track.
        wavelength_m : float
            At the carrier.
        shape : str
            See `BeamWindow`.
        **others
            Further parameters of `BeamWindow`; `element_length_m` is `length_m` unless given.

        Raises
        ------
        TypeError, ValueError
            As `BeamWindow` does.
        """
        length = validate.positive("length_m", length_m, "m")
        wavelength = validate.positive("wavelength_m", wavelength_m, "m")
        width = 2 * math.degrees(math.asin(min(_HALF_POWER * wavelength / length, 1.0)))
        return cls(width, shape, **({"element_length_m": length} | others))

    @property
    def limits_rad(self) -> tuple[float, float]:
        """Aspect angles at which the window begins and ends."""
        return (
            math.radians(self.squint_deg - self.width_deg / 2),
            math.radians(self.squint_deg + self.width_deg / 2),
        )

    @property
    def limits(self) -> tuple[float, float]:
        """Sines between which a weight is not 0: of `limits_rad`, and -+2 at end-fire."""
        low, high = (math.sin(angle) for angle in self.limits_rad)
        return (low if low > -1 + 1e-12 else -_BEYOND), (high if high < 1 - 1e-12 else _BEYOND)

    @property
    def edge(self) -> float:
        """Over which part of the sine it rises from nothing to all, roughly."""
        low, high = np.clip(self.limits, -1, 1)
        return (high - low) / 2 * (max(self.taper, 0.02) if self.shape == "tukey" else 1.0)

    @property
    def jumps(self) -> bool:
        """Whether its weights jump where it begins and ends, or nearly so."""
        return self.shape != "hann" and not (self._has_taper and self.taper > _NEARLY_A_STEP)

    @property
    def _has_taper(self) -> bool:
        """Whether it is "tukey" with edges: none are narrower than an interval of the table."""
        return self.shape == "tukey" and self.taper * INTERVALS >= 2

    def block_error(self, reach: float) -> float:
        """Return the relative rms error of taking the weights over a block as one cubic.

        `reach` is by how much the sine may change from the block's middle. The edges of "tukey"
        begin with a kink, which no cubic follows; the other shapes are smooth between the limits.
        """
        low, high = np.clip(self.limits, -1, 1)
        width = high - low
        if not self._has_taper:
            return 0.01 * (math.pi * reach / self.edge) ** 4
        x = math.pi * reach / (width / 2 * self.taper)
        return 0.04 * x**2 * math.sqrt(min(8 * reach / width, 1.0))

    def plane_error(self, reach: float, wavelength_m: float = math.inf) -> float:
        """Return the relative rms error of taking the sine as bilinear over a longer block.

        Along a block of half a length r at the distance R it bends by 0.6 (r/R)^2 at most. By as
        much edges are displaced; where the weights jump there, channels come in or are lost.
        """
        square = self._all(wavelength_m) ** 2
        jump = (square[0] + square[-1]) / 2 / square.mean()
        bend = reach**2 / self.edge
        return math.hypot(0.5 * bend, math.sqrt(0.3 * jump * bend))

    def fullness(
        self, sine: NDArray[np.float64], wavelength_m: float = math.inf, share: float = 1.0
    ) -> float:
        """Return the rms of the weights at sines [channels, points] over that of all, 1 at most.

        An image that sees an edge of the window only errs by as much more; and a normalised one by
        as much as it amplifies what is seen less. Sines are of a `share` of the channels.
        """
        weights = self.weights(sine, wavelength_m)
        seen = weights[weights > 0]
        if not seen.size:
            return 1.0
        rms, of_all = (np.sqrt(np.mean(each**2)) for each in (seen, self._all(wavelength_m)))
        result = float(min(rms / of_all, 1.0))
        if self.normalise:
            sums = weights.sum(axis=0) / share
            least = [] if sums.all() else [HARDLY_SEEN]  # at the edge of what is seen
            amplified = sums.max() / np.maximum(np.append(sums[sums > 0], least), HARDLY_SEEN)
            result /= float(np.sqrt(np.mean(amplified**2)))
        return result

    def _all(self, wavelength_m: float) -> NDArray[np.float64]:
        """Return weights all over the window."""
        low, high = np.clip(self.limits, -1, 1)
        return self._inside(np.linspace(float(low), float(high), 65), wavelength_m)

    def weights(self, q: ArrayLike, wavelength_m: float = math.inf) -> NDArray[np.float64]:
        """Return the weights at sines `q` of the aspect angle; `wavelength_m` is for "inverse"."""
        q = np.asarray(q, np.float64)
        low, high = self.limits
        inside = (q > low) & (q < high)
        weights = np.zeros(q.shape)
        weights[inside] = self._inside(q[inside], wavelength_m)
        return weights

    def table(self, wavelength_m: float = math.inf) -> NDArray[np.float32]:
        """Return the weights as cubics, float32 [INTERVALS, 4], constant terms first.

        Their argument runs from 0 to 1 over each of equal intervals of the sine between `limits`,
        or -1 and 1. Blocks of pixels take one beyond its interval, too: where a kink lies in an
        interval, its cubic is that of the side on which its middle lies.

        Raises
        ------
        ValueError
            If "inverse" would have to amplify by more than 40 dB.
        """
        low, high = np.clip(self.limits, -1, 1)
        place = np.array([0.0, 0.25, 0.75, 1.0])
        number = np.arange(INTERVALS)[:, None]
        q, middle = (
            low + (high - low) * (number + each) / INTERVALS for each in (place, np.array([0.5]))
        )
        values = self._inside(q, wavelength_m, middle)
        if not values.max() <= _MOST_WEIGHT:
            raise ValueError(
                f"width_deg must keep 'inverse' within -40 dB of an element of "
                f"{self.element_length_m:g} m at a wavelength of {wavelength_m:g} m, "
                f"got {self.width_deg:g} degrees"
            )
        cubics = np.linalg.solve(np.vander(place, increasing=True), values.T).T
        return cubics.astype(np.float32)

    def directions(self, lines: RangeLines) -> NDArray[np.float64]:
        """Return the unit direction of the track for every channel, float64 [channels, 3].

        That is `along`, or from the lines the tangent, next to each phase centre, of local cubics:
        least-squares fits to the phase centres of `track_pings` pings each. Successive channels of
        one transmitter position are a ping. A step of ten usual ones begins another leg, which is
        smoothed by itself.

        Raises
        ------
        TypeError
            If `lines` is of another type.
        ValueError
            If `along` is of another number of channels, or not given where there is one ping only
            or a track stands still.
        """
        validate.instance("lines", lines, RangeLines)
        if self.along is not None:
            if self.along.ndim == 2 and len(self.along) != lines.channels:
                raise ValueError(
                    f"along must hold one direction or one for each of {lines.channels} channels, "
                    f"got {len(self.along)}"
                )
            return np.broadcast_to(self.along, (lines.channels, 3))
        first, channels_m = lines.ping_starts, lines.phase_centres_m
        pings = len(first)
        if pings < 2:
            raise ValueError(
                f"along must be given: {lines.channels} channels of one transmitter position have "
                f"no track"
            )
        counts = np.diff(np.append(first, lines.channels))
        centres_m = np.add.reduceat(channels_m, first, axis=0) / counts[:, None]
        wanted = self.track_pings or min(max(pings // _TRACK_SHARE, 5), MOST_TRACK_PINGS)
        tangent = np.concatenate([_tangents(leg_m, wanted) for leg_m in _legs(centres_m)])
        speed = np.linalg.norm(tangent, axis=1)
        extent_m = np.linalg.norm(np.ptp(centres_m, axis=0))
        if not speed.min() > 1e-3 * extent_m / pings:
            raise ValueError("along must be given: the lines' phase centres stand still")
        tangent /= speed[:, None]
        # Of an array, a channel ahead of its ping's middle lies where later pings are.
        ping = np.repeat(np.arange(pings), counts)
        steps_m = np.linalg.norm(np.diff(centres_m, axis=0), axis=1)
        covered_m = np.concatenate([[0.0], np.cumsum(steps_m)])
        ahead_m = channels_m - centres_m[ping]
        place_m = covered_m[ping] + np.einsum("ci,ci->c", ahead_m, tangent[ping])
        found = np.stack([np.interp(place_m, covered_m, each) for each in tangent.T], axis=-1)
        return found / np.linalg.norm(found, axis=1, keepdims=True)

    def _inside(
        self, q: NDArray[np.float64], wavelength_m: float, around: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Return the weights as if the window had no end.

        Where it has kinks, those on the side of a kink where `around` lies go on beyond it.
        """
        angle, u = self._place(q)
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
                for each in (u, u if around is None else self._place(around)[1])
            )
            return np.sin(np.pi * np.where(of_side < 0.5, share, 0.5)) ** 2
        if self.shape == "inverse":
            assert self.element_length_m is not None  # as checked when this was made
            one_way = element_pattern(self.element_length_m, np.sin(angle), 1.0, wavelength_m)
            return 1 / np.maximum(one_way**2, 1e-30)
        return np.ones_like(q)

    def _place(self, q: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return angles from the window's middle of some sines, in radians and in widths."""
        angle = np.arcsin(np.clip(q, -1, 1)) - math.radians(self.squint_deg)
        return angle, angle / math.radians(self.width_deg)


def sines(
    points_m: NDArray[np.float64],
    phase_centres_m: NDArray[np.float64],
    along: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the sine of the aspect angle of every point, float64 [channels, points].

    Takes points [points, 3] and the phase centre and the direction of every channel, [channels, 3];
    a phase centre's own sine is 0.
    """
    return _sines(points_m, phase_centres_m, along)[0].T


def channel_ranges(
    window: BeamWindow,
    lines: RangeLines,
    along: NDArray[np.float64],
    centres_m: NDArray[np.float64],
    radius_m: float,
) -> NDArray[np.int32]:
    """Return which channels may see balls of one radius about centres [parts, 3], int32 [parts, 2].

    That is the first channel whose window touches a ball and the one after the last; both 0 where
    there is none. Runs of channels are tried before single ones.
    """
    phase_centres_m = lines.phase_centres_m
    count, run = lines.channels, _CHANNELS_TOGETHER
    starts = np.arange(0, count, run)
    run_of = np.arange(count) // run
    # A run is one channel in its middle, less sharp by how far its channels lie and point apart.
    middle_m = np.add.reduceat(phase_centres_m, starts, axis=0) / np.bincount(run_of)[:, None]
    reach_m = np.linalg.norm(phase_centres_m - middle_m[run_of], axis=1)
    direction = along[starts]
    spread = np.linalg.norm(along - direction[run_of], axis=1)
    sine, distance_m = _sines(centres_m, middle_m, direction)
    seen = _touches(
        window,
        sine,
        distance_m,
        radius_m + np.maximum.reduceat(reach_m, starts),
        np.maximum.reduceat(spread, starts),
    )
    some = np.flatnonzero(seen.any(axis=1))
    ranges = np.zeros((len(centres_m), 2), np.int32)
    if not some.size:
        return ranges
    seen = seen[some]

    def touched(runs: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return which channels of one run for each part touch it; the last stands for none."""
        index = np.minimum(runs[:, None] * run + np.arange(run), count - 1)
        square, sine = np.zeros(index.shape), np.zeros(index.shape)
        for axis in range(3):
            offset_m = centres_m[some, axis, None] - phase_centres_m[index, axis]
            sine += offset_m * along[index, axis]
            square += offset_m * offset_m
        distance_m = np.sqrt(square)
        return _touches(window, sine / np.maximum(distance_m, 1e-30), distance_m, radius_m)

    first = seen.argmax(axis=1)
    last = len(starts) - 1 - seen[:, ::-1].argmax(axis=1)
    inside = touched(first)
    begin = run * first + np.where(inside.any(axis=1), inside.argmax(axis=1), run)
    inside = touched(last)
    end = run * (last + 1) - np.where(inside.any(axis=1), inside[:, ::-1].argmax(axis=1), run)
    end = np.minimum(end, count)
    ranges[some, 0] = np.where(begin < end, begin, 0)
    ranges[some, 1] = np.where(begin < end, end, 0)
    return ranges


@dataclass(frozen=True, eq=False)
class Sight:
    """How places on a track see points, and boxes about them.

    Attributes
    ----------
    sine, inverse_m : float64 [points, places]
        Of the aspect angle of a point, and one over its distance.
    axes_m : float64 [axes, 3]
        Along the sides of boxes.
    slopes : float64 [axes, points, places]
        By how much the sine changes along each, at most.
    """

    sine: NDArray[np.float64]
    inverse_m: NDArray[np.float64]
    axes_m: NDArray[np.float64]
    slopes: NDArray[np.float64]

    @classmethod
    def of(
        cls,
        points_m: NDArray[np.float64],
        axes_m: NDArray[np.float64],
        track_m: NDArray[np.float64],
        along: NDArray[np.float64],
        index: NDArray[np.int64] | None = None,
    ) -> Sight:
        """Return how places [:, 3] on a track of some unit directions see points [n, 3].

        All of them see all points; with `index` [n, places] those see a point that it names.
        """
        changes = along @ axes_m.T  # [:, axes]
        slopes: Any  # an array, or a list of them
        changed: Any
        if index is None:
            sine, distance_m = _sines(points_m, track_m, along)
            slopes = (axes_m @ points_m.T)[..., None] - (axes_m @ track_m.T)[:, None]
            changed = changes.T
        else:
            sine, square = np.zeros(index.shape), np.zeros(index.shape)
            for point_m, place_m, direction in zip(points_m.T, track_m.T, along.T, strict=True):
                offset_m = point_m[:, None] - place_m[index]
                sine += offset_m * direction[index]
                square += offset_m * offset_m
            distance_m = np.sqrt(square)
            sine /= np.maximum(distance_m, 1e-9)
            towards_m = axes_m @ points_m.T
            slopes = [
                each[:, None] - of_place[index]
                for each, of_place in zip(towards_m, axes_m @ track_m.T, strict=True)
            ]
            changed = [each[index] for each in changes.T]
        inverse_m = 1 / np.maximum(distance_m, 1e-9, out=distance_m)
        for slope, change in zip(slopes, changed, strict=True):
            slope *= inverse_m
            slope *= sine
            np.subtract(change, slope, out=slope)
            slope *= inverse_m
            np.abs(slope, out=slope)
        return cls(sine, inverse_m, axes_m, slopes)

    def inside_by(
        self,
        limits: tuple[float, float],
        half: NDArray[np.float64],
        around_m: float | NDArray[np.float64] = 0.0,
        spread: float | NDArray[np.float64] = 0.0,
    ) -> NDArray[np.float64]:
        """Return how far into a window boxes about the points reach, [points, places].

        That is in sines of the aspect angle, negative where a box lies outside.

        Parameters
        ----------
        limits : (low, high)
            Sines between which the window lies.
        half : float64 [axes]
            Half their sides, in lengths of the axes.
        around_m, spread : float or float64 [places]
            How far from the places other positions and directions may lie that they stand for.
        """
        radius_m = np.linalg.norm(np.abs(half[:, None] * self.axes_m).sum(axis=0))
        reach = radius_m * self.inverse_m
        reach *= reach
        for each, slope in zip(half, self.slopes, strict=True):
            reach += each * slope
        low, high = limits
        if np.any(around_m) or np.any(spread):
            ratio = np.minimum(around_m * self.inverse_m, 0.5)
            # From so much nearer the box reaches further; half way to it, anywhere.
            reach = (reach + ratio + ratio**3) / (1 - ratio) + spread
            reach[ratio == 0.5] = np.inf
        # Beyond which of the limits: the one that is nearer.
        reach -= np.abs(self.sine - (low + high) / 2)
        reach += (high - low) / 2
        return reach


def touches_boxes(
    limits: tuple[float, float],
    centres_m: NDArray[np.float64],
    half_m: NDArray[np.float64],
    track_m: NDArray[np.float64],
    along: NDArray[np.float64],
    around_m: float | NDArray[np.float64] = 0.0,
    spread: float | NDArray[np.float64] = 0.0,
) -> NDArray[np.bool_]:
    """Return whether a window may touch boxes, bool [boxes, places]; see `Sight`.

    Parameters
    ----------
    limits : (low, high)
        Sines of the aspect angle between which the window lies.
    centres_m : float64 [boxes, 3]
    half_m : float64 [axes, 3]
        Half their sides, as vectors.
    track_m, along : float64 [places, 3]
        Positions on the track and its unit direction there.
    around_m, spread : float or float64 [places]
        How far from them other positions and directions may lie that these stand for.
    """
    sight = Sight.of(centres_m, half_m, track_m, along)
    return sight.inside_by(limits, np.ones(len(half_m)), around_m, spread) > 0


def _sines(
    points_m: NDArray[np.float64], centres_m: NDArray[np.float64], along: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return sines of aspect angles, 0 at 0 m, and distances, [points, centres]."""
    origin_m = centres_m[0]  # so that little cancels
    distance_m = cdist(points_m, centres_m)
    sine = (points_m - origin_m) @ along.T
    sine -= np.einsum("ci,ci->c", centres_m - origin_m, along)
    sine /= np.where(distance_m > 0, distance_m, np.inf)
    return sine, distance_m


def _touches(
    window: BeamWindow,
    sine: NDArray[np.float64],
    distance_m: NDArray[np.float64],
    radius_m: float | NDArray[np.float64],
    spread: float | NDArray[np.float64] = 0.0,
) -> NDArray[np.bool_]:
    """Return whether a window may touch a ball, seen at a sine and a distance.

    `spread` is by how much the direction may be another: the length of a unit vector's change.
    """
    low, high = window.limits
    ratio = radius_m / np.maximum(distance_m, 1e-30)
    # The way to a point of the ball turns by asin(ratio) at most, its unit vector by that chord.
    wider = ratio * (1 + 0.42 * ratio * ratio) + (spread + _ROUNDING)
    return (ratio >= 1) | ((sine + wider > low) & (sine - wider < high))


def _legs(centres_m: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Return the phase centres of pings, [n, 3], leg by leg: where a track goes on elsewhere."""
    steps_m = np.linalg.norm(np.diff(centres_m, axis=0), axis=1)
    usual_m = np.median(steps_m)
    starts = [0]
    for start in np.flatnonzero(steps_m > _JUMP * usual_m) + 1 if usual_m else ():
        if min(start - starts[-1], len(centres_m) - start) >= _SHORTEST_LEG:
            starts.append(int(start))
    return np.split(centres_m, starts[1:])


def _tangents(centres_m: NDArray[np.float64], pings: int) -> NDArray[np.float64]:
    """Return the tangents of local cubics through so many of a leg's pings, [n, 3]."""
    count = len(centres_m)
    # Odd, and four pings at least where there are as many.
    window = min(2 * (pings // 2) + 1, count - 1 + count % 2)
    if window < 2:
        return np.diff(centres_m, axis=0).repeat(2, axis=0)
    from scipy.signal import savgol_filter  # slow to import

    return savgol_filter(centres_m, window, min(3, window - 1), deriv=1, axis=0, mode="interp")


def _taylor(u: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the Taylor window at u from -0.5 to 0.5, 1 in its middle.

    1 + sum_m F_m cos(2 pi m u), with Taylor's factors for near side lobes of one height.
    """
    terms = np.arange(1, _TAYLOR_TERMS)
    a = math.acosh(10 ** (_TAYLOR_SIDE_LOBES_DB / 20)) / np.pi
    stretch = _TAYLOR_TERMS**2 / (a**2 + (_TAYLOR_TERMS - 0.5) ** 2)
    found = []
    for m in terms:
        zeros = np.prod(1 - m**2 / stretch / (a**2 + (terms - 0.5) ** 2))
        others = np.prod([1 - m**2 / n**2 for n in terms if n != m])
        found.append((-1) ** (m + 1) * zeros / others)
    factors = np.array(found)
    total = 1 + np.cos(2 * np.pi * np.asarray(u)[..., None] * terms) @ factors
    return total / (1 + factors.sum())
