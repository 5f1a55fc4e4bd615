"""Mosaics: images of any size, formed patch by patch on one or several devices or machines.

Every patch is planned and imaged by itself, from the channels and samples that it needs. A patch in
a store (`clsas.mosaics.store`) is finished once it has a record, which is written after its pixels.
If a mosaic is interrupted, the next run forms only the patches that are not finished.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import reprs, validate
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.coverage import warn_unreached
from clsas.engine.data.digests import digest
from clsas.engine.data.georeference import placed
from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Formed, Image
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.validate import ArgumentError
from clsas.engine.data.version import __version__
from clsas.engine.device.device import Device
from clsas.engine.signal.doubts import warn_before_imaging
from clsas.mosaics.arguments import (
    FOLLOW,
    beam_of_mosaic,
    check_client,
    checked_growth,
    checked_request,
    warn_of_window,
)
from clsas.mosaics.devices import open_devices
from clsas.mosaics.forming import Job
from clsas.mosaics.patches import Layout, choose_patch_shape, patch_shape_of
from clsas.mosaics.provenance import inputs_of
from clsas.mosaics.record import PatchIndex, Record
from clsas.mosaics.scheduling import Run, form_patches, wait_for_first_file
from clsas.mosaics.store import Store
from clsas.mosaics.survey import open_survey, warn_of_order
from clsas.mosaics.visibility import SurveyVisibility

if TYPE_CHECKING:
    from distributed import Client

MEMORY_BYTES = 1 << 30
"""Default memory of one patch: a plain choice, which suits laptops and small GPUs."""


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


@dataclass(frozen=True, eq=False)
class Mosaic:
    """An image of any size, to be formed patch by patch or, with `image`, as a whole.

    Iterating over the mosaic yields every `Patch` as soon as it is finished. A second iteration
    forms only the patches that the store lacks.

    A mosaic can be pickled, together with its lines unless they are in files. The process that
    unpickles it opens devices of the same names. A mosaic with a client cannot be pickled, since
    the connection belongs to this process.

    Attributes
    ----------
    grid : Grid
        Grid of the whole mosaic.
    patch_shape : (rows, columns)
        Number of pixels of a patch; the last patches along each axis may be smaller.
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
    _run: Run

    def __getstate__(self) -> dict[str, Any]:
        """Return the fields to pickle; the process that unpickles them opens the devices again.

        Raises
        ------
        TypeError
            If the mosaic has a client, whose connection belongs to this process.
        """
        if self._run.client is not None:
            raise TypeError(
                "a mosaic with a client cannot be pickled, since the connection belongs to this "
                "process: call `clsas.mosaic` where it is needed, with the same source and store"
            )
        return self.__dict__

    def __repr__(self) -> str:
        """Return the number of patches and of finished ones, the store and the extents."""
        store = self._run.job.store
        return reprs.summary(
            self,
            f"{reprs.by(self.shape)} patches of {reprs.by(self.patch_shape)} pixels",
            f"{len(self.finished)} of {len(self)} finished",
            None if store is None else f"store {str(store)!r}",
            reprs.extents(*self.grid.bounds_m),
        )

    @property
    def shape(self) -> tuple[int, int]:
        """Number of patches along rows and columns."""
        return self._run.layout.shape

    def __len__(self) -> int:
        """Return the number of patches, finished or not."""
        return len(self._run.layout)

    def __iter__(self) -> Iterator[Patch]:
        """Form the patches that are not finished, and yield each of them.

        Raises
        ------
        OSError
            If the store cannot be written, for example on a full disk. Finished patches remain.
        ValueError
            If a patch cannot be imaged; the message names the patch.
        """
        with closing(form_patches(self._run, self.finished)) as forming:
            for index, record, image in forming:
                yield self._patch(index, record, image)

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
            of the patches that are being formed. `Image.formed` is None if patches were read from
            the store, whose `Record` says how each was formed.

        Raises
        ------
        OSError
            If the store cannot be read or written. Finished patches remain.
        ValueError
            If the image does not fit into the memory of this machine, or a patch cannot be imaged;
            the message names the patch.
        """
        validate.function("tell", tell)
        validate.memory("the mosaic", 8 * self.grid.size)
        stored = [self._patch(index, record, None) for index, record in self.finished.items()]
        pixels: NDArray[np.complex64] | None = None
        formed: dict[PatchIndex, Formed | None] = {}
        for patch in chain(stored, self):
            image = patch.image
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
        return Image(pixels, self.grid, self._formed(known))

    def _formed(self, patches: Sequence[Formed]) -> Formed:
        """Return how the whole image was formed, from patches with pixels."""
        errors_db = [each.predicted_error_db for each in patches]
        return Formed(
            method="mosaic",
            tolerance_db=patches[0].tolerance_db,
            plan=f"{reprs.by(self.shape)} patches of {reprs.by(self.patch_shape)} pixels",
            predicted_error_db=max((e for e in errors_db if e is not None), default=None),
            beam=self._run.job.beam,
            left_out=tuple(dict.fromkeys(e for each in patches for e in each.left_out)),
            device=", ".join(dict.fromkeys(each.device for each in patches)),
            version=__version__,
            lines_digest=digest(sorted(each.lines_digest for each in patches)),
        )

    def _patch(self, index: PatchIndex, record: Record, formed: Image | None) -> Patch:
        grid, row, column, rows, columns = self._run.layout.window(index)
        return Patch(row, column, rows, columns, grid, record, formed, self._run.job.opened_store())


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
    follow_s: Annotated[float | None, FOLLOW] = None,
) -> Mosaic:
    """Return a mosaic, an image of any size that is formed patch by patch.

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
        Accuracy of exact backprojection of every patch, see `clsas.backproject`.
    beam : BeamWindow, optional
        Weights of the channels. If the beam's direction follows the track, it is computed from the
        whole track, not only from the part near a patch. In a store that may grow, since its
        folder contains no file named `end`, `track_pings` is 101 by default.
    patches : (rows, columns), optional
        Number of patches along both axes; the last ones may be smaller. By default patches are as
        large as memory allows, up to 4096 x 4096 pixels.
    memory_bytes : int, optional
        Memory of one patch, on host and device together; 1 GiB by default. Exact backprojection
        needs the device's buffers in addition, of up to 1024 upsampled lines.
    device : Device, str or int, or a sequence of them, optional
        Devices that work side by side. By default all GPUs if there are several, else the device
        that `choose` returns. Must be left out with a `client`, each of whose
        workers takes a device of its machine.
    client : distributed.Client, optional
        Client of a Dask cluster whose workers form the patches. They must be able to open `source`
        and `store` under the same paths.
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
    Patches are formed independently of each other. The error of each patch against the exact image
    stays within the tolerance, and so does the difference of neighbours along their border.

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
    request = checked_request(tolerance_db, tolerance_wavelengths, stages, accuracy_db)
    if beam is not None:
        validate.instance("beam", beam, BeamWindow)
    patch_shape = None if patches is None else patch_shape_of(patches, grid)
    if memory_bytes is None:
        memory_bytes = MEMORY_BYTES
    memory_bytes = validate.count("memory_bytes", memory_bytes)
    if not isinstance(source, RangeLines):
        source = validate.path("source", source)
    if client is not None:
        check_client(client, source, store, device)
    growth = checked_growth(source, follow_s)
    opened = None if store is None else Store.at(validate.path("store", store))
    given, place = beam, None if opened is None else opened.path
    beam = beam_of_mosaic(beam, source, place, grows=growth is not None)
    devices = () if client is not None else open_devices(device)
    if growth is not None:
        wait_for_first_file(growth)
    survey = open_survey(source if isinstance(source, RangeLines) else source.resolve())
    grid = placed(survey.geometry, grid)
    visibility = SurveyVisibility.of(survey, beam)
    if growth is None:
        lines = source if isinstance(source, RangeLines) else survey.geometry
        warn_before_imaging(lines, grid, beam, last_range_m=survey.last_range_m)
        if beam is not None and beam.along is None:
            warn_of_order(survey)
    if growth is None and not visibility.channels(grid).any():
        warn_unreached(survey.geometry, grid, beam, visibility.along, survey.span_m)
    if given is not None and given is not beam:
        warn = partial(warn_of_window, given, request=request)
        if growth is None:
            warn(survey.geometry)
        else:
            growth = replace(growth, at_end=warn)
    inputs = {} if opened is None else inputs_of(survey, grid, request, beam)
    stored = None if opened is None else opened.patch_shape
    if patch_shape is None:
        patch_shape = stored or choose_patch_shape(visibility, grid, memory_bytes)
    layout = Layout(grid, patch_shape)
    job = Job(
        files=(),
        local=None,
        request=request,
        beam=beam,
        memory_bytes=memory_bytes,
        store=None if opened is None else opened.path,
    )
    finished: dict[PatchIndex, Record] = {}
    if opened is not None:
        opened.begin(inputs, grid, patch_shape)
        finished = _still_finished(opened, visibility, layout)
    run = Run(layout, job, inputs, visibility, devices, client, growth)
    return Mosaic(grid, patch_shape, finished, run)


def _still_finished(
    store: Store, visibility: SurveyVisibility, layout: Layout
) -> dict[PatchIndex, Record]:
    """Return the records of intact patches to which no channel added since then contributes."""
    return {
        index: record
        for index, record in store.undamaged_records().items()
        if not visibility.any_channel_from(record.survey_channels, layout.window(index).grid)
    }
