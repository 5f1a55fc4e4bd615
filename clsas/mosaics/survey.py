"""Surveys: range lines in files, read in the parts that a patch needs.

A survey is one file of range lines, or a folder of such files in the order of their names, where
numbers count as numbers: "ping_9.h5" comes before "ping_10.h5". Files may be added while the survey
is recorded. Only the geometry is kept in memory; samples are read when a patch needs them.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from clsas.engine.data import validate
from clsas.engine.data.digests import Without, digest
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.validate import ArgumentError
from clsas.files.hdf5 import FileFormatError, read_geometry, read_samples

END = "end"
"""Name of the file that marks a folder as complete."""

_TAPER = 64  # samples over which a line fades where it is cut
_MARGIN = 32  # unchanged samples between pixels and taper, for interpolation and its ringing
_DIGESTED = 16  # lines of a file that enter its digest; all of them would take too long to read
_LOOK = "look_direction"  # which only some files of a survey may state
# Samples are those of the part, and the georeference is that of the grid, which mosaics compare.
# Files added later may remove the look direction of all channels.
_NOT_IN_PARTS: Without = {RangeLines: ("samples", _LOOK, "georeference")}
_SKIPPED = 64  # unused channels in a row that are read along: faster than a second read
_GAP = 3.0  # a gap is a distance between pings of more than this many median distances
# Files below which their order says little, and the share of those out of place that is reported:
# plain choices. Shuffled names reach 0.9. A file is out of place if the next one begins so many
# times farther away than the nearest, and that lies as near as adjacent files do.
_LEAST_FILES, _REPORTED, _OUT_OF_PLACE, _ADJACENT = 4, 0.25, 2.0, 1.5


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
    def length(self) -> NDArray[np.int64]:
        """Samples of every channel, [channels]."""
        return np.repeat(self.lengths, np.diff(self.begins))

    @property
    def last_range_m(self) -> NDArray[np.float64]:
        """Range of each channel's last sample, metres, [channels]."""
        return self.geometry.first_range_m + (self.length - 1) * self.geometry.range_step_m

    @property
    def span_m(self) -> tuple[float, float]:
        """Nearest and farthest range of all channels, metres."""
        return float(self.geometry.first_range_m.min()), float(self.last_range_m.max())

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

    def within(self, near_m: NDArray[np.float64], far_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which channels recorded any range between two bounds, bool [channels].

        Bounds are in metres, float64 [channels].
        """
        return (far_m >= self.geometry.first_range_m) & (near_m <= self.last_range_m)

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
    """Return the files of a survey, sorted by name; numbers in names count as numbers."""
    path = validate.path("source", source)
    if not path.is_dir():
        return (path,)
    found = (each for each in path.glob("*.h5") if not each.name.startswith("."))
    return tuple(sorted(found, key=lambda each: natural(each.stem)))


def natural(name: str) -> tuple[list[int | str], str]:
    """Return a key that sorts names as people do: "ping_9" comes before "ping_10".

    Names that differ by leading zeros only are sorted by their characters.
    """
    parts = re.split(r"(\d+)", name)  # texts and digits in turn
    return [int(part) if n % 2 else part.casefold() for n, part in enumerate(parts)], name


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


def largest_gap_m(lines: RangeLines, missing: NDArray[np.bool_]) -> float:
    """Return the longest distance between consecutive pings, metres, or 0 if it is not a gap.

    A gap is longer than three median distances. Missing channels cause gaps too.
    """
    there = ~missing
    if np.count_nonzero(there) < 2:
        return 0.0
    every_m, some_m = (
        np.unique(lines.phase_centres_m[each], axis=0) for each in (np.ones_like(there), there)
    )
    axis = np.ptp(every_m, axis=0).argmax()
    steps_m = np.diff(np.sort(every_m[:, axis]))
    median_m = float(np.median(steps_m[steps_m > 0])) if steps_m.any() else 0.0
    longest_m = float(np.diff(np.sort(some_m[:, axis])).max(initial=0.0))
    return longest_m if longest_m > _GAP * median_m else 0.0


def _stamp(path: Path) -> tuple[int, int]:
    status = path.stat()
    return status.st_size, status.st_mtime_ns
