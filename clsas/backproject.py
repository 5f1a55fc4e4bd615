"""Exact backprojection: every channel summed into every pixel."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from clsas import interpolation, phases, validate
from clsas.ambiguity import Ambiguity, ambiguity
from clsas.decibels import in_db, power
from clsas.device import Device, Slot, aligned, open_device
from clsas.geometry import bistatic_range_m, pairwise_range_m
from clsas.grid import Grid
from clsas.image import Image, holds_any
from clsas.interpolation import Gain, Interpolator, Resampling
from clsas.layout import GEOMETRY_ERROR, STACK, Groups, Tiles, allowed, lay_out
from clsas.lines import RangeLines, some_channels
from clsas.reach import warn_unseen
from clsas.simplify import Model, simplify
from clsas.spectrum import Spectrum, cycles_per_m_at, measure_spectrum
from clsas.threads import in_threads
from clsas.window import HARDLY_SEEN, INTERVALS, BeamWindow, channel_ranges, sines

BEST_ACCURACY_DB = -85.0
"""The best accuracy that may be asked for: what float32 allows."""
ACCURACY_DB = -60.0
"""What is taken where no accuracy is asked for."""

VECTOR_ROOM = 16
"""Channels by which rows are longer in which a vector may begin at the last."""

_LARGEST_DISTANCE_M = 1e9
_SMALLEST_STEP_M = 1e-9
_MOST_CYCLES = 1e10  # float64 leaves 1e-6 of a cycle
_LARGEST_SUM = 1e37
_LOOKED_AT = 1 << 18  # numbers of lines at a time
_FASTEST = 0.05  # of a receiver, in sound speeds: cl/backproject.cl iterates on it
_CHANNELS_AT_ONCE = 512  # bounds a float32 partial sum; lines that stay in a CPU's cache
_LINES_AT_ONCE = 32  # upsampled together: what stays in a core's cache
_CHANNELS, _PLACES = 256, 16  # at which is looked how full of what is seen the beam is
_PART_BYTES = 64 << 20  # device memory for one set of parts: a job of some tenths of a second


@dataclass(frozen=True, eq=False)
class Preparation:
    """Everything decided before the device starts."""

    device: Device
    lines: RangeLines
    grid: Grid
    layout: Tiles | Groups
    interpolator: Interpolator
    resampling: Resampling
    phase_terms: int
    """Of the polynomials for sine and cosine."""
    beam: BeamWindow | None = None
    along: NDArray[np.float64] | None = None
    """The track's unit direction for every channel, [channels, 3]; None without a beam."""
    one_cubic: bool = False
    """Whether one cubic of the beam's weights serves a work-item of a tile, a block of points."""
    wanted_db: float = 0.0
    """What the image may err by; with a fixed interpolator anything."""
    ambiguity: Ambiguity = field(default_factory=Ambiguity)
    """Errors that the lines themselves leave open."""
    given_grid: Grid | None = None
    """The grid asked for, where `grid` leaves out its relief."""
    left_out: tuple[str, ...] = ()
    """Effects that `lines` and `grid` do without: see `clsas.simplify`."""
    left_out_error: float = 0.0
    """The power of the error that this adds."""

    @property
    def predicted_error_db(self) -> float:
        """Relative rms error, dB: of interpolation, what lines leave open and what is left out."""
        error = power(self.interpolator.error_db) + self.ambiguity.error_power
        return in_db(error + self.left_out_error)

    def warn_of_ambiguity(self) -> None:
        """Warn where the lines themselves may keep the image from the accuracy asked for."""
        self.ambiguity.warn("accuracy_db", self.wanted_db)

    @property
    def samples_per_m(self) -> float:
        """Upsampled samples per metre of range."""
        return self.resampling.samples_per_m(self.lines)

    @property
    def cycles_per_m(self) -> float:
        """Phase to restore per metre of range, cycles: of the lines' spectral centre."""
        return self.resampling.cycles_per_m(self.lines)


def backproject(
    lines: RangeLines,
    grid: Grid,
    *,
    device: Device | str | int | None = None,
    accuracy_db: float = ACCURACY_DB,
    taps: int | None = None,
    upsampling: float | None = None,
    beam: BeamWindow | None = None,
    accumulate: Image | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Image:
    """Form the exact image of range lines on a grid.

    Parameters
    ----------
    lines : RangeLines
        Any number of channels, monostatic, bistatic or moving.
    grid : Grid
        Any number of pixels: a plane, a height map or arbitrary points.
    device : Device, str or int, optional
        See `clsas.device.choose`.
    accuracy_db : float
        Wanted relative rms error against the ideal sum, dB, from -85 to below 0. It decides how
        the lines are interpolated, from their own spectrum.
    taps : 2, 4, 6 or 8, optional
        Samples per interpolation (2 is linear), instead of the fastest choice.
    upsampling : float, optional
        By how much lines are upsampled before interpolation, instead of the fastest choice. With
        `taps` too, `accuracy_db` plays no part.
    beam : BeamWindow, optional
        Weights of the channels by aspect angle; what a channel does not see costs nothing. Without
        one every channel weighs 1 everywhere.
    accumulate : Image, optional
        Image on the same grid that this one is added to, so that data may arrive in pieces.
    progress : callable, optional
        Called as progress(done, total).

    Returns
    -------
    Image
        complex64, phase-preserving.

    Raises
    ------
    TypeError, ValueError
        If an argument is not what is allowed, `accumulate` is on another grid or beside a beam
        that normalises, the beam's track cannot be told from the lines, receivers move
        faster than 0.05 sound speeds, or numbers are so large or small that float32 sums or
        float64 phases could not hold them.
    DeviceError
        If there is no such device.

    Warns
    -----
    ClsasWarning
        If no pixel lies within any line's range, or the beam, so that the lines add nothing; or if
        `accuracy_db` may be missed because lines do not fade towards ends that the grid reaches, or
        because the lines' band fills all that is sampled.

    Notes
    -----
    I(x) = sum_i s_i(rho_i(x)) exp(+j 2 k rho_i(x)), with rho half the path from transmitter to
    pixel to receiver and k = 2 pi carrier/c. The lines are taken as band-limited about their
    spectral centre and as zero beyond their ends: a pixel outside a line's range (by more than
    the taps of one interpolation) gets nothing from it. Where a line does not fade towards an end,
    what pixels next to it get depends on the taps, and the image there on `accuracy_db`.

    Motion during flight, the distance between transmitter and receiver and a grid's relief are left
    out where the error that this adds lies far below `accuracy_db` (docs/assess.md).

    With a beam each term is multiplied by its weight. With or without one a pixel behind the
    antennas, at the range of one before them, is its mirror image. Ranges and phases are referred
    in float64 to centres near the pixels; the device sees float32 differences only.
    """
    preparation = prepare(
        lines,
        grid,
        device=device,
        accuracy_db=accuracy_db,
        taps=taps,
        upsampling=upsampling,
        beam=beam,
    )
    if accumulate is not None:
        check_accumulate(accumulate, grid, beam)
    preparation.warn_of_ambiguity()
    image = execute(preparation, progress=progress)
    if accumulate is None:
        return image
    return Image(image.pixels + accumulate.pixels, grid)


def prepare(
    lines: RangeLines,
    grid: Grid,
    *,
    device: Device | str | int | None = None,
    accuracy_db: float = ACCURACY_DB,
    taps: int | None = None,
    upsampling: float | None = None,
    beam: BeamWindow | None = None,
    full_model: bool = False,
) -> Preparation:
    """Decide how `backproject` forms an image; parameters and errors are its.

    Effects far below `accuracy_db` are left out unless `full_model` is set, or the interpolator is
    fixed so that `accuracy_db` plays no part.
    """
    validate.instance("lines", lines, RangeLines)
    validate.instance("grid", grid, Grid)
    validate.memory("grid", 8 * grid.size)
    accuracy_db = validate.number(
        "accuracy_db", accuracy_db, "dB", least=BEST_ACCURACY_DB, below=0.0
    )
    if beam is not None:
        validate.instance("beam", beam, BeamWindow)
    check_numbers(lines, beam)
    fixed = taps is not None and upsampling is not None  # then accuracy_db plays no part
    given_grid = grid
    model = Model(lines, grid, beam)
    if not (fixed or full_model):
        model = simplify(lines, grid, beam, accuracy_db)
    lines, grid, beam = model.lines, model.grid, model.beam
    along = None if beam is None else beam.directions(lines)
    fullness = 1.0 if beam is None else fullness_of(lines, grid, beam, along)
    device = open_device(device)
    spectrum = measure_spectrum(lines, grid)
    left_open = ambiguity(lines, grid, spectrum, beam, along)
    antennas_m, cycles_per_m = antennas_and_phase(lines, spectrum, beam)
    geometry_error = GEOMETRY_ERROR if fixed else allowed(accuracy_db)
    layout = lay_out(
        grid,
        antennas_m,
        cycles_per_m,
        device.info.width,
        error=geometry_error,
        speed_ratio=fastest(lines),
        beam=beam,
        fullness=fullness,
    )
    _check_distances(antennas_m, layout)
    terms = phases.TERMS[-1] if fixed else phases.terms_within(accuracy_db)
    interpolator = interpolation.choose(
        spectrum,
        left_open.rest_db(accuracy_db, model.error),
        taps=taps,
        upsampling=upsampling,
        other_error=math.hypot(geometry_error, phases.error(terms)),
        pixels_per_sample=grid.size / lines.length,
        most_upsampling=most_upsampling(device, lines, layout.lookup_radius_m),
    )
    resampling = interpolation.resampling(lines.length, interpolator, spectrum)
    one_cubic = False
    if beam is not None:
        nearest_m = max(layout.nearest_m(lines.phase_centres_m) - layout.radius_m, 1e-30)
        error = layout.one_cubic_error(beam, nearest_m, wavelength_m(lines))
        one_cubic = error <= geometry_error * fullness
    return Preparation(
        device,
        lines,
        grid,
        layout,
        interpolator,
        resampling,
        terms,
        beam,
        along,
        one_cubic,
        wanted_db=0.0 if fixed else accuracy_db,
        ambiguity=left_open,
        given_grid=given_grid,
        left_out=model.left_out,
        left_out_error=model.error,
    )


def form_exactly(
    lines: RangeLines,
    grid: Grid,
    *,
    progress: Callable[[int, int], None] | None = None,
    warned: bool = False,
    **wish: Any,
) -> Image:
    """Form an image as `backproject` does, without its warnings of what the lines leave open.

    `warned` is whether an image of zeros has been warned of too.
    """
    return execute(prepare(lines, grid, **wish), progress=progress, warned=warned)


def antennas_and_phase(
    lines: RangeLines, spectrum: Spectrum, beam: BeamWindow | None
) -> tuple[NDArray[np.float64], float]:
    """Return all places that ranges and aspects are from, [n, 3], and cycles per metre of range.

    The latter are what rounding a range costs: phase, and place within the lines' band, 0.3 Nyquist
    rms.
    """
    antennas_m = lines.tx_m
    if not np.array_equal(lines.tx_m, lines.rx_m):
        antennas_m = np.unique(np.concatenate([lines.tx_m, lines.rx_m]), axis=0)
    if beam is not None:
        antennas_m = np.concatenate([antennas_m, lines.phase_centres_m])
    of_phase = cycles_per_m_at(lines, spectrum.centre)
    return antennas_m, math.hypot(of_phase, 0.3 / lines.range_step_m)


def fullness_of(
    lines: RangeLines, grid: Grid, beam: BeamWindow, along: NDArray[np.float64]
) -> float:
    """Return `BeamWindow.fullness` of some channels at points all over a grid, its edges too."""
    some = some_channels(lines.channels, _CHANNELS)
    sine = sines(grid.spread(_PLACES), lines.phase_centres_m[some], along[some])
    return beam.fullness(sine, wavelength_m(lines), len(some) / lines.channels)


def most_upsampling(device: Device, lines: RangeLines, lookup_radius_m: float) -> dict[int, float]:
    """Return by taps the upsampling beyond which a block is too large for the window, if any."""
    if not device.info.permute:
        return {}
    reach_m = lookup_radius_m * (1 + 2 * fastest(lines))
    samples = {taps: lookup_room(taps, device.info.width) for taps in interpolation.TAPS}
    return {taps: room * lines.range_step_m / max(reach_m, 1e-30) for taps, room in samples.items()}


def execute(
    preparation: Preparation,
    *,
    progress: Callable[[int, int], None] | None = None,
    warned: bool = False,
) -> Image:
    """Form the image that was prepared; `warned` is whether one of zeros has been warned of.

    The image is formed in bands that fit the device, each from blocks of channels, each block in
    jobs of so many (part, channel) pairs; a job is prepared on the host while the one before runs.
    With a beam only pairs that see each other are prepared.
    """
    validate.progress(progress)
    p = preparation
    layout, device = p.layout, p.device
    pixels = np.empty(layout.parts * layout.part_pixels, np.complex64)
    normalise = p.beam is not None and p.beam.normalise
    try:
        run = _Run(p, progress)
        at_once = band_parts(device, layout.part_pixels, layout.across, normalise)
        for band in _slices(slice(0, layout.parts), at_once):
            part = slice(band.start * layout.part_pixels, band.stop * layout.part_pixels)
            on_device = [device.zeros(pixels[part].nbytes) for _ in range(1 + normalise)]
            for channels in _slices(slice(0, p.lines.channels), run.channels_at_once):
                run.add(channels, band, on_device)
            cl.enqueue_copy(device.queue, pixels[part], on_device[0])
            if normalise:
                sums = np.empty_like(pixels[part])
                cl.enqueue_copy(device.queue, sums, on_device[1])
                pixels[part] *= normalising(sums.real, p.lines.channels)
    finally:
        device.finish()  # an interrupted run leaves nothing in use
    image = Image(layout.collect(pixels), p.given_grid or p.grid)
    if not warned and not holds_any(image.pixels) and p.lines.samples.any():
        warn_unseen(p.lines, layout.centres_m(slice(None)), p.beam, p.along)
    return image


def normalising(sums: NDArray[np.floating], channels: int) -> NDArray[np.floating]:
    """Return what a normalising beam multiplies pixels by whose weights have these sums."""
    return (channels / np.maximum(sums, HARDLY_SEEN)).astype(sums.dtype)


def wavelength_m(lines: RangeLines) -> float:
    """Return the wavelength of the carrier, infinite without one."""
    return lines.sound_speed_m_s / lines.carrier_hz if lines.carrier_hz else math.inf


def beam_arguments(
    device: Device, beam: BeamWindow | None, lines: RangeLines
) -> tuple[float, tuple[object, ...]]:
    """Return table intervals per sine, and what kernels with BEAM take at their ends."""
    if beam is None:
        return 0.0, ()
    low, high = (float(limit) for limit in beam.limits)
    lowest, highest = max(low, -1.0), min(high, 1.0)
    per_sine = INTERVALS / (highest - lowest)
    places = (lowest * per_sine, (low - lowest) * per_sine, (high - lowest) * per_sine)
    return per_sine, (device.upload(beam.table(wavelength_m(lines))), *places)


@dataclass(frozen=True)
class Blocks:
    """What is on a device at once.

    Attributes
    ----------
    reach, margin : int
        Samples by which a part may reach beyond a line's end, and zeros around lines.
    pitch : int
        Samples of a line with these.
    terms : int
        Coefficients per (tile, channel); none off a plane.
    channels_at_once, parts_at_once : int
    """

    reach: int
    margin: int
    pitch: int
    terms: int
    channels_at_once: int
    parts_at_once: int


def blocks_of(
    device: Device,
    lines: RangeLines,
    resampling: Resampling,
    taps: int,
    *,
    radius_m: float,
    part_pixels: int,
    tiled: bool,
    beam: BeamWindow | None,
) -> Blocks:
    """Return how much of an image's data is on a device at once.

    That is an eighth of its memory for either set of lines, a sixteenth for either of references.
    """
    # Zeros around a line on the device: a part may reach beyond its end by a radius.
    reach = math.ceil(radius_m * resampling.samples_per_m(lines) * 1.1) + taps
    margin = 2 * reach + 2 * device.info.width
    pitch = _round_up(resampling.length + 2 * margin, 16)
    if pitch % 256 == 0:  # lines at equal places in cache sets would evict each other
        pitch += 16
    terms = expansion_terms(beam) if tiled else 0
    line_bytes = 8 * pitch
    part_bytes = _CHANNELS_AT_ONCE * (16 + 4 * terms) + 12 * part_pixels
    most = device.info.max_buffer_bytes
    room = min(most, device.info.memory_bytes // 8)
    if line_bytes > most:
        raise ValueError(
            f"lines of {lines.length} samples need {line_bytes / 2**10:.0f} KiB each when "
            f"upsampled, more than a buffer of {device.info.label}, {most / 2**10:.0f} KiB"
        )
    return Blocks(
        reach,
        margin,
        pitch,
        terms,
        channels_at_once=min(_CHANNELS_AT_ONCE, max(room // line_bytes, 1)),
        parts_at_once=max(min(_PART_BYTES, room // 2) // part_bytes, 1),
    )


class _Run:
    """A preparation at work: its kernels, its buffers, and how much it has done."""

    def __init__(
        self, preparation: Preparation, progress: Callable[[int, int], None] | None
    ) -> None:
        p = self.p = preparation
        device, layout = p.device, p.layout
        self.tiled = isinstance(layout, Tiles)
        self.moving = p.lines.rx_velocity_m_s is not None
        self.bistatic = self.moving or not np.array_equal(p.lines.tx_m, p.lines.rx_m)
        self.radius_m = layout.radius_m
        self.origin_m = layout.centres_m(slice(0, 1))[0]

        blocks = blocks_of(
            device,
            p.lines,
            p.resampling,
            p.interpolator.taps,
            radius_m=self.radius_m,
            part_pixels=layout.part_pixels,
            tiled=self.tiled,
            beam=p.beam,
        )
        self.reach, self.margin, self.pitch = blocks.reach, blocks.margin, blocks.pitch
        self.terms, self.channels_at_once = blocks.terms, blocks.channels_at_once
        self.parts_at_once = blocks.parts_at_once

        options = {
            "WIDTH": device.info.width,
            "TAPS": p.interpolator.taps,
            "TILE_ROWS": layout.side if self.tiled else 16,
            "TILE_COLUMNS": layout.side if self.tiled else 16,
            "BISTATIC": int(self.bistatic),
            "MOVING": int(self.moving),
            "BEAM": 0 if p.beam is None else INTERVALS,
            "ONE_CUBIC": int(p.one_cubic),
            "NORMALISE": int(p.beam is not None and p.beam.normalise),
            "ALONE": 0,
            "CENTRED": 0,
            "PHASE_TERMS": p.phase_terms,
        }
        options |= lookup_options(device, layout, p.lines, p.samples_per_m, p.interpolator.taps)
        name = "backproject_tiles" if self.tiled else "backproject_points"
        self.kernel = device.kernel("backproject", name, **options)
        self.expand = device.kernel("backproject", "expand_tiles", **options)

        # While one set of buffers is in use on the device, the other is filled.
        self.line_slots = itertools.cycle([Slot(device), Slot(device)])
        self.part_slots = itertools.cycle([Slot(device), Slot(device)])
        self.weights = device.upload(lookup_weights(p.interpolator.coefficients, p.phase_terms))
        self.per_sine, self.beam = beam_arguments(device, p.beam, p.lines)
        self.corner = device.upload(np.zeros(2, np.int32))
        self.progress = progress
        self.done = 0

    def add(self, channels: slice, band: slice, pixels: list[cl.Buffer]) -> None:
        """Add some channels to the pixels of a band of parts, and to the sums of their weights."""
        ranges = self._ranges(channels, band)
        seen = ranges[:, 1] > ranges[:, 0]
        if not seen.any():
            self._report((band.stop - band.start) * (channels.stop - channels.start))
            return
        # Lines that no part sees are left out.
        first, end = int(ranges[seen].min()), int(ranges[seen].max())
        ranges[seen] -= first
        of_all = channels.stop - channels.start
        channels = slice(channels.start + first, channels.start + end)
        lines = self.p.lines.select(channels)
        line_slot = next(self.line_slots)
        line_slot.wait()
        width, resampling = self.p.device.info.width, self.p.resampling
        samples = upsampled_lines(lines.samples, resampling, width, self.margin, self.pitch)
        line_slot.fill("samples", samples)
        geometry = self._geometry(lines, channels)
        line_slot.fill("geometry", geometry)
        for parts in _slices(band, self.parts_at_once):
            of_parts = ranges[parts.start - band.start : parts.stop - band.start]
            if of_parts.any():
                slot = next(self.part_slots)
                slot.wait()
                centres_m = self.p.layout.centres_m(parts)
                slot.fill("centres", float_pairs(centres_m - self.origin_m))
                slot.fill("ranges", np.column_stack([of_parts, of_parts[:, 0]]))
                references = self._references(centres_m, lines, of_parts)
                for name, values in references.items():
                    slot.fill(name, values)
                pitches = (references["sample"].shape[1], geometry.shape[1])
                first_part = parts.start - band.start
                event = self._launch(line_slot, slot, parts, pitches, first_part, pixels)
                slot.busy = line_slot.busy = event
                self.p.device.queue.flush()
            self._report((parts.stop - parts.start) * of_all)

    def _ranges(self, channels: slice, band: slice) -> NDArray[np.int32]:
        """Return which of some channels each part of a band sees, [parts, 2]: first and end."""
        p = self.p
        count = channels.stop - channels.start
        if p.beam is None:
            return np.tile(np.array([0, count], np.int32), (band.stop - band.start, 1))
        lines, along = p.lines.select(channels), p.along[channels]
        return np.concatenate(
            [
                channel_ranges(p.beam, lines, along, p.layout.centres_m(parts), self.radius_m)
                for parts in _slices(band, self.parts_at_once)
            ]
        )

    def _launch(
        self,
        line_slot: Slot,
        slot: Slot,
        parts: slice,
        pitches: tuple[int, int],
        first_part: int,
        pixels: list[cl.Buffer],
    ) -> cl.Event:
        """Run the kernels of one job on buffers that are being filled.

        `pitches` are those of channels in what is held per part, and in the geometry.
        """
        p, device, layout = self.p, self.p.device, self.p.layout
        count = parts.stop - parts.start
        pitch, geometry_pitch = pitches
        if self.tiled:
            geometry = slot.buffer("expansion", 4 * self.terms * count * pitch)
            steps_m = (p.grid.column_step_m, p.grid.row_step_m)
            device.run(
                self.expand,
                (pitch // device.info.width, count),
                line_slot["geometry"],
                pitch,
                geometry_pitch,
                slot["ranges"],
                0,
                slot["centres"],
                *(np.append(step, 0).astype(np.float32) for step in steps_m),
                p.samples_per_m,
                np.zeros(2, np.float32),
                geometry,
                *self.beam[1:2],
                wait_for=line_slot.filled + slot.filled,
            )
            size = (layout.part_pixels // (device.info.width * STACK), count)
            pitches, ranges = (pitch,), (slot["ranges"], 0)
            rest = (
                layout.across * layout.side,
                self.corner,
                layout.down,
                layout.across,
                first_part,
            )
        else:
            geometry = line_slot["geometry"]
            slot.fill("offsets", layout.offset_m[parts].reshape(-1, 3).T)
            size = (count,)
            pitches, ranges = (geometry_pitch, pitch), (slot["ranges"], 0)
            points = count * layout.part_pixels
            rest = (first_part, slot["centres"], slot["offsets"], points, p.samples_per_m)
        return device.run(
            self.kernel,
            size,
            line_slot["samples"],
            self.pitch,
            slot["sample"],
            slot["fraction"],
            slot["phase"],
            geometry,
            *pitches,
            *ranges,
            p.cycles_per_m / p.samples_per_m,
            self.weights,
            pixels[0],
            *rest,
            *self.beam,
            *pixels[1:],
            wait_for=line_slot.filled + slot.filled,
        )

    def _geometry(self, lines: RangeLines, channels: slice) -> NDArray[np.float32]:
        """Return positions about the origin, velocities over sound speed and directions.

        That is float32 [rows, channels]. A vector may begin at any channel.
        """
        rows = [float_pairs(lines.tx_m - self.origin_m)]
        if self.bistatic:
            rows.append(float_pairs(lines.rx_m - self.origin_m))
        if self.moving:
            rows.append((lines.rx_velocity_m_s / lines.sound_speed_m_s).astype(np.float32))
        if self.p.beam is not None:
            rows.append((self.p.along[channels] * self.per_sine).astype(np.float32))
        pitch = channel_pitch(lines.channels) + VECTOR_ROOM
        geometry = np.concatenate(rows, axis=1).T
        return np.pad(geometry, ((0, 0), (0, pitch - lines.channels)), mode="edge")

    def _references(
        self, centres_m: NDArray[np.float64], lines: RangeLines, ranges: NDArray[np.int32]
    ) -> dict[str, NDArray]:
        """Return where each centre's echo lies in each line, and its phase, reduced in float64.

        These are [parts, channels], from the first channel in a part's range on.
        """
        resampling = self.p.resampling
        seen = ranges[:, 1] > ranges[:, 0]
        count = int((ranges[:, 1] - ranges[:, 0]).max())
        if count == lines.channels and not ranges[:, 0].any():
            seen[:] = True
            range_m = pairwise_range_m(
                centres_m,
                lines.tx_m,
                lines.rx_m,
                lines.rx_velocity_m_s,
                lines.sound_speed_m_s,
            )
            first_range_m = lines.first_range_m
        else:
            range_m, first_range_m = _windowed_ranges(
                centres_m[seen], lines, ranges[seen, 0], count
            )
        place = (range_m - first_range_m) / lines.range_step_m + resampling.lead
        range_m *= lines.carrier_cycles_per_m
        cycles = range_m + place * resampling.centre_cycles_per_sample
        cycles -= np.rint(cycles)
        place *= resampling.ratio
        place += self.margin - resampling.first
        nearest = np.rint(place)
        place -= nearest
        # A part that lies outside a line altogether is put where it reads zeros only.
        nearest = np.clip(
            nearest,
            self.margin - self.reach,
            self.margin + resampling.length + self.reach,
        )
        shape = (len(centres_m), channel_pitch(count))
        references = {
            "sample": np.zeros(shape, np.int32),
            "fraction": np.zeros(shape, np.float32),
            "phase": np.zeros(shape, np.float32),
        }
        for array, values in zip(references.values(), (nearest, place, cycles), strict=True):
            array[seen, :count] = values
        return references

    def _report(self, pairs: int) -> None:
        self.done += pairs
        if self.progress is not None:
            self.progress(self.done, self.p.layout.parts * self.p.lines.channels)


def _windowed_ranges(
    centres_m: NDArray[np.float64], lines: RangeLines, first: NDArray[np.int32], count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the ranges of centres to `count` channels from each one's first, [centres, count].

    Beside them those of the lines' first samples. The last channel stands for those beyond it.
    """

    def window(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return sliding_window_view(np.pad(values, (0, count - 1), mode="edge"), count)[first]

    def distance_m(antennas_m: NDArray[np.float64]) -> NDArray[np.float64]:
        square = np.zeros((len(first), count))
        for axis in range(3):
            offset_m = window(antennas_m[:, axis])
            offset_m -= centres_m[:, axis, None]
            offset_m *= offset_m
            square += offset_m
        return np.sqrt(square, out=square)

    if lines.rx_velocity_m_s is not None:
        antennas = (lines.tx_m, lines.rx_m, lines.rx_velocity_m_s)
        moving = (np.stack([window(axis) for axis in each.T], axis=-1) for each in antennas)
        range_m = bistatic_range_m(centres_m[:, None], *moving, lines.sound_speed_m_s)
    else:
        range_m = distance_m(lines.tx_m)
        if not np.array_equal(lines.tx_m, lines.rx_m):
            range_m += distance_m(lines.rx_m)
            range_m *= 0.5
    return range_m, window(lines.first_range_m)


def upsampled_lines(
    samples: NDArray[np.complex64],
    resampling: Resampling,
    width: int,
    margin: int,
    pitch: int,
    gain: Gain | None = None,
) -> NDArray[np.float32]:
    """Return lines upsampled as the kernels want them: `pitch` samples each, zeros around.

    With one lane per work-item they are interleaved, [channels, pitch, 2]; with more, real and
    imaginary parts are planes, [channels, 2, pitch]. `gain` multiplies their spectrum.
    """
    of_line = (pitch, 2) if width == 1 else (2, pitch)
    padded = aligned(np.zeros, (len(samples), *of_line), np.float32)
    inside = slice(margin, margin + resampling.length)

    factor = None if gain is None else gain(resampling.frequency)

    def fill(some: slice) -> None:
        upsampled = resampling.apply(samples[some], factor)
        for part, values in enumerate((upsampled.real, upsampled.imag)):
            if width == 1:
                padded[some, inside, part] = values
            else:
                padded[some, part, inside] = values

    for _ in in_threads(fill, _slices(slice(0, len(samples)), _LINES_AT_ONCE)):
        pass
    return padded


def float_pairs(positions_m: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return float32 [n, 6]: positions [n, 3] as nearest float32 numbers, and what these leave."""
    nearest = positions_m.astype(np.float32)
    return np.concatenate([nearest, (positions_m - nearest).astype(np.float32)], axis=1)


def lookup_options(
    device: Device, layout: Tiles | Groups, lines: RangeLines, samples_per_m: float, taps: int
) -> dict[str, int]:
    """Return the build options that say how samples are looked up (cl/backproject.cl)."""
    # Ranges to receivers that move change a little faster than pixels' places.
    reach_m = lookup_room(taps, device.info.width) / samples_per_m / (1 + 2 * fastest(lines))
    windows = layout.windows(reach_m) if device.info.permute else 0
    return {"PERMUTE": int(windows > 0), "WINDOWS": windows or 1}


def lookup_weights(coefficients: NDArray[np.float64], terms: int) -> NDArray[np.float32]:
    """Return what the kernels take as weights: an interpolator's, and polynomials for phases."""
    polynomials = phases.polynomials(terms).ravel()
    return np.concatenate([coefficients.ravel().astype(np.float32), polynomials])


def lookup_room(taps: int, width: int) -> float:
    """Return how many samples pixels may lie from the middle of the lookup's window.

    It holds two vectors of samples. Half of the taps lie beyond a pixel. That the places of both
    are rounded is made up for by the window's middle being between two samples; a twentieth is for
    float32.
    """
    return width - taps / 2 - 0.05


def expansion_terms(beam: BeamWindow | None) -> int:
    """Return how many numbers `expand_tiles` finds per tile and channel."""
    return 9 if beam is None else 19


def channel_pitch(channels: int) -> int:
    """Channels with padding to whole vectors of any width."""
    return _round_up(channels, 16)


def _round_up(number: int, multiple: int) -> int:
    return -(-number // multiple) * multiple


def _slices(whole: slice, most: int) -> Iterator[slice]:
    """Cut a slice into pieces of at most `most`."""
    for start in range(whole.start, whole.stop, most):
        yield slice(start, min(start + most, whole.stop))


def band_parts(device: Device, part_pixels: int, across: int, normalise: bool) -> int:
    """Return how many parts' pixels may be on a device at once: whole rows of tiles."""
    most = min(device.info.max_buffer_bytes, device.info.memory_bytes // 4)
    return max(most // (8 * (1 + normalise) * part_pixels) // across, 1) * across


def check_accumulate(image: Image, grid: Grid, beam: BeamWindow | None) -> None:
    """Refuse an image that another one on a grid cannot be added to."""
    validate.instance("accumulate", image, Image)
    if image.grid is not grid and not np.array_equal(image.grid.positions_m(), grid.positions_m()):
        raise ValueError("accumulate must be an image on the same grid")
    if beam is not None and beam.normalise:
        raise ValueError("accumulate must be None with a beam that normalises: it is a mean")


def check_numbers(lines: RangeLines, beam: BeamWindow | None) -> float:
    """Refuse lines whose numbers would leave what float32 sums or float64 phases can hold.

    Return the largest part of a sample.
    """
    heaviest = 1.0
    if beam is not None:
        if beam.shape == "inverse" and not lines.carrier_hz:
            raise ValueError("carrier_hz must be above 0 for a beam of the shape 'inverse'")
        heaviest = max(float(beam.table(wavelength_m(lines)).max()), 1.0)
    validate.number(
        "range_step_m", lines.range_step_m, "m", least=_SMALLEST_STEP_M, most=_LARGEST_DISTANCE_M
    )
    farthest_m = np.abs([lines.first_range_m, lines.last_range_m]).max()
    with np.errstate(over="ignore"):
        cycles = np.float64(2) * lines.carrier_hz / lines.sound_speed_m_s * farthest_m
    if not cycles <= _MOST_CYCLES:
        raise ValueError(
            f"carrier_hz = {lines.carrier_hz:g} Hz makes {cycles:.3g} cycles over {farthest_m:g} m "
            f"at {lines.sound_speed_m_s:g} m/s; float64 holds the phase of {_MOST_CYCLES:g}"
        )
    parts = lines.samples.reshape(-1).view(np.float32)  # contiguous, as every RangeLines
    # Part by part, so that a cache holds them for the second look.
    spans = [parts[i : i + _LOOKED_AT] for i in range(0, parts.size, _LOOKED_AT)]
    largest = float(max(max(span.max(), -span.min()) for span in spans))
    most = _LARGEST_SUM / heaviest / lines.channels
    if largest > most:
        raise ValueError(
            f"samples must be at most {most:.3g} for the sum of {lines.channels} channels to stay "
            f"within float32, got {largest:.3g}"
        )
    speed_m_s = fastest(lines) * lines.sound_speed_m_s
    most_m_s = _FASTEST * lines.sound_speed_m_s
    validate.number("the speed of rx_velocity_m_s", speed_m_s, "m/s", most=most_m_s * (1 + 1e-9))
    return largest


def fastest(lines: RangeLines) -> float:
    """Return the speed of the fastest receiver over that of sound."""
    if lines.rx_velocity_m_s is None:
        return 0.0
    return float(np.linalg.norm(lines.rx_velocity_m_s, axis=1).max()) / lines.sound_speed_m_s


def _check_distances(antennas_m: NDArray[np.float64], layout: Tiles | Groups) -> None:
    """Refuse distances so large that a square overflows float32."""
    points_m = np.concatenate([antennas_m, layout.centres_m(slice(None))])
    extent_m = float(np.ptp(points_m, axis=0).max())
    if extent_m > _LARGEST_DISTANCE_M:
        raise ValueError(
            f"lines and grid must lie within {_LARGEST_DISTANCE_M:g} m of each other, "
            f"got {extent_m:g} m"
        )
