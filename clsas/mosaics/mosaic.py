"""Mosaics: images of any size, formed block by block on one or several devices or machines.

`mosaic` checks its arguments and opens the survey and the store. Iterating over the `Mosaic` that
it returns hands blocks of patches to the devices of this process or to the workers of a cluster,
also while files are added to the survey. `form_block` forms one of them: every block is planned,
imaged and certified as a whole, from the channels and samples that it needs.

What is stored is a patch. In a store (`clsas.mosaics.store`) it is finished once it has a record,
which is written after its pixels. If a mosaic is interrupted, the next run forms only the blocks
with patches that are not finished.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Executor, Future
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import reprs, validate
from clsas.engine.data.beam import MOST_TRACK_PINGS, BeamWindow, scale_to_all
from clsas.engine.data.certificate import scaled
from clsas.engine.data.coverage import reaches, warn_unreached
from clsas.engine.data.decibels import in_db, power
from clsas.engine.data.declared import check_declared
from clsas.engine.data.digests import digest, grid_digest
from clsas.engine.data.georeference import placed
from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Formed, Image, holds_any
from clsas.engine.data.lines import RangeLines, some_channels
from clsas.engine.data.simplify import shift_error
from clsas.engine.data.threads import uninterrupted, wait
from clsas.engine.data.validate import ArgumentError, ArgumentTypeError
from clsas.engine.data.version import __version__
from clsas.engine.device.device import Device
from clsas.engine.exact.decide import ACCURACY, BEST_ACCURACY_DB
from clsas.engine.factorized.plan import ExactImage
from clsas.engine.factorized.planner import (
    DEFAULT_REQUEST,
    THESIS_STAGES,
    TOLERANCE_DB,
    Request,
    is_soon_done,
    planned,
    tolerance_in_db,
)
from clsas.engine.forming import SceneImager, form
from clsas.engine.promise import (
    CERTIFICATE,
    ON_MISS,
    describe_miss,
    is_wanted,
    measured_or_reason,
    report,
    tightened_db,
)
from clsas.engine.scene import Scene
from clsas.engine.signal.doubts import warn_before_imaging
from clsas.mosaics.devices import device_threads, open_devices, process_device, thread_device
from clsas.mosaics.document import (
    Document,
    MosaicCertificate,
    PatchIndex,
    Record,
    is_there,
    requested_db,
)
from clsas.mosaics.patches import Block, Layout, aligned_shape, patch_shape_of
from clsas.mosaics.store import Store
from clsas.mosaics.survey import (
    END,
    FOLLOW,
    POLL_S,
    GrowingSurvey,
    Growth,
    PatchSource,
    Survey,
    SurveyVisibility,
    beam_json,
    has_ended,
    largest_gap_m,
    open_survey,
    opened_visibility,
    warn_of_order,
)

if TYPE_CHECKING:
    from distributed import Client

REQUESTS = ("tolerance_db", "tolerance_wavelengths", "stages", "accuracy_db")
"""Requests for accuracy or a method, of which a mosaic takes at most one."""

MEMORY_BYTES = 1 << 30
"""Default memory of one block: a plain choice, which suits laptops and small GPUs."""

_MOST_PIXELS = 4096**2  # of a block; such a block takes seconds, and larger ones gain nothing
_SMALLEST_SIDE = 128  # pixels; reading and planning smaller patches takes longer than imaging
_BLOCKS_PER_WORKER = 4  # at least, where several share the work: a plain choice
_SAMPLED = 32  # patches or blocks whose memory is predicted, evenly spread; a plain choice
_MOST_ON_CLUSTER = 1000  # blocks submitted at once: enough for any cluster, few to wait for


def mosaic(
    source: RangeLines | str | os.PathLike,
    grid: Grid,
    store: str | os.PathLike | None = None,
    *,
    tolerance_db: float | None = None,
    tolerance_wavelengths: float | None = None,
    stages: Sequence[tuple[int, int]] | None = None,
    accuracy_db: float | None = None,
    beam: BeamWindow | None = None,
    patches: tuple[int, int] | None = None,
    memory_bytes: int | None = None,
    device: Device | str | int | Sequence[Device | str | int] | None = None,
    client: Client | None = None,
    certificate: Annotated[bool | None, CERTIFICATE] = None,
    on_miss: Annotated[str, ON_MISS] = "refine",
    follow_s: Annotated[float | None, FOLLOW] = None,
) -> Mosaic:
    """Return a mosaic, an image of any size that is formed and stored in patches.

    No patch is formed before you iterate over the result or call its `image`::

        for patch in clsas.mosaic("lines.h5", grid, "image.zarr", tolerance_db=-40):
            print(patch.row, patch.column, patch.record.predicted_error_db)

    Parameters
    ----------
    source : RangeLines or path
        Range lines, a file of them, or a folder of such files (*.h5, in the order of their names).
        Files are read in slices. A channel counts as missing if its samples are all zero, or if any
        is not finite.
    grid : Grid
        A plane, a height map, or arbitrary points with two axes.
    store : path, optional
        Zarr store to write, or to continue: its finished patches are not formed again. Required
        with a `client`. docs/mosaic.md describes the layout.
    tolerance_db, tolerance_wavelengths, stages
        See `clsas.plan`. The default is a tolerance of -50 dB.
    accuracy_db : float, optional
        Accuracy of exact backprojection, see `clsas.backproject`.
    beam : BeamWindow, optional
        Weights of the channels. If the beam's direction follows the track, it is computed from the
        whole track, not only from the part near a patch. In a store that may grow, since its
        folder contains no file named `end`, `track_pings` is 101 by default.
    patches : (rows, columns), optional
        Number of patches along both axes; the last ones may be smaller. By default patches are as
        large as memory allows, up to 16.8 million pixels. Smaller patches hardly take longer
        without a store, because neighbours are formed together, except with `stages` or `follow_s`.
    memory_bytes : int, optional
        Memory of patches that are formed together, on host and device; 1 GiB by default. Exact
        backprojection needs the device's buffers in addition, of up to 1024 upsampled lines.
    device : Device, str or int, or a sequence of them, optional
        Devices that work side by side. By default all GPUs if there are several, else the device
        that `choose` returns. Must be left out with a `client`, each of whose
        workers takes a device of its machine.
    client : distributed.Client, optional
        Client of a Dask cluster whose workers form the patches. They must be able to open `source`
        and `store` under the same paths.
    certificate : bool, optional
        Whether errors are measured, as by `clsas.certify`. By default, that of a block of patches
        is measured if planning and forming it take 0.1 s or more, except with `stages` or
        `tolerance_wavelengths`.
    on_miss : {"refine", "warn", "raise"}
        What to do if the measured error of the whole mosaic exceeds the tolerance beyond doubt:
        form the blocks that exceed it most again, by better plans and then exactly, until the
        whole meets the tolerance, with a warning; warn; or raise ToleranceError.
    follow_s : float, optional
        Wait for files to be added to the folder `source`, until it contains a file named `end` or
        no file has been added for this many seconds. A patch is formed once the beam of the latest
        channels has passed it, and again if later channels contribute to it.

    Returns
    -------
    Mosaic

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type or is outside its limits, if the files of a folder do not
        belong together, if lines and grid have different georeferences, if the smallest patch does
        not fit into memory, or if `store` was made with other inputs (the message names the
        differences).
    FileFormatError, OSError
        If a file cannot be read or the store cannot be written.
    ImportError
        If a store is given and Zarr is not installed.
    DeviceError
        If there is no such device.

    Warns
    -----
    ClsasWarning
        If no channel receives from the grid, or pixels lie behind the elements, where they can only
        show mirror images; if the geometry of the lines, or samples in memory, cannot be right; if
        a beam is given and the names of files do not follow the track; or if the image of a folder
        that may grow differs by more than was asked from that of the same pings in one file. A
        source that grows is not checked.

    See Also
    --------
    Mosaic : The result.
    Store : Read a mosaic from its store.
    factorize : Form an image that fits into memory in one piece.

    Notes
    -----
    Neighbouring patches are formed together, in blocks that are as large as `memory_bytes` allows,
    up to 16.8 million pixels, but no larger than leaves one to each device or worker. Blocks are
    formed independently of each other. Every patch is a block while a survey is followed, so that
    it is formed as soon as possible, and with `stages`, which state how each patch is divided.

    The error that is predicted for each block is within the tolerance, and so is the difference of
    neighbours along their border. The tolerance applies to the measured error of all together.

    Examples
    --------
    Image a point at (0, 20) m from a track of 4 m, in 2 x 2 patches:

    >>> import numpy as np
    >>> import clsas
    >>> track_m = np.stack([np.linspace(-2, 2, 161), np.zeros(161), np.zeros(161)], axis=1)
    >>> target = clsas.PointTargets([[0.0, 20.0, 0.0]])
    >>> lines = clsas.simulate_lines(
    ...     track_m, track_m, target, carrier_hz=30e3, bandwidth_hz=10e3, oversampling=1.5
    ... )
    >>> grid = clsas.Grid.plane((-1, 1, 41), (19, 21, 41))
    >>> image = clsas.mosaic(lines, grid, patches=(2, 2), accuracy_db=-60).image()
    >>> [int(index) for index in np.unravel_index(np.abs(image.pixels).argmax(), image.shape)]
    [20, 20]
    """
    validate.instance("grid", grid, Grid)
    if len(grid.shape) != 2:
        raise ArgumentError("grid", "have two axes for a mosaic", f"shape {grid.shape}")
    request = _checked_request(tolerance_db, tolerance_wavelengths, stages, accuracy_db)
    asked = check_declared(mosaic, {"certificate": certificate, "on_miss": on_miss})
    if beam is not None:
        validate.instance("beam", beam, BeamWindow)
    patch_shape = None if patches is None else patch_shape_of(patches, grid)
    if memory_bytes is None:
        memory_bytes = MEMORY_BYTES
    memory_bytes = validate.count("memory_bytes", memory_bytes)
    if not isinstance(source, RangeLines):
        source = validate.path("source", source)
    if client is not None:
        _check_client(client, source, store, device)
    growth = None if follow_s is None else Growth.checked(source, follow_s)
    stored = None if store is None else Store.at(validate.path("store", store))
    given, place = beam, None if stored is None else stored.path
    beam = beam_of_mosaic(beam, source, place, grows=growth is not None)
    devices = () if client is not None else open_devices(device)

    if growth is not None:
        growth.wait_for_first_file()
    survey = open_survey(source if isinstance(source, RangeLines) else source.resolve())
    grid = placed(survey.geometry, grid)
    visibility = SurveyVisibility.of(survey, beam)
    if growth is None:
        lines = source if isinstance(source, RangeLines) else survey.geometry
        warn_before_imaging(lines, grid, beam, last_range_m=survey.last_range_m)
        if beam is not None and beam.along is None:
            warn_of_order(survey)
        if not visibility.channels(grid).any():
            near_m, far_m = survey.geometry.first_range_m.min(), survey.last_range_m.max()
            span_m = float(near_m), float(far_m)
            warn_unreached(survey.geometry, grid, beam, visibility.along, span_m)
    if given is not None and given is not beam:
        warn = partial(warn_of_window, given, request=request)
        if growth is None:
            warn(survey.geometry)
        else:
            growth = replace(growth, at_end=warn)

    inputs = {} if stored is None else inputs_of(survey, grid, request, beam)
    if patch_shape is None and stored is not None:
        patch_shape = stored.patch_shape
    if patch_shape is None:
        patch_shape = _choose_patch_shape(visibility, grid, memory_bytes)
    block_shape = patch_shape
    if growth is None and "stages" not in request:
        least = len(devices) if client is None else max(sum(client.nthreads().values()), 1)
        if least > 1 or client is not None:  # they differ in speed, and more may join
            least *= _BLOCKS_PER_WORKER
        block_shape = _choose_block_shape(visibility, grid, patch_shape, memory_bytes, least)
    finished: dict[PatchIndex, Record] = {}
    if stored is not None:
        stored.begin(inputs, grid, patch_shape)
        layout = Layout(grid, patch_shape)
        finished = {
            index: record
            for index, record in stored.undamaged_records().items()
            if not _is_outdated(record, layout, index, visibility)
        }
    return Mosaic(
        grid,
        patch_shape,
        finished,
        _block_shape=block_shape,
        _form=partial(form_block, request, memory_bytes, stored, asked["certificate"]),
        _complete=None if stored is None else stored.complete_levels,
        _visibility=visibility,
        _store=stored,
        _inputs=inputs,
        _devices=devices,
        _tolerance_db=requested_db(request),
        _on_miss=asked["on_miss"],
        _client=client,
        _growth=growth,
    )


def _checked_request(
    tolerance_db: float | None,
    tolerance_wavelengths: float | None,
    stages: Sequence[tuple[int, int]] | None,
    accuracy_db: float | None,
) -> dict[str, Any]:
    """Return the given one of `REQUESTS` after checking it, or the default tolerance."""
    given = (tolerance_db, tolerance_wavelengths, stages, accuracy_db)
    request: dict[str, Any] = {
        name: value for name, value in zip(REQUESTS, given, strict=True) if value is not None
    }
    if len(request) > 1:
        first, second, *_ = request
        raise ArgumentError(second, f"be left out if `{first}` is given")
    tolerance_in_db(tolerance_db, tolerance_wavelengths)
    if accuracy_db is not None:
        ACCURACY.check("accuracy_db", accuracy_db)
    # Convert to plain numbers, since the inputs are stored as JSON.
    for name, value in request.items():
        if name == "stages":
            request[name] = THESIS_STAGES.check(name, value)
        elif not isinstance(value, (int, float)):
            request[name] = float(value)
    return request or DEFAULT_REQUEST


def _check_client(client: object, source: object, store: object, device: object) -> None:
    """Raise TypeError or ValueError unless the other arguments can be used with a client."""
    if not hasattr(client, "get_executor"):
        raise ArgumentTypeError("client", "be a `distributed.Client`", repr(client))
    if store is None:
        raise ArgumentError("store", "be given with a client, whose workers write to it")
    if isinstance(source, RangeLines):
        raise ArgumentError("source", "be a path with a client, whose workers read from it")
    if device is not None:
        raise ArgumentError(
            "device", "be left out with a client", hint="every worker takes one itself"
        )


def beam_of_mosaic(
    beam: BeamWindow | None, source: RangeLines | Path, store: Path | None, *, grows: bool
) -> BeamWindow | None:
    """Return a beam whose weights later pings do not change, if there may be any.

    Files may be added to a folder that is followed, and to one without a file `end` whose mosaic is
    stored. The mosaic of such a folder keeps its beam when the folder is complete.

    Raises
    ------
    ValueError
        If there may be later pings, and the weights depend on them.
    """
    if beam is None or isinstance(source, RangeLines) or not source.is_dir():
        return beam
    if grows or (store is not None and not has_ended(source)):
        if beam.normalise:
            raise ArgumentError(
                "beam",
                "not normalise for a folder that may grow, since the scale depends on the number "
                "of all channels",
                hint=f"put an empty file '{END}' into a complete folder",
            )
        return _beam_of_growing(beam)
    if store is not None and is_there(store):
        growing = _beam_of_growing(beam)
        if Document.read(store).inputs.get("beam") == json.loads(beam_json(growing)):
            return growing
    return beam


def _beam_of_growing(beam: BeamWindow) -> BeamWindow:
    """Return a beam whose direction follows the track over a fixed number of pings."""
    if beam.along is None and beam.track_pings is None:
        return replace(beam, track_pings=MOST_TRACK_PINGS)
    return beam


def warn_of_window(beam: BeamWindow, geometry: RangeLines, request: dict[str, Any]) -> None:
    """Warn if a growing survey's image differs from that of the same pings in one file.

    `beam` is that of the file, whose direction follows the track over another number of pings.
    The difference is the rms of that of the weights, relative to their own.
    """
    if len(geometry.ping_starts) < 2:
        return
    growing = _beam_of_growing(beam)
    sine = np.linalg.norm(np.cross(beam.directions(geometry), growing.directions(geometry)), axis=1)
    error = shift_error(beam, float(np.sqrt(np.mean(sine**2))), geometry)
    if error > power(requested_db(request) or TOLERANCE_DB):
        validate.warn(
            "`source` may grow, or did when the mosaic began: the direction of the track is "
            f"smoothed over {MOST_TRACK_PINGS} pings, whatever their number. The image may differ "
            f"by {in_db(error):.0f} dB from that of the {len(geometry.ping_starts)} pings "
            "in one file. Give `track_pings` for both, or put an empty file "
            f"'{END}' into a complete folder before its mosaic begins"
        )


def _choose_patch_shape(
    visibility: SurveyVisibility, grid: Grid, memory_bytes: int
) -> tuple[int, int]:
    """Return the number of pixels of the largest patches that are predicted to fit into memory.

    Raises
    ------
    ValueError
        If not even the smallest patches fit.
    """
    for parts in _divisions(grid.shape):
        shape = aligned_shape(grid.shape, parts)
        needed = _needed_bytes(visibility, Layout(grid, shape))
        if needed <= memory_bytes and math.prod(shape) <= _MOST_PIXELS:
            break
        if max(shape) <= _SMALLEST_SIDE:
            raise ArgumentError(
                "memory_bytes",
                f"be at least {needed / 2**20:.0f} MiB for the smallest patches, of "
                f"{reprs.by(shape)} pixels",
                f"{memory_bytes / 2**20:.3g} MiB",
                "raise it or give `patches`",
            )
    return shape


def _choose_block_shape(
    visibility: SurveyVisibility,
    grid: Grid,
    patch_shape: tuple[int, int],
    memory_bytes: int,
    least: int,
) -> tuple[int, int]:
    """Return the number of pixels of the largest blocks of patches that fit into memory.

    There are at least `least` of them, unless there are fewer patches.
    """
    patches = Layout(grid, patch_shape).shape
    for parts in _divisions(grid.shape):
        rows, columns = (
            math.ceil(count / part) * pixels
            for count, part, pixels in zip(patches, parts, patch_shape, strict=True)
        )
        if (rows, columns) == patch_shape:
            break
        layout = Layout(grid, (rows, columns))
        if (
            rows * columns <= _MOST_PIXELS
            and len(layout) >= least
            and _needed_bytes(visibility, layout) <= memory_bytes
        ):
            break
    return rows, columns


def _divisions(shape: tuple[int, ...]) -> Iterator[tuple[int, int]]:
    """Yield numbers of parts along rows and columns, each time halving the parts' longer side."""
    rows = columns = 1
    while True:
        yield rows, columns
        if shape[0] / rows >= shape[1] / columns:
            rows *= 2
        else:
            columns *= 2


def _needed_bytes(visibility: SurveyVisibility, layout: Layout) -> int:
    """Return the memory that patches or blocks are predicted to need, from some of them."""
    most, indices = 0, list(layout.indices())
    for number in some_channels(len(indices), _SAMPLED):
        window = layout.window(indices[number]).grid
        visible = visibility.channels(window)
        if visible.any():
            count, length = visibility.survey.extent(visible, *visibility.ranges_m(window))
            most = max(most, count * length)
    # Upsampled lines and stages on the device take about one and a half times the lines.
    return _host_bytes(1, most, math.prod(layout.patch_shape)) + 12 * most + (64 << 20)


def inputs_of(
    survey: Survey, grid: Grid, request: dict[str, Any], beam: BeamWindow | None
) -> dict[str, Any]:
    """Return the inputs of a mosaic as JSON types."""
    inputs = {
        "parts": survey.digests(),
        "grid": grid_digest(grid),
        "pixels": list(grid.shape),
        "carrier_hz": survey.geometry.carrier_hz,
        "sound_speed_m_s": survey.geometry.sound_speed_m_s,
        "georeference": None if grid.georeference is None else asdict(grid.georeference),
        "beam": None if beam is None else json.loads(beam_json(beam)),
        **{name: request.get(name) for name in REQUESTS},
    }
    return json.loads(json.dumps(inputs))


@dataclass(frozen=True, eq=False)
class Mosaic:
    """An image of any size, to be formed patch after patch or, with `image`, as a whole.

    Iterating over the mosaic yields every `Patch` as soon as it is finished, and once more if it is
    formed again. A second iteration forms only the patches that the store lacks.

    A mosaic can be pickled, together with its lines unless they are in files. The process that
    unpickles it opens devices of the same names. A mosaic with a client cannot be pickled, since
    the connection belongs to this process.

    Attributes
    ----------
    grid : Grid
        Grid of the whole mosaic.
    patch_shape : (rows, columns)
        Number of pixels of a patch; the last patches along each axis may be smaller. Patches are
        formed together with their neighbours, several at a time.
    shape : (rows, columns)
        Number of patches.
    finished : dict of (row, column) to Record
        Records of the finished patches in the store.

    See Also
    --------
    mosaic : Prepare a mosaic.
    Store : Read a mosaic from its store.
    """

    grid: Grid
    patch_shape: tuple[int, int]
    finished: dict[PatchIndex, Record]
    _block_shape: tuple[int, int]  # pixels of the patches that are formed together
    _form: Callable[[Block, PatchSource, Record | None], Sequence[tuple[Record, Image | None]]]
    _complete: Callable[[], object] | None  # called once all patches are finished
    _visibility: SurveyVisibility  # the survey when the mosaic was requested
    _store: Store | None
    _inputs: dict[str, Any]  # as stored with the mosaic
    _devices: tuple[Device, ...]  # of this process; empty with a client
    _tolerance_db: float | None  # of the whole
    _on_miss: str
    _client: Client | None = None
    _growth: Growth | None = None  # None if no files are to be added

    def __getstate__(self) -> dict[str, Any]:
        """Return the fields to pickle; the process that unpickles them opens the devices again.

        Raises
        ------
        TypeError
            If the mosaic has a client, whose connection belongs to this process.
        """
        if self._client is not None:
            raise TypeError(
                "a mosaic with a client cannot be pickled, since the connection belongs to this "
                "process: call `clsas.mosaic` where it is needed, with the same source and store"
            )
        return self.__dict__

    def __repr__(self) -> str:
        """Return the number of patches and of finished ones, the store, extents and the error."""
        store = None if self._store is None else str(self._store.path)
        certificate = MosaicCertificate.of(self.finished)
        return reprs.summary(
            self,
            f"{reprs.by(self.shape)} patches of {reprs.by(self.patch_shape)} pixels",
            f"{len(self.finished)} of {len(self)} finished",
            None if store is None else f"store {store!r}",
            reprs.extents(*self.grid.bounds_m),
            None if certificate is None else certificate.describe(),
        )

    @property
    def shape(self) -> tuple[int, int]:
        """Number of patches along rows and columns."""
        return self._layout.shape

    def __len__(self) -> int:
        """Return the number of patches, finished or not."""
        return len(self._layout)

    def __iter__(self) -> Generator[Patch, None, None]:
        """Form the patches that are not finished, and yield each of them.

        If the whole then misses its tolerance, its worst blocks of patches are formed again.

        Raises
        ------
        ToleranceError
            If the whole misses its tolerance, and `on_miss` is "raise". The store is complete.
        OSError
            If the store cannot be written, for example on a full disk. Finished patches remain.
        ValueError
            If patches cannot be imaged; a note of the error names them.

        Warns
        -----
        ClsasWarning
            At the end, if the whole missed its tolerance, or errors of patches could not be
            measured.
        """
        survey = GrowingSurvey(self._visibility, self._growth, self._store, self._inputs)
        layout, finished, blocks = self._layout, self.finished, Layout(self.grid, self._block_shape)
        # Patches to form, with the records of those images that missed the tolerance
        todo: dict[PatchIndex, Record | None] = dict.fromkeys(
            index for index in layout.indices() if index not in finished
        )
        records = dict(finished)  # of all patches that were formed, with or without a store
        misses: list[str] = []  # of the whole
        checked = survey.channels  # number of channels when all patches were last checked
        executor: Executor
        if self._client is not None:  # a cluster returns only records
            executor, most_running = self._client.get_executor(pure=False), _MOST_ON_CLUSTER
        else:
            # One more than there are threads, since finished blocks stay in memory until taken.
            workers = max(min(len(self._devices), len(blocks)), 1)
            executor, most_running = device_threads(workers, self._devices), workers + 1
        running: dict[Future, list[PatchIndex]] = {}
        try:
            ready = self._in_blocks(survey.ready(layout, todo))
            while True:
                while ready and len(running) < most_running:
                    number, wanted = ready.popleft()
                    missed = _worst_of(map(todo.pop, wanted))
                    grid, _, _, rows, columns = blocks.window(number)
                    block = Block(grid, rows, columns, self.patch_shape, wanted)
                    source = survey.visibility if self._client is None else survey.for_workers()
                    with uninterrupted():
                        running[executor.submit(self._form, block, source, missed)] = wanted
                if not running and not todo and survey.has_ended:
                    certificate = MosaicCertificate.of(records)
                    todo = self._worst(certificate, records)
                    if certificate is None or not todo:
                        if self._complete is not None:
                            self._complete()
                        self._report(certificate, records, misses)
                        return
                    misses = misses or [certificate.describe()]
                    ready = self._in_blocks(survey.ready(layout, todo))
                    continue
                timeout_s = None if survey.has_ended and running else POLL_S
                done = wait(running or [Future()], timeout_s)
                latest = [i for future, wanted in running.items() if future in done for i in wanted]
                for future in [future for future in running if future in done]:
                    with uninterrupted():
                        formed = dict(zip(running.pop(future), future.result(), strict=True))
                        latest_records = {index: record for index, (record, _) in formed.items()}
                        records |= latest_records
                        if self._store is not None:
                            finished |= latest_records
                    for index, (record, image) in formed.items():
                        yield self._patch(index, record, image)

                # A patch that is running is checked when it is finished.
                has_news = survey.update()
                busy = set(chain.from_iterable(running.values()))
                outdated = [
                    index
                    for index in (records if survey.channels > checked else latest)
                    if index not in todo
                    and index not in busy
                    and _is_outdated(records[index], layout, index, survey.visibility)
                ]
                checked = survey.channels
                if has_news or outdated:
                    todo |= dict.fromkeys(outdated)
                    ready = self._in_blocks(survey.ready(layout, todo))
        finally:
            # If the caller stops early, patches that have been started are still completed.
            with uninterrupted():
                begun = {future for future in running if not future.cancel()}
            # Wait for blocks that this process's threads have begun. A cluster may be gone by now.
            left = begun if self._client is None else set()
            while left:
                left = left - wait(left)
            with uninterrupted():
                executor.shutdown(wait=self._client is None)
                if self._client is None and self._store is not None:
                    for future in begun:
                        if future.exception() is None:
                            results = zip(running[future], future.result(), strict=True)
                            finished |= {index: record for index, (record, _) in results}

    def _in_blocks(
        self, indices: Iterable[PatchIndex]
    ) -> deque[tuple[PatchIndex, list[PatchIndex]]]:
        """Return patches by the block that contains them, row by row."""
        return deque(self._layout.grouped(indices, self._block_shape).items())

    def _worst(
        self, certificate: MosaicCertificate | None, records: dict[PatchIndex, Record]
    ) -> dict[PatchIndex, Record | None]:
        """Return the patches to form again so that the whole meets its tolerance, worst first.

        They are those of as few blocks as can suffice, if nothing of their errors is left.
        """
        worst: dict[PatchIndex, Record | None] = {}
        if certificate is None or self._tolerance_db is None or self._on_miss != "refine":
            return worst
        if certificate.whole.verdict(self._tolerance_db) != "missed":
            return worst
        allowed = power(self._tolerance_db)
        whole = certificate.whole.of_pixels * certificate.whole.power
        left = whole * (certificate.whole.error - allowed)
        blocks = []
        for _, indices in self._in_blocks(certificate.patches):
            error, improved = 0.0, {}
            for index in indices:
                record, each = records[index], certificate.patches[index]
                is_best = record.is_exact and record.misses
                if each.error > allowed and not is_best:
                    error += record.share * each.of_pixels * each.power * each.error
                    improved[index] = record
            blocks.append((error, improved))
        for error, improved in sorted(blocks, key=lambda block: block[0], reverse=True):
            if left > 0:
                worst |= improved
                left -= error
        return worst

    def _report(
        self,
        certificate: MosaicCertificate | None,
        records: dict[PatchIndex, Record],
        misses: list[str],
    ) -> None:
        """Report errors that are not known, and a tolerance that is or was missed."""
        unmeasured = [each.unmeasured for each in records.values() if each.unmeasured]
        if unmeasured:
            validate.warn(
                f"the error of {len(unmeasured)} of {len(records)} patches is not known: "
                f"{unmeasured[0]}"
            )
        if certificate is not None and self._tolerance_db is not None:
            again = sum(bool(record.misses) for record in records.values())
            how = f"{again} of {len(records)} patches"
            report(certificate, self._tolerance_db, self._on_miss, misses, how)

    def image(self, tell: Callable[[Patch], object] | None = None) -> Image:
        """Form the patches that are not finished, and return the whole image.

        Finished patches are read from the store. Patches from which no channel receives are zero.

        Parameters
        ----------
        tell : callable, optional
            Called with every patch once its pixels are in the image: first with those of the store,
            then with the others as they are finished. If a patch is formed again, the function is
            called with it again.

        Returns
        -------
        Image
            Image on all of `grid`. It takes 8 bytes of memory per pixel, in addition to the memory
            of the blocks that are being formed. `Image.formed` is None if patches were read from
            the store, whose `Record` says how each was formed.

        Raises
        ------
        OSError
            If the store cannot be read or written. Finished patches remain.
        ValueError
            If the image does not fit into the memory of this machine, or a patch cannot be imaged;
            the message names the patch.
        ToleranceError
            If the image misses its tolerance, and `on_miss` is "raise".
        """
        validate.function("tell", tell)
        validate.memory("the mosaic", 8 * self.grid.size)
        stored = [self._patch(index, record, None) for index, record in self.finished.items()]
        pixels: NDArray[np.complex64] | None = None
        formed: dict[PatchIndex, Formed | None] = {}
        records: dict[PatchIndex, Record] = {}
        for patch in chain(stored, self):
            image = patch.image
            records[patch.row, patch.column] = patch.record
            if patch.record.has_pixels:
                formed[patch.row, patch.column] = image.formed
            if image.pixels.shape == self.grid.shape:
                whole = image  # copying the pixels can take as long as forming the image
            else:
                if pixels is None:
                    pixels = np.empty(self.grid.shape, np.complex64)
                pixels[patch.rows, patch.columns] = image.pixels
            if tell is not None:
                tell(patch)
        if pixels is None:
            return whole
        known = [each for each in formed.values() if each is not None]
        if not known or len(known) < len(formed):
            return Image(pixels, self.grid)
        errors_db = [each.predicted_error_db for each in known]
        certificate = MosaicCertificate.of(records)
        how = Formed(
            method="mosaic",
            tolerance_db=known[0].tolerance_db,
            plan=f"{reprs.by(self.shape)} patches of {reprs.by(self.patch_shape)} pixels",
            predicted_error_db=max((e for e in errors_db if e is not None), default=None),
            beam=self._visibility.beam,
            left_out=tuple(dict.fromkeys(e for each in known for e in each.left_out)),
            device=", ".join(dict.fromkeys(each.device for each in known)),
            version=__version__,
            lines_digest=digest(sorted({each.lines_digest for each in known})),
            certificate=None if certificate is None else certificate.of_all,
            misses=_misses(records),
        )
        return Image(pixels, self.grid, how)

    @property
    def _layout(self) -> Layout:
        return Layout(self.grid, self.patch_shape)

    def _patch(self, index: PatchIndex, record: Record, formed: Image | None) -> Patch:
        grid, row, column, rows, columns = self._layout.window(index)
        return Patch(row, column, rows, columns, grid, record, formed, self._store)


def _worst_of(records: Iterable[Record | None]) -> Record | None:
    """Return the record of the image that missed its tolerance by most, or None without any."""
    known = [(each.certificate.error, each) for each in records if each and each.certificate]
    return max(known, key=lambda pair: pair[0])[1] if known else None


def _is_outdated(
    record: Record, layout: Layout, index: PatchIndex, visibility: SurveyVisibility
) -> bool:
    """Return whether channels that were added to the survey change the image of a patch."""
    before = record.survey_channels
    return before < visibility.survey.channels and visibility.differs_since(
        before, record.channels, layout.window(index).grid
    )


def _misses(records: dict[PatchIndex, Record]) -> tuple[str, ...]:
    """Return what former images missed their tolerance by, once for all patches of a block."""
    first = {miss: index for index, record in reversed(records.items()) for miss in record.misses}
    return tuple(f"patch {row},{column}: {miss}" for miss, (row, column) in first.items())


@dataclass(frozen=True, eq=False)
class Patch:
    """A finished patch of a mosaic.

    Attributes
    ----------
    row, column : int
        Index of the patch.
    rows, columns : slice
        Pixels of the mosaic's grid that belong to the patch.
    grid : Grid
        Grid of these pixels.
    record : Record
        How the patch was formed: errors, seconds, plan, gaps.
    """

    row: int
    column: int
    rows: slice
    columns: slice
    grid: Grid
    record: Record
    _formed: Image | None
    _store: Store | None

    def __repr__(self) -> str:
        """Return the patch's index, size and extents."""
        return reprs.summary(
            self,
            f"row {self.row}",
            f"column {self.column}",
            f"{reprs.by(self.grid.shape)} pixels",
            reprs.extents(*self.grid.bounds_m),
        )

    @property
    def image(self) -> Image:
        """Image of the patch. It is read from the store if another process formed it.

        Raises
        ------
        ValueError
            If the patch in the store is damaged.
        OSError
            If the store cannot be read.
        """
        if self._formed is not None:
            return self._formed
        if self._store is None:
            raise RuntimeError("the patch has neither pixels nor a store to read them from")
        return Image(self._store.read(self.rows, self.columns), self.grid)


def form_block(
    request: dict[str, Any],
    memory_bytes: int,
    store: Store | None,
    certificate: bool | None,
    block: Block,
    source: PatchSource,
    missed: Record | None,
) -> list[tuple[Record, Image | None]]:
    """Form a block, write its wanted patches to the store, and return them.

    If its image missed the tolerance, as the record of a patch says, it is formed by a better plan,
    and the next time exactly.

    With a client, the arguments are pickled with every block: one of `REQUESTS` with its value, and
    no samples. A worker process returns no images: the main process reads them from the store. If
    the block cannot be imaged, a note of the ValueError names its patches.
    """
    in_process = isinstance(source, SurveyVisibility)
    try:
        if isinstance(source, SurveyVisibility):
            device, visibility = thread_device(), source
        else:
            device = process_device()
            visibility = opened_visibility(*source)
        record, image, missing = _image(
            request, memory_bytes, certificate, visibility, block.grid, device, missed
        )
    except ValueError as error:
        error.add_note(str(block))
        raise

    patches, size = [], 0
    for window, inside in block.patches():
        visible, pixels = visibility.channels(window.grid), image.pixels[inside]
        if missing[visible].all():  # no channel receives from here
            pixels = np.zeros(pixels.shape, np.complex64)
        counted = pixels.size if holds_any(pixels) or not record.has_pixels else 0
        patches.append((window, pixels, visible, counted))
        size += counted
    found: list[tuple[Record, Image | None]] = []
    for window, pixels, visible, counted in patches:
        if (window.row, window.column) not in block.wanted:
            continue
        own = _record_of_patch(record, counted / max(size, 1), visibility, visible, missing)
        if store is not None:
            store.write(*window[1:], pixels, own)
        formed = image.formed if own.has_pixels else None
        found.append((own, Image(pixels, window.grid, formed) if in_process else None))
    return found


def _record_of_patch(
    record: Record,
    share: float,
    visibility: SurveyVisibility,
    visible: NDArray[np.bool_],
    missing: NDArray[np.bool_],
) -> Record:
    """Return the record of a patch that has a share of its block, from that of the block.

    `visible` and `missing` are the channels of the survey that may contribute to the patch, and
    those without samples.
    """
    lost = missing[visible]
    of_patch: dict[str, Any] = {
        "channels": len(lost),
        "missing_channels": int(np.count_nonzero(lost)),
        "gap_m": largest_gap_m(visibility.phase_centres_m[visible], lost),
        "share": share,
    }
    if not share:
        names = ("survey_channels", "device", "driver")
        return Record(**of_patch, **{name: getattr(record, name) for name in names})
    times = ("predicted_seconds", "plan_seconds", "read_seconds", "seconds")
    of_patch |= {name: share * getattr(record, name) for name in times}
    return replace(record, **of_patch)


def _image(
    request: dict[str, Any],
    memory_bytes: int,
    certificate: bool | None,
    visibility: SurveyVisibility,
    grid: Grid,
    device: Device,
    missed: Record | None,
) -> tuple[Record, Image, NDArray[np.bool_]]:
    """Return how a block was formed, its image, and which channels of the survey lack samples."""
    start = time.perf_counter()
    survey, visible = visibility.survey, visibility.channels(grid)
    missing = np.zeros(survey.channels, bool)
    fields: dict[str, Any] = {
        "channels": int(np.count_nonzero(visible)),
        "survey_channels": survey.channels,
        "device": device.info.label,
        "driver": device.info.driver,
    }

    def empty() -> tuple[Record, Image, NDArray[np.bool_]]:
        pixels: NDArray[np.complex64] = np.zeros(grid.shape, np.complex64)
        record = Record(**fields, seconds=time.perf_counter() - start)
        return record, Image(pixels, grid), missing

    if not visible.any():
        return empty()
    lines, lost = survey.read(visible, *visibility.ranges_m(grid))
    missing[visible] = lost
    fields["read_seconds"] = time.perf_counter() - start
    if lost.all():
        return empty()
    beam = visibility.beam
    if beam is not None and visibility.along is not None:
        beam = replace(beam, along=visibility.along[visible][~lost])
    if lost.any():
        lines = lines.select(~lost)
    if not reaches(lines, grid, beam, None if beam is None else beam.along):
        return empty()

    tolerance_db, began = requested_db(request), time.perf_counter()
    if missed is not None:
        assert missed.certificate is not None
        assert tolerance_db is not None
        found = describe_miss(missed.predicted_error_db, missed.certificate)
        fields["misses"] = (*missed.misses, found)
        better_db = tightened_db(missed.certificate, tolerance_db)
        name = "accuracy_db" if missed.misses or missed.is_exact else "tolerance_db"
        request = {name: max(better_db, BEST_ACCURACY_DB)}
        certificate = True
    image, how = _formed(request, memory_bytes, lines, grid, beam, device)
    seconds = time.perf_counter() - began
    fields |= how | {"has_pixels": holds_any(image.pixels)}
    is_in_db = not request.keys() & {"stages", "tolerance_wavelengths"}
    if is_wanted(certificate, seconds, by_default=is_in_db):
        fields["certificate"], fields["unmeasured"] = measured_or_reason(
            image, lines, device, seconds, tolerance_db
        )
    if (scale := scale_to_all(beam, lines.channels, survey.channels)) != 1:
        image = replace(image, pixels=scale * image.pixels)
        fields["certificate"] = scaled(fields.get("certificate"), float(scale))
    record = Record(**fields, seconds=time.perf_counter() - start)
    assert image.formed is not None
    formed = replace(
        image.formed,
        tolerance_db=tolerance_db,
        certificate=record.certificate,
        misses=record.misses,
    )
    return record, replace(image, formed=formed), missing


def _formed(
    request: dict[str, Any],
    memory_bytes: int,
    lines: RangeLines,
    grid: Grid,
    beam: BeamWindow | None,
    device: Device,
) -> tuple[Image, dict[str, Any]]:
    """Return the image of some lines, and the fields of its record that describe the method."""
    block_bytes = _host_bytes(lines.channels, lines.length, grid.size)
    if block_bytes >= memory_bytes:
        raise ArgumentError(
            "memory_bytes",
            f"be more than {block_bytes / 2**20:.1f} MiB for {grid.shape[0]} x {grid.shape[1]} "
            f"pixels from {lines.channels} lines of {lines.length} samples",
            f"{memory_bytes / 2**20:.1f} MiB",
            "raise it or use smaller patches",
        )
    accuracy_db = None
    if "accuracy_db" in request or is_soon_done(lines, grid, device):
        accuracy_db = requested_db(request)  # None for `stages`
    if accuracy_db is not None:
        scene = Scene.of(lines, grid, beam, accuracy_db)
        scene.warn("accuracy_db", accuracy_db, doubts=False)
        # The record reports if the patch is zero.
        imager = SceneImager(scene, ExactImage(accuracy_db), device, warned=True, keep=False)
        assert imager.decision is not None
        error_db = max(accuracy_db, imager.decision.error_db(scene))
        how = {"predicted_error_db": error_db, "memory_bytes": block_bytes}
        return imager.form(lines), how

    before = time.perf_counter()
    available = min(memory_bytes - block_bytes, device.info.usable_bytes)
    asked = Request(lines, grid, **request, beam=beam, memory_bytes=available)
    scene, chosen, track = planned(asked, device, doubts=False)
    # The beam's directions would be most of a record.
    beam = None if chosen.beam is None else replace(chosen.beam, along=None)
    how = {
        "plan_seconds": time.perf_counter() - before,
        "predicted_error_db": chosen.predicted_error_db,
        "predicted_seconds": chosen.predicted_seconds,
        "memory_bytes": block_bytes + int(chosen.memory_bytes),
        "plan": json.loads(replace(chosen, beam=beam).to_json()),
    }
    return form(scene, chosen, device, track=track, warned=True), how


def _host_bytes(channels: int, length: int, pixels: int) -> int:
    """Return the bytes for the lines and pixels of a block, each with one working copy."""
    return 2 * 8 * (channels * length + pixels)
