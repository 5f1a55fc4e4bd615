"""Surveys: range lines in files, read in the parts that a patch needs.

A survey is one file of range lines, or a folder of such files in the order of their names, where
numbers count as numbers: "ping_9.h5" comes before "ping_10.h5". Files may be added while the survey
is recorded. Only the geometry is kept in memory; samples are read when a patch needs them.
`SurveyVisibility` says which channels reach a patch with their beam and their recorded ranges, and
`GrowingSurvey` which patches can be formed while files are still added.
"""

from __future__ import annotations

import functools
import json
import os
import re
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from clsas.engine.data import validate
from clsas.engine.data.beam import MOST_TRACK_PINGS, SHORTEST_LEG, BeamWindow
from clsas.engine.data.declared import Number
from clsas.engine.data.digests import Without, digest
from clsas.engine.data.grid import Grid, bounding_box
from clsas.engine.data.lines import RangeLines, reached_m
from clsas.engine.data.sound_speed import range_bounds_m
from clsas.engine.data.validate import ArgumentError
from clsas.engine.data.visibility import BeamTrack, Boxes
from clsas.engine.signal.interpolation import MOST_TAPS
from clsas.files.hdf5 import FileFormatError, read_geometry, read_samples
from clsas.mosaics.document import PatchIndex
from clsas.mosaics.patches import Layout
from clsas.mosaics.store import Store

END = "end"
"""Name of the file that marks a folder as complete."""

POLL_S = 0.5
"""Seconds between searches for new files of a survey: a plain choice."""

StampedFiles = tuple[tuple[Path, tuple[int, int]], ...]
"""Files of a survey, each with its size in bytes and time of change in ns."""

FOLLOW = Number(
    "s",
    above=0.0,
    help="Stop after this time without a new file. A file named `end` stops it at once.",
)
"""Declares for how long the folder of a survey is followed."""
_TAPER = 64  # samples over which a line fades where it is cut
_MARGIN = MOST_TAPS  # unchanged samples between pixels and taper, for filters and their ringing
_DIGESTED = 16  # lines of a file that enter its digest; all of them would take too long to read
_LOOK = "look_direction"  # which only some files of a survey may state
# Samples are those of the part, and the georeference is that of the grid, which mosaics compare.
# Files added later may remove the look direction of all channels.
_NOT_IN_PARTS: Without = {RangeLines: ("samples", _LOOK, "georeference")}
_SKIPPED = 64  # unused channels in a row that are read along: faster than a second read
# Gap between the phase centres of a patch, in median distances. It is larger than that of a check
# of pings: arrays, and passes beside each other, make uneven distances even if no ping is lost.
_PATCH_GAP = 3.0
# Files below which their order says little, and the share of those out of place that is reported:
# plain choices. Shuffled names reach 0.9. A file is out of place if the next one begins so many
# times farther away than the nearest, and that lies as near as adjacent files do.
_LEAST_FILES, _REPORTED, _OUT_OF_PLACE, _ADJACENT = 4, 0.25, 2.0, 1.5
# Bytes per channel that finding the visibility takes, without and with a beam: measured with 1e6
# pings.
_CHANNEL_BYTES, _BEAM_CHANNEL_BYTES = 200, 400

_OPENING = threading.Lock()
_LATEST: list[Survey] = []  # at most one entry: the survey that this process opened last


@dataclass(frozen=True, eq=False)
class Survey:
    """Range lines of which only the geometry is in memory.

    Attributes
    ----------
    geometry : RangeLines
        Geometry of all channels, with one sample each, which is zero.
    parts : tuple of RangeLines or Path
        Sources of the samples, in the order of the channels.
    begins : tuple of int
        First channel of every part, and at the end the number of channels.
    lengths : tuple of int
        Samples per channel of every part.
    stamps : tuple of (int, int)
        Size (bytes) and time of change (ns) of every file when it was opened; 0, 0 for lines in
        memory.
    """

    geometry: RangeLines
    parts: tuple[RangeLines | Path, ...]
    begins: tuple[int, ...]
    lengths: tuple[int, ...]
    stamps: tuple[tuple[int, int], ...]

    @property
    def channels(self) -> int:
        """Number of channels."""
        return self.begins[-1]

    @property
    def files(self) -> tuple[Path, ...]:
        """Parts that are files: all of them, unless the lines are in memory."""
        return tuple(part for part in self.parts if isinstance(part, Path))

    @property
    def last_range_m(self) -> NDArray[np.float64]:
        """Range of each channel's last sample, metres, [channels]."""
        length = np.repeat(self.lengths, np.diff(self.begins))
        return self.geometry.first_range_m + (length - 1) * self.geometry.range_step_m

    def digests(self, first: int = 0) -> list[str]:
        """Return digests of the geometry and samples of every part from number `first` on.

        The digest of a file covers the samples of 16 lines.
        """
        found = []
        for index, part in enumerate(self.parts[first:], first):
            count = self.begins[index + 1] - self.begins[index]
            if isinstance(part, RangeLines):
                samples = [part.samples]
            else:
                columns = slice(0, self.lengths[index])
                samples = [
                    self._samples(index, slice(channel, channel + 1), columns)
                    for channel in np.unique(np.linspace(0, count - 1, _DIGESTED).astype(int))
                ]
            geometry = self.geometry.select(slice(*self.begins[index : index + 2]))
            found.append(digest([geometry.without_samples(), *samples], _NOT_IN_PARTS))
        return found

    def extent(
        self, visible: NDArray[np.bool_], near_m: NDArray[np.float64], far_m: NDArray[np.float64]
    ) -> tuple[int, int]:
        """Return the number of lines that `read` returns, and the number of samples of each."""
        blocks = list(self._blocks(visible, near_m, far_m))
        longest = max(columns.stop - columns.start for _, _, columns in blocks)
        return int(np.count_nonzero(visible)), longest

    def read(
        self, visible: NDArray[np.bool_], near_m: NDArray[np.float64], far_m: NDArray[np.float64]
    ) -> tuple[RangeLines, NDArray[np.bool_]]:
        """Return the lines of some channels between two ranges, and which of them lack samples.

        Parameters
        ----------
        visible : bool [channels]
            Channels to read; at least one.
        near_m, far_m : float64 [channels]
            Ranges between which the samples are unchanged, metres. Beyond them the lines continue
            for 32 recorded samples and then fade over 64, so that they can be interpolated.
            Outside the recording they are zero.

        Returns
        -------
        lines : RangeLines
        missing : bool [lines.channels]
            Channels whose samples are not finite or all zero. They are zero in `lines`.

        Raises
        ------
        FileFormatError, OSError
            If a file cannot be read, or has changed since the survey was opened.
        """
        geometry, index = self.geometry, np.flatnonzero(visible)
        blocks = list(self._blocks(visible, near_m, far_m))
        longest = max(columns.stop - columns.start for _, _, columns in blocks)
        validate.memory("lines of a patch", 8 * len(index) * longest)
        samples = np.zeros((len(index), longest), np.complex64)
        first_m = np.empty(len(index))
        filled = 0
        for part, rows, columns in blocks:
            begin = self.begins[part]
            chosen = visible[rows]
            block = self._samples(part, slice(rows.start - begin, rows.stop - begin), columns)
            here = slice(filled, filled + int(np.count_nonzero(chosen)))
            kept = samples[here, : block.shape[1]]
            kept[:] = block if chosen.all() else block[chosen]
            fade = np.sin(np.pi / 2 * (np.arange(_TAPER) + 0.5) / _TAPER) ** 2
            if columns.start > 0:
                kept[:, :_TAPER] *= fade.astype(np.float32)
            if columns.stop < self.lengths[part]:
                kept[:, -_TAPER:] *= fade[::-1].astype(np.float32)
            first_m[here] = geometry.first_range_m[rows][chosen]
            first_m[here] += columns.start * geometry.range_step_m
            filled = here.stop
        # The sum of a line reveals defects quickly. Since it may also overflow or cancel, only
        # lines with a suspicious sum are checked sample by sample.
        with np.errstate(over="ignore", invalid="ignore"):
            sums = np.add.reduce(samples, axis=1)
        missing, silent = ~np.isfinite(sums), sums == 0
        missing[missing] = ~np.isfinite(samples[missing]).all(axis=1)
        samples[missing] = 0
        silent[silent] = ~samples[silent].any(axis=1)
        missing |= silent
        of_channels = {name: values[index] for name, values in geometry.per_channel.items()}
        of_channels["first_range_m"] = first_m
        return replace(geometry, samples=samples, **of_channels), missing

    def _blocks(
        self, visible: NDArray[np.bool_], near_m: NDArray[np.float64], far_m: NDArray[np.float64]
    ) -> Iterator[tuple[int, slice, slice]]:
        """Yield the part, channels and samples of every block that is read at once."""
        step_m = self.geometry.range_step_m
        margin = _TAPER + _MARGIN
        for part, length in enumerate(self.lengths):
            begin, end = self.begins[part : part + 2]
            index = begin + np.flatnonzero(visible[begin:end])
            if not index.size:
                continue
            for run in np.split(index, np.flatnonzero(np.diff(index) > _SKIPPED) + 1):
                first_m = self.geometry.first_range_m[run]
                start = int(np.floor(((near_m[run] - first_m) / step_m).min())) - margin
                stop = int(np.ceil(((far_m[run] - first_m) / step_m).max())) + margin + 1
                start = min(max(start, 0), length - 1)
                stop = max(min(stop, length), start + 1)
                # Near an end of the line a taper does not fit: read up to the end instead.
                start = 0 if start < 2 * _TAPER else start
                stop = length if stop > length - 2 * _TAPER else stop
                yield part, slice(int(run[0]), int(run[-1]) + 1), slice(start, stop)

    def _samples(self, index: int, rows: slice, columns: slice) -> NDArray[np.complex64]:
        part = self.parts[index]
        if isinstance(part, RangeLines):
            return part.samples[rows, columns]
        if _stamp(part) != self.stamps[index]:
            raise FileFormatError(f"{part} has changed since the survey was opened")
        return read_samples(part, rows, columns)


def open_survey(source: RangeLines | str | os.PathLike) -> Survey:
    """Return a survey from a file, a folder of files (*.h5), or lines in memory.

    Raises
    ------
    TypeError
        If `source` is neither lines nor a path.
    FileFormatError
        If a file does not contain range lines.
    ValueError
        If there is no file, or if the files of a folder differ in carrier, sound speed or range
        step or georeference, or only some of them have velocities.
    OSError
        If a file cannot be read.
    """
    if isinstance(source, RangeLines):
        geometry = source.without_samples()
        return Survey(geometry, (source,), (0, source.channels), (source.length,), ((0, 0),))
    paths = files_of(source)
    if not paths:
        raise ArgumentError("source", "contain range lines", f"{source}, which has no file *.h5")
    return open_files(paths)


def files_of(source: str | os.PathLike) -> tuple[Path, ...]:
    """Return the files of a survey, sorted by name as people do: "ping_9" before "ping_10"."""
    path = validate.path("source", source)
    if not path.is_dir():
        return (path,)
    found = []
    for file in path.glob("*.h5"):
        if not file.name.startswith("."):
            parts = re.split(r"(\d+)", file.stem)  # texts and digits in turn
            natural = [int(part) if n % 2 else part.casefold() for n, part in enumerate(parts)]
            # Names that differ by leading zeros only are sorted by their characters.
            found.append((natural, file.stem, file))
    return tuple(file for _, _, file in sorted(found))


def warn_of_order(survey: Survey) -> None:
    """Warn if the files of a survey, in the order of their names, do not follow the track.

    Range lines have no times, so the names alone give the order, and with it the direction of the
    track.
    """
    files = len(survey.files)
    if files < _LEAST_FILES:
        return
    edges = np.array(survey.begins)
    starts_m, ends_m = survey.geometry.tx_m[edges[:-1]], survey.geometry.tx_m[edges[1:] - 1]
    steps_m = np.linalg.norm(starts_m[1:] - ends_m[:-1], axis=1)
    # The nearest beginning of another file. One before, of a single ping, is near in any order.
    away_m, which = cKDTree(starts_m).query(ends_m[:-1], k=3)
    number = np.arange(files - 1)[:, None]
    single = np.append(True, (starts_m == ends_m).all(axis=1))[: files - 1, None]
    other = np.argmax((which != number) & ((which != number - 1) | ~single), axis=1)
    nearest_m = away_m[number[:, 0], other]
    near = nearest_m < _ADJACENT * np.median(nearest_m)
    wrong = np.flatnonzero(near & (steps_m > _OUT_OF_PLACE * nearest_m))
    if wrong.size > _REPORTED * files:
        first = int(wrong[0])
        validate.warn(
            f"the files of the survey do not follow the track in the order of their names: after "
            f"{wrong.size} of {files}, first {survey.files[first].name}, the next file begins "
            f"{steps_m[first]:.3g} m away, and another one {nearest_m[first]:.3g} m. Only names "
            "give the order of pings, which a beam follows. Name the files in the order of time, "
            "or give the direction of the track, `BeamWindow(along=...)`"
        )


def has_ended(source: str | os.PathLike) -> bool:
    """Return whether a survey is complete: a file, or a folder that contains a file `end`."""
    path = Path(source)
    return not path.is_dir() or (path / END).exists()


def open_files(paths: tuple[Path, ...], before: Survey | None = None) -> Survey:
    """Return the survey in some files.

    Parameters
    ----------
    paths : tuple of Path
    before : Survey, optional
        Survey of the first of these files, already open.

    Raises
    ------
    ValueError
        As for `open_survey`, or if `paths` do not begin with the files of `before`.
    """
    known = 0 if before is None else len(before.parts)
    if before is not None and paths[:known] != before.files:
        changed = next(a for a, b in zip((*paths, None), before.files, strict=False) if a != b)
        allowed = f"only gain files whose names sort after the last one, {before.files[-1].name}"
        raise ArgumentError("source", allowed, "fewer files" if changed is None else changed.name)
    stamps = [] if before is None else list(before.stamps)
    found = [] if before is None else [before.geometry]
    lengths = [] if before is None else list(before.lengths)
    begins = [0] if before is None else list(before.begins)
    for path in paths[known:]:
        stamps.append(_stamp(path))
        geometry, length = read_geometry(path)
        lengths.append(length)
        begins.append(begins[-1] + geometry.channels)
        found.append(geometry)
        where, equal = f"{path}:", "equal that of the survey's first file"
        for name in ("range_step_m", "carrier_hz", "sound_speed_m_s"):
            ours, theirs = getattr(geometry, name), getattr(found[0], name)
            if ours != theirs:
                raise ArgumentError(name, f"{equal}, {theirs:g}", f"{ours:g}", where=where)
        ours, theirs = geometry.georeference, found[0].georeference
        if ours != theirs:
            raise ArgumentError("georeference", f"{equal}, {theirs}", str(ours), where=where)
        if geometry.sound_speed != found[0].sound_speed:
            raise ArgumentError("sound_speed", equal, where=where)
        different = geometry.per_channel.keys() ^ found[0].per_channel.keys()
        for name in different - {_LOOK}:
            allowed = "be in all files of the survey or in none"
            raise ArgumentError(name, allowed, where=where)
    if any(each.look_direction is None for each in found):  # unknown for some is unknown for all
        found = [replace(each, look_direction=None) for each in found]
    entries = sum(each.size for part in found for each in part.per_channel.values())
    validate.memory(f"the {begins[-1]} channels of source", 8 * (entries + 2 * begins[-1]))
    of_channels: dict[str, Any] = {
        name: np.concatenate([each.per_channel[name] for each in found])
        for name in found[0].per_channel
    }
    geometry = replace(found[0], samples=np.zeros((begins[-1], 1), np.complex64), **of_channels)
    return Survey(geometry, tuple(paths), tuple(begins), tuple(lengths), tuple(stamps))


def _stamp(path: Path) -> tuple[int, int]:
    status = path.stat()
    return status.st_size, status.st_mtime_ns


@dataclass(frozen=True, eq=False)
class SurveyVisibility:
    """A survey and a beam, which determine the channels that contribute to a patch.

    Attributes
    ----------
    survey : Survey
    beam : BeamWindow or None
    along : float64 [channels, 3] or None
        Unit direction of the track at every channel; None without a beam.
    phase_centres_m : float64 [channels, 3]
    """

    survey: Survey
    beam: BeamWindow | None
    along: NDArray[np.float64] | None
    phase_centres_m: NDArray[np.float64]

    @classmethod
    def of(cls, survey: Survey, beam: BeamWindow | None) -> SurveyVisibility:
        """Return the visibility of a survey, with the directions of its track if there is a beam.

        Raises
        ------
        ValueError
            If the channels of the survey do not fit into memory.
        """
        per_channel = _CHANNEL_BYTES if beam is None else _BEAM_CHANNEL_BYTES
        validate.memory(f"the {survey.channels} channels of source", per_channel * survey.channels)
        geometry = survey.geometry
        along = None if beam is None else beam.directions(geometry)
        return cls(survey, beam, along, geometry.phase_centres_m)

    @property
    def settled(self) -> int:
        """Number of leading channels whose direction later channels cannot change."""
        # Without a beam, later channels may receive from any patch.
        return 0 if self.beam is None else self._settled_of(self.survey.channels)

    def _settled_of(self, channels: int) -> int:
        """Return how many leading channels of `channels` later ones cannot turn."""
        if self.beam is None or self.beam.along is not None:
            return channels
        starts, travelled_m, reach_m = self._pings
        # A jump begins a leg, over which nothing is smoothed, once enough pings have followed it.
        later = (self.beam.track_pings or MOST_TRACK_PINGS) // 2 + SHORTEST_LEG
        kept = int(np.searchsorted(starts, channels)) - later
        if kept <= later:
            return 0
        # Channels ahead of their ping's centre take the directions of later pings.
        farthest_m = travelled_m[kept - 1] - reach_m
        return int(starts[np.searchsorted(travelled_m[:kept], farthest_m)])

    @functools.cached_property
    def _pings(self) -> tuple[NDArray[np.int64], NDArray[np.float64], float]:
        """First channels of pings, their distances along the track, and the reach of channels."""
        geometry = self.survey.geometry
        centres_m = geometry.ping_centres_m
        steps_m = np.linalg.norm(np.diff(centres_m, axis=0), axis=1)
        ahead_m = geometry.phase_centres_m - centres_m[geometry.ping_numbers]
        reach_m = float(np.linalg.norm(ahead_m, axis=1).max())
        return geometry.ping_starts, np.concatenate([[0.0], np.cumsum(steps_m)]), reach_m

    def ranges_m(self, grid: Grid) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return between which ranges every channel may contribute to a grid, metres."""
        centre_m, half_m = bounding_box(grid)
        geometry = self.survey.geometry
        near_m, far_m = reached_m(geometry, centre_m, half_m)
        if (profile := geometry.sound_speed) is not None:
            near_m, far_m = range_bounds_m(profile, near_m, far_m, geometry.sound_speed_m_s)
        return near_m, far_m

    def channels(self, grid: Grid) -> NDArray[np.bool_]:
        """Return which channels may contribute to a grid, bool [channels]."""
        survey, (near_m, far_m) = self.survey, self.ranges_m(grid)
        found = (far_m >= survey.geometry.first_range_m) & (near_m <= survey.last_range_m)
        if self._beam_track is not None:
            centre_m, half_m = bounding_box(grid)
            found &= self._beam_track.touching(Boxes.equal(centre_m[None], half_m))[0]
        return found

    @functools.cached_property
    def _beam_track(self) -> BeamTrack | None:
        if self.beam is None or self.along is None:
            return None
        return BeamTrack(self.beam.limits, self.phase_centres_m, self.along)

    def any_channel_from(self, first: int, grid: Grid) -> bool:
        """Return whether any channel from number `first` on may contribute to a grid."""
        return first < self.survey.channels and bool(self.channels(grid)[first:].any())

    def differs_since(self, channels: int, contributing: int, grid: Grid) -> bool:
        """Return whether other channels contribute to a grid, or with other weights, than before.

        Parameters
        ----------
        channels : int
            Number of channels that the survey had.
        contributing : int
            Number of channels that then contributed to the grid.
        grid : Grid
        """
        found = self.channels(grid)
        if found[self._settled_of(channels) :].any():
            return True
        return bool(np.count_nonzero(found) != contributing)  # a beam may have turned away

    def has_passed(self, grid: Grid, settled: int) -> bool:
        """Return whether the beam of the latest settled channel has passed a grid completely."""
        if self.beam is None or self.along is None or self.any_channel_from(settled, grid):
            return False
        centre_m, half_m = bounding_box(grid)
        offset_m = centre_m - self.phase_centres_m[settled - 1]
        direction = self.along[settled - 1]
        extent_m = np.abs(half_m @ direction).sum()
        low, away_m = max(self.beam.limits[0], -1.0), float(np.linalg.norm(offset_m))
        radius_m = float(np.linalg.norm(np.abs(half_m).sum(axis=0)))
        # The beam leaves the farthest point of the box last, or the nearest if it points ahead.
        distance_m = away_m + radius_m if low < 0 else max(away_m - radius_m, 0.0)
        return bool(direction @ offset_m + extent_m < low * distance_m)


PatchSource = SurveyVisibility | tuple[StampedFiles, str | None]
"""What a patch is formed from: a survey and its beam in this process, or the files and the beam as
JSON, by which a worker process opens them."""


@dataclass(frozen=True)
class Growth:
    """Folder to which files of a survey are being added.

    Attributes
    ----------
    folder : Path
    idle_s : float
        Seconds without a new file after which the survey has ended.
    at_end : callable, optional
        Called with the geometry of the survey when it has ended.
    """

    folder: Path
    idle_s: float
    at_end: Callable[[RangeLines], object] | None = None

    @classmethod
    def checked(cls, source: RangeLines | Path, idle_s: float) -> Growth:
        """Return the folder to follow; other sources raise ValueError."""
        idle_s = FOLLOW.check("follow_s", idle_s)
        if isinstance(source, RangeLines) or not source.is_dir():
            got = "lines in memory" if isinstance(source, RangeLines) else repr(str(source))
            raise ArgumentError("source", "be a folder if `follow_s` is given", got)
        return cls(source.resolve(), idle_s)

    def wait_for_first_file(self) -> None:
        """Wait for the first file of the folder; raise ValueError if none comes."""
        start, folder = time.monotonic(), self.folder
        while not files_of(folder):
            if has_ended(folder) or time.monotonic() - start > self.idle_s:
                got = f"{folder}, which has no file *.h5"
                raise ArgumentError("source", "contain range lines", got)
            time.sleep(POLL_S)


class GrowingSurvey:
    """A survey to which files may be added.

    Attributes
    ----------
    visibility : SurveyVisibility
        The survey at present.
    has_ended : bool
        True once no more files will come.
    """

    def __init__(
        self,
        visibility: SurveyVisibility,
        growth: Growth | None,
        store: Store | None,
        inputs: dict[str, Any],
    ) -> None:
        self._growth, self._store, self._inputs = growth, store, inputs
        self._latest_s = time.monotonic()
        self.visibility = visibility
        self.has_ended = growth is None

    @property
    def channels(self) -> int:
        """Number of channels at present."""
        return self.visibility.survey.channels

    def for_workers(self) -> tuple[StampedFiles, str | None]:
        """Return the files and the beam from which worker processes open the present survey."""
        beam = self.visibility.beam
        return stamped_files(self.visibility.survey), None if beam is None else beam_json(beam)

    def update(self) -> bool:
        """Look for new files; return whether any came or the survey has ended."""
        growth = self._growth
        if growth is None or self.has_ended:
            return False
        # Ask before listing the files, since none is added after the end.
        ended = has_ended(growth.folder)
        paths, survey = files_of(growth.folder), self.visibility.survey
        grown = paths != survey.files
        if grown:
            first = len(survey.parts)
            survey = open_files(paths, survey)
            self.visibility = SurveyVisibility.of(survey, self.visibility.beam)
            self._latest_s = time.monotonic()
            if self._store is not None:
                parts = [*self._inputs["parts"], *survey.digests(first)]
                self._inputs = self._inputs | {"parts": parts}
                self._store.grow(self._inputs)
        self.has_ended = ended or time.monotonic() - self._latest_s > growth.idle_s
        if self.has_ended and growth.at_end is not None:
            growth.at_end(self.visibility.survey.geometry)
        return grown or self.has_ended

    def ready(self, layout: Layout, todo: Iterable[PatchIndex]) -> deque[PatchIndex]:
        """Return the patches whose channels have all been recorded, in the given order."""
        if self.has_ended:
            return deque(todo)
        settled = self.visibility.settled
        if settled < 1:
            return deque()
        return deque(i for i in todo if self.visibility.has_passed(layout.window(i).grid, settled))


def stamped_files(survey: Survey) -> StampedFiles:
    """Return the files of a survey with their stamps."""
    pairs = zip(survey.parts, survey.stamps, strict=True)
    return tuple((part, stamp) for part, stamp in pairs if isinstance(part, Path))


def opened_visibility(files: StampedFiles, beam: str | None) -> SurveyVisibility:
    """Return a survey that a worker process opens once for all of its threads.

    Raises
    ------
    ValueError
        If a file has changed.
    """
    with _OPENING:
        return _open_visibility(files, beam)


@functools.lru_cache(maxsize=2)
def _open_visibility(files: StampedFiles, beam: str | None) -> SurveyVisibility:
    # If files have been added to the survey, open only these.
    before = next((s for s in _LATEST if files[: len(s.parts)] == stamped_files(s)), None)
    survey = open_files(tuple(path for path, _ in files), before)
    if survey.stamps != tuple(stamp for _, stamp in files):
        raise ArgumentError("source", "not change while a mosaic is formed, but a file of it did")
    _LATEST[:] = [survey]
    return SurveyVisibility.of(survey, None if beam is None else BeamWindow(**json.loads(beam)))


def beam_json(beam: BeamWindow) -> str:
    """Return a beam as JSON, which can be hashed and compared."""
    return json.dumps(asdict(beam), default=lambda value: value.tolist())


def largest_gap_m(phase_centres_m: NDArray[np.float64], missing: NDArray[np.bool_]) -> float:
    """Return the longest distance of phase centres along the track, or 0 if it is not a gap.

    A gap is longer than three median distances. Missing channels cause gaps too.
    """
    if np.count_nonzero(~missing) < 2:
        return 0.0
    along_m = phase_centres_m[:, np.ptp(phase_centres_m, axis=0).argmax()]
    steps_m = np.diff(np.sort(along_m))
    median_m = float(np.median(steps_m[steps_m > 0])) if steps_m.any() else 0.0
    longest_m = float(np.diff(np.sort(along_m[~missing])).max(initial=0.0))
    return longest_m if longest_m > _PATCH_GAP * median_m else 0.0
