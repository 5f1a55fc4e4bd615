"""Simulation of the raw echoes of a sonar on a track, or directly of range lines."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsas.engine.data import validate
from clsas.engine.data.decibels import amplitude
from clsas.engine.data.declared import Count, Flag, Number, Span, check_declared
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.sound_speed import USUAL_M_S, SoundSpeed, check_reaches
from clsas.engine.data.system import PASSBAND, Sonar
from clsas.engine.data.track import Channels, Pointing, Track, channels
from clsas.engine.data.validate import ArgumentError
from clsas.engine.signal.compression import Window, compress
from clsas.engine.signal.echoes import Echoes
from clsas.simulation.patterns import ElementPatterns
from clsas.simulation.recording import (
    NO_ECHO,
    RINGING,
    Paths,
    Progress,
    ReceiveWindows,
    record,
    scene_parts,
)
from clsas.simulation.scenes import PointTargets, Scene, Seabed

_LEAST_BAND_HZ = 1e-6  # arbitrary (a pulse of twelve days), but its inverse must be finite


def simulate(
    sonar: Sonar,
    track: Track,
    scene: Scene,
    *,
    pointing: Pointing | None = None,
    spreading: Annotated[bool, Flag("Divide echoes by the path lengths in metres.")] = False,
    motion_in_flight: Annotated[
        bool, Flag("Let the receivers move while the sound travels.")
    ] = False,
    element_pattern: Annotated[
        bool, Flag("Apply the patterns of elements that have sizes.")
    ] = True,
    phase_centres: Annotated[
        bool,
        Flag(
            "Put transmitter and receiver of every channel at their phase centre, as in a "
            "monostatic sonar."
        ),
    ] = False,
    range_m: Annotated[
        tuple[float, float] | None,
        Span(
            "m",
            least=0.0,
            help="Nearest and farthest range that is recorded, the same for every channel.",
            default="just what the echoes need",
        ),
    ] = None,
    snr_db: Annotated[
        float | None,
        Number(
            "dB",
            least=-200.0,
            most=300.0,
            help="Power of the strongest sample relative to the noise, before compression.",
            default="no noise",
        ),
    ] = None,
    seed: Annotated[int, Count(0, help="Seed of the noise.")] = 0,
    sound_speed: SoundSpeed | None = None,
    workers: int | None = None,
    progress: Progress = None,
) -> Echoes:
    """Return the echoes that a sonar on a track receives from a scene.

    Equations in brackets are those of Ødegaard (2004).

    Parameters
    ----------
    sonar : Sonar
        Element patterns [9]-[12] apply to elements that have sizes. Such elements are baffled: they
        neither transmit nor receive behind the plane of their face.
    track : Track
        Track of the sonar.
    scene : PointTargets, Seabed, or tuple of them
        Reflectors. The echoes of several parts add. Point targets neither cast shadows nor lie in
        them, and are never left out.
    pointing : Pointing, optional
        Direction of the elements, by default broadside. Allowed only for a sonar with element
        sizes.
    spreading : bool
        If True, divide each echo by the path lengths in metres, 1/(R_tx R_rx) [8].
    motion_in_flight : bool
        If True, the receivers move at the velocity of the track while the sound travels. The
        default is stop-and-hop.
    element_pattern : bool
        If True, apply the patterns of elements that have sizes. If False, every element is
        omnidirectional and not baffled.
    phase_centres : bool
        If True, put transmitter and receiver of every channel at their phase centre, as for a
        monostatic sonar with as many channels.
    range_m : (near, far), optional
        Receive window of every channel, metres: from the delay of range `near` to that of `far`
        plus the duration of the pulse [22], [23]. Echoes outside are cut. By default the window of
        each channel starts just before its first echo (for a seabed, before the echo of the nearest
        part within the beam), and all windows are long enough for every echo.
    snr_db : float, optional
        Signal-to-noise ratio of complex white Gaussian noise that is added, -200 to 300 dB. It is
        the power of the strongest noise-free sample of all channels over the mean power of the
        noise per sample, before compression.
    seed : int
        Seed of the noise, at least 0.
    sound_speed : SoundSpeed, optional
        Sound speed over depth. Sound then travels along exact rays. The sonar's speed only converts
        `range_m` to times, as it does for imagers. See Notes.
    workers : int, optional
        Number of threads; by default as many as there are cores.
    progress : callable, optional
        Called as progress(channels done, channels).

    Returns
    -------
    Echoes
        Complex baseband. `look_direction` is that of the pointing if element patterns are applied,
        otherwise None. `bank_numbers` are those of the sonar.

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type or is outside its limits, `sound_speed` does not reach an
        element or a point, a point lies in a shadow zone, `pointing` is given for omnidirectional
        elements, a point lies on an element while spreading or patterns are
        applied, `snr_db` is given but there is no echo, or the echoes, or the patterns of very long
        elements, do not fit into memory.

    Warns
    -----
    ClsasWarning
        If no echo arrives within the receive window, or spreading is limited near a caustic.

    See Also
    --------
    simulate_lines : Range lines of a scene, without a pulse or beams.
    compress : Range lines of echoes.

    Notes
    -----
    The visible part of a seabed is determined once per eight channels of a ping, from the middle
    between their transmitter and the mean of their receivers. For an element at a distance e from
    that middle, the edge of a shadow is displaced by e d/r, where r is the range of the object that
    casts the shadow and d the distance of the edge behind it.

    With `sound_speed`, delays are those of exact rays. Element patterns weigh the direction in
    which a ray leaves the transmitter and arrives at the receiver, at the wavelength there. The
    angle of incidence on a seabed and its shadows are those of rays too. Spreading follows from
    neighbouring rays: 1/(R_tx R_rx) becomes 1/(L_tx L_rx) with

        L^2 = D |dD/dp| sin(a) sin(b)/(p c_a c_b)

    for the horizontal distance D, the horizontal slowness p, and the angles to the horizontal a, b
    and sound speeds c_a, c_b at the two ends (Jensen et al., "Computational Ocean Acoustics", 2011,
    section 3.3.5). Near caustics, amplitudes are limited to 10 dB above those of straight paths.
    Phase jumps at caustics are left out.

    References
    ----------
    Ødegaard, "Fast time domain beamforming for synthetic aperture sonar", thesis, University of
    Oslo, 2004: equations in brackets.

    Examples
    --------
    >>> import clsas
    >>> pulse = clsas.Pulse(carrier_hz=100e3, bandwidth_hz=20e3, duration_s=1e-3)
    >>> sonar = clsas.Sonar(pulse, rx_m=[[0, 0, 0]])
    >>> track = clsas.Track.straight([0, 0, 0], [2, 0, 0], pings=20, ping_interval_s=0.1)
    >>> scene = clsas.PointTargets([[2, 40, 0]])
    >>> echoes = clsas.simulate(sonar, track, scene, range_m=(39, 41))
    >>> echoes
    Echoes(20 channels of 148 samples at 40 kHz, carrier 100 kHz)
    """
    validate.instance("sonar", sonar, Sonar)
    validate.instance("track", track, Track)
    validate.progress(progress)
    options = {
        "spreading": spreading, "motion_in_flight": motion_in_flight,
        "element_pattern": element_pattern, "phase_centres": phase_centres, "range_m": range_m,
        "snr_db": snr_db, "seed": seed,
    }  # fmt: skip
    check_declared(simulate, options)
    validate.instance("pointing", pointing, Pointing, type(None))
    validate.instance("sound_speed", sound_speed, SoundSpeed, type(None))
    check_size(sonar, track, range_m)
    parts = scene_parts(scene)
    patterns, look = None, None
    if not sonar.is_omnidirectional and element_pattern:
        patterns = ElementPatterns(sonar, (pointing or Pointing.broadside()).axes(track))
        look = np.repeat(patterns.axes[:, 1], sonar.receivers, axis=0)
    elif pointing is not None:
        why = "the elements have no sizes" if element_pattern else "`element_pattern` is off"
        raise ArgumentError("pointing", "be left out", hint=why)
    pulse, rate, sound = sonar.pulse, sonar.sample_rate_hz, sonar.sound_speed_m_s
    geometry = channels(sonar, track, motion_in_flight=motion_in_flight)
    if phase_centres:
        middle_m = (geometry.tx_m + geometry.rx_m) / 2
        geometry = geometry._replace(tx_m=middle_m, rx_m=middle_m)
    _check_heights(sound_speed, geometry, parts)
    paths = Paths(parts, geometry, sound, spreading, patterns, sonar.receivers, sound_speed)
    ringing = RINGING / rate
    if range_m is None:
        nearest, farthest = paths.delay_limits_s(workers)
        start = nearest - ringing
        longest = np.max(farthest + ringing - start)
    else:
        near, far = map(float, range_m)
        start = np.full(paths.channels, 2 * near / sound)
        longest = 2 * (far - near) / sound
    duration = longest + pulse.duration_s
    validate.memory(
        "track and scene" if range_m is None else "range_m", 8 * paths.channels * duration * rate
    )
    length = math.ceil(duration * rate) + 1

    windows = ReceiveWindows(
        rate,
        start,
        length,
        # Keep every echo that may lie partly in the window.
        kept_s=(start - pulse.duration_s - ringing, start + length / rate + ringing),
        tail=math.ceil(pulse.duration_s * rate) + 2 * RINGING,
    )
    samples = record(
        paths, pulse.spectrum, pulse.carrier_hz, windows, workers=workers, progress=progress
    )
    if snr_db is not None:
        _add_noise(samples, float(snr_db), seed)
    return Echoes(
        samples, start, rate, pulse.carrier_hz, geometry.tx_m, geometry.rx_m, sound, pulse,
        geometry.rx_velocity_m_s, look, track.georeference, sonar.channel_banks(track.pings),
        sound_speed,
    )  # fmt: skip


def check_size(sonar: Sonar, track: Track, range_m: ArrayLike | None = None) -> None:
    """Raise ValueError if even the shortest echoes of a survey do not fit into memory.

    The check needs neither the channels' positions nor a scene, so it is quick for any survey.
    """
    name, samples = "sonar and track", 2.0 * RINGING
    if range_m is not None:
        near, far = map(float, np.asarray(range_m))
        name, samples = "range_m", 2 * (far - near) / sonar.sound_speed_m_s * sonar.sample_rate_hz
    samples += sonar.pulse.duration_s * sonar.sample_rate_hz
    validate.memory(name, 8 * track.pings * sonar.receivers * samples)


def simulate_lines(
    tx_m: ArrayLike,
    rx_m: ArrayLike,
    scene: Scene,
    *,
    carrier_hz: float,
    bandwidth_hz: float,
    window: Window = "none",
    oversampling: float = 2.0,
    sound_speed_m_s: float = USUAL_M_S,
    first_range_m: ArrayLike | None = None,
    length: int | None = None,
    rx_velocity_m_s: ArrayLike | None = None,
    sound_speed: SoundSpeed | None = None,
    workers: int | None = None,
    progress: Progress = None,
) -> RangeLines:
    """Return range lines of a scene directly, without a pulse, echoes or beams.

    Parameters
    ----------
    tx_m, rx_m : array_like, [channels, 3] or [3]
        Transmitter and receiver position of each channel, metres.
    scene : PointTargets, Seabed, or tuple of them
        Reflectors, as for `simulate`. The visibility of a seabed is determined for every channel.
    carrier_hz, bandwidth_hz : float
        Centre and width of the band, hertz.
    window, oversampling
        As for `compress`. The range step is exactly c/(2 oversampling bandwidth).
    sound_speed_m_s : float
        Speed of sound, metres per second.
    first_range_m : array_like, [channels] or scalar, optional
        Range of the first sample of each line, metres; requires `length`. By default the lines
        contain every point and at least 90 more samples at either end.
    length : int, optional
        Number of samples of every line; requires `first_range_m`.
    rx_velocity_m_s : array_like, [channels, 3] or [3], optional
        Velocity of the receivers while the sound travels, metres per second. None means
        stop-and-hop.
    sound_speed : SoundSpeed, optional
        Sound speed over depth. Sound then travels along exact rays, and `sound_speed_m_s` only
        converts delays to ranges.
    workers, progress
        As for `simulate`.

    Returns
    -------
    RangeLines

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type or is outside its limits, shapes disagree, the lines do
        not fit into memory, `sound_speed` does not reach an antenna or a point, or a point lies in
        a shadow zone.

    Warns
    -----
    ClsasWarning
        If no point lies within the range of a line.

    See Also
    --------
    simulate : Echoes of a sonar on a track.

    Notes
    -----
    This is the linear operator from amplitudes a_s to compressed lines,

        s_i(n) = sum_s a_s p(r_n - rho_is) exp(-j 2 k rho_is).

    p is the response of the windowed band, with p(0) = 1. For window "none" it is sinc(2 B r/c).
    The sum is over the points whose range lies within the line.

    Examples
    --------
    >>> import clsas
    >>> tx_m = [[0, 0, 0], [0.5, 0, 0]]
    >>> scene = clsas.PointTargets([[0, 40, 0]])
    >>> clsas.simulate_lines(
    ...     tx_m, tx_m, scene, carrier_hz=100e3, bandwidth_hz=30e3, first_range_m=39, length=161
    ... )
    RangeLines(2 channels of 161 samples, range 39 to 41 m in steps of 12.5 mm, carrier 100 kHz)
    """
    carrier = validate.number("carrier_hz", carrier_hz, "Hz", least=0.0, most=validate.MOST_HZ)
    band = validate.number(
        "bandwidth_hz", bandwidth_hz, "Hz", least=_LEAST_BAND_HZ, most=validate.MOST_HZ
    )
    check_declared(compress, {"window": window, "oversampling": oversampling})
    validate.progress(progress)
    parts = scene_parts(scene)
    sound = validate.number(
        "sound_speed_m_s", sound_speed_m_s, "m/s", above=0.0, most=validate.MOST_M_S
    )
    validate.instance("sound_speed", sound_speed, SoundSpeed, type(None))
    antennas = _channels(tx_m, rx_m, rx_velocity_m_s)
    _check_heights(sound_speed, antennas, parts)
    paths = Paths(parts, antennas, sound, sound_speed=sound_speed)
    if (first_range_m is None) != (length is None):
        allowed = "be given together with `length` or not at all"
        raise ArgumentError("first_range_m", allowed)
    # The receiver's filter needs a guard band. If there is none, record at twice the rate.
    every = 1 if oversampling * PASSBAND >= 1 else 2
    rate = every * float(oversampling) * band
    step = every / rate
    if first_range_m is None or length is None:
        nearest, farthest = paths.delay_limits_s(workers)
        nearest, farthest = nearest - RINGING * step, farthest + RINGING * step
        extent = np.max(farthest - nearest) / step
        validate.memory("oversampling", 8 * every * paths.channels * extent)
        length = math.ceil(extent) + 1
    else:
        first = validate.array(
            "first_range_m", first_range_m, np.float64, (paths.channels,), broadcast=True
        )
        length = validate.count("length", length)
        validate.memory("length", 8 * every * paths.channels * length)
        with np.errstate(over="ignore"):  # an overflow is refused below
            nearest = 2 * first / sound
        farthest = nearest + (length - 1) * step
    validate.phase(carrier, sound, sound / 2 * float(np.abs([nearest, farthest]).max()))

    start = nearest - RINGING * step
    samples = record(
        paths,
        lambda frequency: np.full(len(frequency), 1 / band),
        carrier,
        ReceiveWindows(
            rate, start, every * (length + 2 * RINGING), kept_s=(nearest, farthest), tail=0
        ),
        workers=workers,
        progress=progress,
    )
    geometry = paths.geometry
    echoes = Echoes(
        samples, start, rate, carrier, geometry.tx_m, geometry.rx_m, sound, None,
        geometry.rx_velocity_m_s, sound_speed=sound_speed,
    )  # fmt: skip
    lines = compress(echoes, window=window, oversampling=oversampling, bandwidth_hz=band)
    return replace(
        lines,
        samples=lines.samples[:, RINGING : RINGING + length],
        first_range_m=sound / 2 * nearest,
    )


def _check_heights(
    sound_speed: SoundSpeed | None, geometry: Channels, parts: tuple[PointTargets | Seabed, ...]
) -> None:
    """Raise ValueError if a profile does not reach all antennas and the whole scene."""
    if sound_speed is None:
        return
    check_reaches(sound_speed, geometry.tx_m[:, 2], "`tx_m`")
    check_reaches(sound_speed, geometry.rx_m[:, 2], "`rx_m`")
    for part in parts:
        z_m = part.positions_m[:, 2] if isinstance(part, PointTargets) else part.heights_m
        check_reaches(sound_speed, z_m, "the scene's points")


def _channels(tx_m: ArrayLike, rx_m: ArrayLike, rx_velocity_m_s: ArrayLike | None) -> Channels:
    """Return the positions of every channel, checked; a single position is repeated."""
    parts = (tx_m, rx_m) if rx_velocity_m_s is None else (tx_m, rx_m, rx_velocity_m_s)
    given = [
        validate.array(name, part, np.float64, None)
        for name, part in zip(Channels._fields, parts, strict=False)
    ]
    count = max(len(np.atleast_2d(part)) for part in given)
    tx, rx, *velocity = (
        validate.array(name, part, np.float64, (count, 3), broadcast=True)
        for name, part in zip(Channels._fields, given, strict=False)
    )
    return Channels(tx, rx, velocity[0] if velocity else None)


def _add_noise(samples: NDArray[np.complex64], snr_db: float, seed: int) -> None:
    """Add white noise relative to the strongest sample, in place."""
    peak = np.max([np.abs(line).max() for line in samples])
    if peak == 0:
        raise ArgumentError("snr_db", "be left out without an echo", hint=NO_ECHO)
    # Standard deviation of the real and of the imaginary part.
    deviation = np.float32(peak * amplitude(-snr_db) / np.sqrt(2))
    random = np.random.default_rng(int(seed))
    for line in samples:
        parts = random.standard_normal((len(line), 2), dtype=np.float32)
        line += deviation * parts.view(np.complex64)[:, 0]
