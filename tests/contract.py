"""The imagers as one kind of thing: how each forms an image, and how accurately it must."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

from cases import along_x, bistatic, moving, oriented, points
from factorizing import EXACT_IS_SLOW, bistatic_array, changed, swaying
from scenes import kept

from clsas import backproject, factorize, mosaic, plan, wavenumber
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Image
from clsas.engine.data.lines import RangeLines
from clsas.selftest import extremes
from clsas.selftest.extremes import Known

FINE = {"taps": 8, "upsampling": 4}  # an interpolator whose own error is below -100 dB


@kept
def narrow() -> Known:
    """A straight track and a beam without edges, which every imager can form."""
    return extremes.scene(
        along_x(240, 0.06), (0.3, 42.5, 0), carrier_hz=200e3, bandwidth_hz=20e3,
        pixel_m=(0.02, 0.03), shape=(24, 24), beam=BeamWindow(16, "hann", along=[1, 0, 0]),
    )  # fmt: skip


@kept
def near() -> Known:
    """`narrow` at a shorter range: its wavenumber image takes a third of the time."""
    return extremes.scene(
        along_x(100, 0.06), (0.1, 12, 0), carrier_hz=200e3, bandwidth_hz=20e3,
        pixel_m=(0.02, 0.03), shape=(24, 24), beam=BeamWindow(16, "hann", along=[1, 0, 0]),
    )  # fmt: skip


@dataclass(frozen=True)
class Scene:
    """Lines and a grid, with the weights of channels."""

    lines: RangeLines
    grid: Grid
    beam: BeamWindow | None = None

    def with_lines(self, **changes) -> Scene:
        return dataclasses.replace(self, lines=dataclasses.replace(self.lines, **changes))


@cache
def scene(case: Callable) -> Scene:
    made = case()
    if isinstance(made, Known):
        return Scene(made.lines, made.grid, made.beam)
    return Scene(*made)


@dataclass(frozen=True)
class Imager:
    """One way to form an image.

    Attributes
    ----------
    form : callable
        Returns an image from a scene, a device and further options of this imager.
    settings : callable
        Returns the options under which all images of one scene's geometry are formed alike, so
        that they add up.
    cases : tuple of callable
        Scenes that this imager can form.
    asked_db : float
        Relative rms error asked for against the ideal image.
    same_db : float
        How far images may differ that are formed alike of equal scenes, by rounding.
    linear_db : float
        How far a sum of images may differ from the image of the sum.
    options : set of str
        Further arguments that it takes: device, progress, accumulate.
    known : callable
        Scene whose ideal image is known.
    is_quick : bool
        True if the fast tier of tests forms its images on the default device.
    """

    name: str
    form: Callable[..., Image]
    settings: Callable[[Scene], dict]
    cases: tuple[Callable, ...]
    asked_db: float
    same_db: float
    linear_db: float
    options: frozenset[str] = frozenset()
    known: Callable[[], Known] = narrow
    is_quick: bool = True


def _exactly(scene, device, **options):
    options = options if "taps" in options else {"accuracy_db": -80} | options
    return backproject(scene.lines, scene.grid, beam=scene.beam, device=device, **options)


def planned(scene, tolerance_db, half=False):
    """A plan that divides the image if that is possible, although it is small."""
    chosen = plan(
        scene.lines, scene.grid, tolerance_db=tolerance_db, beam=scene.beam, costs=EXACT_IS_SLOW
    )
    if chosen.is_exact:
        return chosen
    return changed(chosen, half_precision=half and chosen.factorization.upsampler is not None)


def _factorizer(tolerance_db, half):
    def settings(scene):
        return {"chosen": planned(scene, tolerance_db, half)}

    def form(scene, device, chosen=None, **options):
        chosen = chosen or planned(scene, tolerance_db, half)
        return factorize(scene.lines, scene.grid, chosen, device=device, **options)

    return {"form": form, "settings": settings, "asked_db": tolerance_db}


def _patchwise(scene, device, **options):
    patches = mosaic(
        scene.lines, scene.grid, beam=scene.beam, device=device, accuracy_db=-70, patches=(2, 3),
        memory_bytes=64 << 20,  # too little for more than one patch at a time
    )  # fmt: skip
    return patches.image(**options)


def _by_wavenumbers(scene, device, **options):
    return wavenumber(scene.lines, scene.grid, beam=scene.beam, **options)


IN_PARTS = frozenset({"device", "progress", "accumulate"})
IMAGERS = (
    Imager(
        "exact",
        _exactly,
        lambda scene: FINE,
        (narrow, bistatic, moving, oriented, points),
        asked_db=-80,
        same_db=-110,
        linear_db=-90,
        options=IN_PARTS,
    ),
    Imager(
        "factorized",
        **_factorizer(-60, half=False),
        cases=(narrow, bistatic_array, swaying),
        same_db=-75,
        linear_db=-85,
        options=IN_PARTS,
    ),
    Imager(
        "half precision",
        **_factorizer(-45, half=True),
        cases=(narrow,),
        same_db=-60,
        linear_db=-62,
        options=IN_PARTS,
    ),
    Imager(
        "mosaic",
        _patchwise,
        lambda scene: {},
        (narrow,),
        asked_db=-70,
        same_db=-110,
        linear_db=-67,
        options=frozenset({"device"}),
    ),
    Imager(
        "wavenumber",
        _by_wavenumbers,
        lambda scene: {},
        (narrow,),
        asked_db=-75,
        same_db=-110,
        linear_db=-80,
        is_quick=False,
    ),
    Imager(
        "wavenumber nearby",
        _by_wavenumbers,
        lambda scene: {},
        (near,),
        asked_db=-60,
        same_db=-110,
        linear_db=-80,
        known=near,
    ),
)
