"""Limits of a survey by the formulas of chapter 2 of the thesis (Ødegaard 2004)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial

from clsas.engine.data import validate
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.grid import Grid
from clsas.engine.data.system import Sonar
from clsas.engine.data.track import Pointing, Track
from clsas.engine.signal.compression import Window
from clsas.measures.limits_common import Result
from clsas.measures.limits_geometry import Survey
from clsas.measures.limits_heights import heights
from clsas.measures.limits_imaging import approximations, resolution
from clsas.measures.limits_result import Limit, Limits
from clsas.measures.limits_sampling import along_track, grating_lobes, ping_interval

_SUBJECTS = {
    "Range and ping interval": ping_interval,
    "Sampling along the track, and speed": along_track,
    "Grating lobes": grating_lobes,
    "Resolution": resolution,
    "Near field and phase centres": approximations,
}


def limits(
    sonar: Sonar,
    track: Track | None = None,
    grid: Grid | None = None,
    *,
    beam: BeamWindow | None = None,
    range_m: Sequence[float] | None = None,
    window: Window = "none",
    pointing: Pointing | None = None,
    element_pattern: bool = True,
    motion_in_flight: bool = False,
) -> Limits:
    """Return the limits of a survey: ping rate, sampling, resolution, grating lobes, swath, speed.

    The more of the survey is known, the more results there are. The others are listed in
    `Limits.missing`, with what they require.

    Parameters
    ----------
    sonar : Sonar
        The sonar, with the speed of sound. Of several receiver banks, all results but those on
        heights are for the first one, since each bank forms an image of its own.
    track : Track, optional
        Its track.
    grid : Grid, optional
        Pixels of the image.
    beam : BeamWindow, optional
        Weights of the channels in the image. Only channels within the beam count.
    range_m : (float, float), optional
        Nearest and farthest range that are recorded, metres. Without a grid, or without a track,
        they take the place of the grid's ranges.
    window
        Window of the pulse compression, as for `clsas.compress`.
    pointing : Pointing, optional
        Directions of the elements; by default to broadside.
    element_pattern : bool
        False if the elements are to be taken as omnidirectional.
    motion_in_flight : bool
        True if receivers move while the sound travels, which changes the error of phase centres.

    Returns
    -------
    Limits
        Named results, each with its value, unit, limit and equation.

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type or is outside its limits.

    See Also
    --------
    check_sampling : Findings of a survey that exceeds its sampling limits.
    assess : Effects that an image needs, by the error without each of them.

    Notes
    -----
    Results "in the middle" apply to the pixel in the middle of the grid. Without a grid or a track,
    they apply to a point abeam of the middle of the track, in the middle of the recorded ranges.

    The first echo arrives after 2 Rmin/c [22], and the last ends at Tf = 2 Rmax/c + tau [23]. Pings
    may follow at a rate of 1/Tf [24]. The complex sample rate must be at least the bandwidth [25].

    Phase centres of elements of length L may be L/2 apart [27], [29]. With this spacing, the
    platform of a single receiver may advance by L/2 per ping [31], and that of an array by the
    extent of its phase centres. The fastest speed is this advance times the ping rate [30].

    Phase centres d apart cause grating lobes at the distance R lambda/(2 d) from a target [26]. The
    resolution is c/(2 B) in range [4] and L/2 in azimuth [3]. The widths are those of the Fourier
    transforms of the spectra of the survey in range and azimuth [21].

    The paths of a transmitter and a receiver that are D apart are D^2 cos^2(theta)/(4 R) longer
    than twice the path from their phase centre. D^2/(4 R) is common to all directions. The rest
    varies over the beamwidth Omega by D^2 sin^2(Omega/2)/(4 R), which must be far below a
    wavelength. This is [33] if its last symbol is the range; the thesis calls it the distance from
    phase centre to receiver. The limit here is an eighth of a wavelength, as in [34].

    Wavefronts over an array are plane to an eighth of a wavelength beyond 4 u^2/lambda [34], where
    u is half the length of the array. For a synthetic aperture, the way out curves like the way
    back, so the distance is twice as large.

    The phase between the images of two banks shows heights. The height of ambiguity shifts it by a
    cycle, at constant range. It is lambda R/B for a vertical baseline B at the range R.

    References
    ----------
    Ødegaard, "Fast time domain beamforming for synthetic aperture sonar", thesis, University of
    Oslo, 2004: chapter 2, equations in brackets.

    Examples
    --------
    The wide-beam case of the thesis. Its platform advances by half the array per ping, which leaves
    no gap. Its phase centres are a little farther apart than half an element:

    >>> import clsas
    >>> sonar = clsas.Sonar.thesis_wide_beam()
    >>> track = clsas.Track.straight([-2.376, 0, 0], [2, 0, 0], pings=10, ping_interval_s=0.264)
    >>> grid = clsas.Grid.plane(x=(-2.5, 2.5, 1024), y=(40, 45, 1024))
    >>> found = clsas.limits(sonar, track, grid)
    >>> found.exceeded
    ('phase_centre_spacing_m', 'doppler_bandwidth_hz')
    >>> advance = found["advance_m"]
    >>> print(f"{advance.value:.3f} m, at {advance.side} {advance.limit:.3f} m {advance.equation}")
    0.528 m, at most 0.528 m [31]
    """
    validate.instance("sonar", sonar, Sonar)
    survey = Survey(
        sonar.bank(0),
        track,
        grid,
        beam,
        range_m,
        window,
        pointing,
        element_pattern,
        motion_in_flight,
    )
    results: list[Limit] = []
    missing: dict[str, str] = {}
    subjects: dict[str, Callable[[Survey], Iterator[Result]]] = {
        **_SUBJECTS,
        "Heights": partial(heights, sonar=sonar),
    }
    for subject, yields in subjects.items():
        for each in yields(survey):
            if isinstance(each, Limit):
                results.append(replace(each, subject=subject))
            else:
                names, reason = each
                for name in names.split():
                    missing.setdefault(name, reason)
    return Limits(tuple(results), missing)
