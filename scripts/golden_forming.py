"""Forms the scenes of `scripts/golden` and records what is compared.

Three things that users cannot reach are needed here: costs that do not depend on the machine
(`write_costs`), plans that do not depend on its vectors (`STANDARD`), and errors that are measured
on request only, whatever an image takes. `FIELDS` says where plans have their fields. A change of
the package that moves any of these changes these four, and nothing else of the script.
"""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import json
import math
import os
import warnings
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import golden_scenes
import numpy as np
from golden_scenes import EXACT, FACTORIZED, OTHERS, Scene
from numpy.typing import ArrayLike, NDArray

import clsas

with suppress(ImportError):  # earlier versions measure no errors
    from clsas.engine import promise

    promise.LEAST_SECONDS = math.inf

STANDARD = {
    "kind": "cpu",
    "width": 8,
    "stage_width": 8,
    "permute": True,
    "memory_bytes": 8 << 30,
    "max_buffer_bytes": 2 << 30,
}
"""Properties of the device for which plans are made, whatever the device is: a CPU with AVX2."""

COSTS_NS = {
    "call": 9e6, "upsampled_sample": 20.0, "filtered_sample": 1.8, "reference": 120.0,
    "batch": 8e5, "subimage": 1450.0, "line": 24.0, "sample": 0.05, "sample_tap": 0.0235,
    "single_sample": 0.2, "given_sample": 0.01, "leaf_channel": 5.0, "leaf": 0.7,
    "leaf_point": 1.5, "leaf_gathered": 0.85, "group": 230.0, "part": 50.0, "pixel": 0.57,
    "point": 1.7, "beam": 0.4,
}  # fmt: skip
"""Costs of a device with 2 AVX2 cores. Any numbers would do."""
_SLOW = 1e6  # cost of exact images with which small images are factorized
_MEASURED = "2000-01-01T00:00:00+00:00"  # by which plans show that they use these costs

FIELDS = {
    "tolerance_db": "tolerance_db",
    "left_out": "left_out",
    "kind": "method.kind",
    "reason": "method.reason",
    "accuracy_db": "method.accuracy_db",
    "sides": "method.sides",
    "tile": "method.tile",
    "shape": "method.aperture.shape",
    "aperture_method": "method.aperture.method",
    "aperture_taps": "method.aperture.filter.taps",
    "aperture_upsampling": "method.aperture.filter.upsampling",
    "aperture_coefficients": "method.aperture.filter.coefficients",
    "aperture_error_db": "method.aperture.filter.error_db",
    "aperture_scatter_db": "method.aperture.filter.scatter_db",
    "aperture_oversampling": "method.aperture.oversampling",
    "aperture_beam_cycles": "method.aperture.beam_cycles",
    "aperture_band": "method.aperture.band",
    "nearest_factors": "method.aperture.factors",
    "align_taps": "method.align.taps",
    "align_upsampling": "method.align.upsampling",
    "align_coefficients": "method.align.coefficients",
    "align_error_db": "method.align.error_db",
    "align_scatter_db": "method.align.scatter_db",
    "final_taps": "method.final.taps",
    "final_upsampling": "method.final.upsampling",
    "final_coefficients": "method.final.coefficients",
    "final_error_db": "method.final.error_db",
    "final_scatter_db": "method.final.scatter_db",
    "resampling_lead": "method.resampling.lead",
    "resampling_period": "method.resampling.period",
    "resampling_upsampled_period": "method.resampling.upsampled_period",
    "resampling_shift": "method.resampling.shift",
    "resampling_first": "method.resampling.first",
    "resampling_length": "method.resampling.length",
    "upsampler": "method.upsampler",
    "upsampler_step": "method.upsampler.step",
    "upsampler_coefficients": "method.upsampler.coefficients",
    "upsampler_error_db": "method.upsampler.error_db",
    "half_precision": "method.half_precision",
    "half_lengths": "method.half_lengths",
    "most_channels": "method.most_channels",
    "highest_cycles_per_m": "method.highest_cycles_per_m",
    "closest_m": "method.closest_m",
    "limits": "method.limits",
    "roots_at_once": "method.roots_at_once",
    "roots_prepared": "method.roots_prepared",
    "phase_terms": "method.phase_terms",
    "stretch": "method.stretch",
}
"""Where a plan's JSON has the fields by which an image is formed, by names of this script.

If a field moves, write "new.place|old.place", so that `--against` reads the plans of both versions.
"""

_CHOICES = (
    "kind", "reason", "accuracy_db", "left_out", "sides", "tile", "shape", "aperture_taps",
    "aperture_upsampling", "aperture_oversampling", "nearest_factors", "align_taps",
    "align_upsampling", "final_taps", "final_upsampling", "upsampler_step", "half_precision",
    "half_lengths", "most_channels", "roots_at_once", "roots_prepared", "phase_terms", "limits",
)  # fmt: skip
"""Fields of plans that are compared. The others follow from them."""

_LEAST_DB = -120.0  # contributions to a predicted error below this are not recorded


class Former:
    """Forms scenes, and collects what is compared.

    Parameters
    ----------
    folder : Path
        Private folder for the costs.
    plans : mapping
        Explicit plans by scene, each a mapping of `FIELDS`.
    standard : bool
        True to plan for the device that all machines share, instead of the one of this machine.

    Attributes
    ----------
    values : dict
        What is compared, by names of the form "scene/image/what".
    arrays : dict
        Images and other results, by "scene/image".
    plans : dict
        Explicit plans of the formed scenes: those given, or else the scenes' own plans.
    """

    def __init__(self, folder: Path, plans: Mapping[str, Any], *, standard: bool) -> None:
        self.values: dict[str, Any] = {}
        self.arrays: dict[str, NDArray] = {}
        self.plans: dict[str, dict[str, Any]] = {}
        self._given = plans
        self._folder, self._scene = folder, ""
        one = golden_scenes.short(tx_m=golden_scenes.TRACK[:1])
        with clsas.Imager(one.lines, one.grid, accuracy_db=-40) as imager:
            self._device = imager.device
        if standard:
            info = dataclasses.replace(self._device.info, **STANDARD)
            self._device = dataclasses.replace(self._device, info=info)

    def form(self, name: str) -> None:
        """Form a scene."""
        self._scene = name
        slow = 1.0 if name.startswith("usual costs") else _SLOW
        write_costs(self._folder, [*clsas.list_devices(), self._device.info], slow)
        if name in EXACT:
            self._form_exact(EXACT[name]())
        elif name in FACTORIZED:
            scene, arguments = FACTORIZED[name]
            self._form_by_plans(scene(), arguments)
        else:
            with self._warnings(""):
                OTHERS[name](self)

    def _form_exact(self, scene: Scene) -> None:
        """Form exact images with given taps, and with a given accuracy."""
        lines, grid, beam = scene.lines, scene.grid, scene.beam
        for taps, upsampling in ((4, 2.0), (6, 3.0)):  # about -55 dB, and as far as rounding allows
            name = f"{taps} taps"
            with self._warnings(f"{name}/"):
                image = clsas.backproject(lines, grid, taps=taps, upsampling=upsampling, beam=beam)
            self.image(name, image, scene)
        for accuracy_db in (-35, -75):
            name = f"{accuracy_db} dB"
            with self._warnings(f"{name}/"):
                image = clsas.backproject(lines, grid, accuracy_db=accuracy_db, beam=beam)
            self.image(name, image, scene, within_db=accuracy_db)

    def _form_by_plans(self, scene: Scene, arguments: Mapping[str, Any]) -> None:
        """Form an image by the plan of now, and one by the plan that was recorded."""
        lines, grid = scene.lines, scene.grid
        with self._warnings("planned/"):
            plan = clsas.plan(lines, grid, beam=scene.beam, device=self._device, **arguments)
            image = clsas.factorize(lines, grid, plan)
        within_db = arguments["tolerance_db"] if plan.is_exact else None
        self.image("planned", image, scene, within_db=within_db)
        self._add_plan(plan)
        if plan.is_exact or "stages" in arguments:
            return
        fields = self._given.get(self._scene) or fields_of(plan)
        self.plans[self._scene] = fields
        with self._warnings("explicit plan/"):
            image = clsas.factorize(lines, grid, with_fields(plan, fields))
        self.image("explicit plan", image, scene)

    def _add_plan(self, plan: clsas.Plan) -> None:
        """Record the choices and predictions of a plan."""
        if plan.prediction.costs_measured != _MEASURED:
            raise SystemExit("golden: plans ignore the given costs: adapt `write_costs`")
        fields = fields_of(plan)
        for name in _CHOICES:
            if fields.get(name) is not None:
                self._set(f"planned/plan/{name}", fields[name])
        stages = [
            [each.rows, each.columns, each.subimages, each.channels, each.samples]
            for each in plan.stages
        ]
        self._set("planned/plan/stages", stages)
        self._set("planned/plan/memory_bytes", plan.memory_bytes)
        self._set("planned/predicted_db", round(plan.predicted_error_db, 4))
        self._set("planned/predicted_ms", float(f"{1e3 * plan.predicted_seconds:.6g}"))
        self._set("planned/predicted_exact_ms", float(f"{1e3 * plan.exact_seconds:.6g}"))
        for cause, power in vars(plan.errors).items():
            if power > 10 ** (_LEAST_DB / 10):
                self._set(f"planned/predicted/{cause}_db", round(10 * math.log10(power), 4))

    def image(
        self,
        name: str,
        image: clsas.Image,
        of: Scene | None = None,
        *,
        within_db: float | None = None,
    ) -> None:
        """Add an image, with its error if the ideal image is known, or else its mean power.

        Parameters
        ----------
        name : str
        image : Image
        of : Scene, optional
            Scene whose ideal image it should be.
        within_db : float, optional
            Requested error, if it depends on the device how the image is formed.
        """
        self.array(name, image.pixels)
        pixels = np.asarray(image.pixels, np.complex128)
        mean = float(np.mean(np.abs(pixels) ** 2))
        if of is None or not np.any(of.ideal):
            self._set(f"{name}/mean_db", round(10 * math.log10(mean), 4) if mean else None)
            return
        error_db = round(of.error_db(image), 4)
        if within_db is None:
            self._set(f"{name}/error_db", error_db)
        else:
            self._set(f"{name}/own_error_db", error_db)
            self._set(f"{name}/within {within_db} dB", error_db <= within_db)

    def number(self, name: str, value: float) -> None:
        """Add a number that machines share to a per cent."""
        self._set(f"{name}/number", float(f"{value:.6g}"))

    def array(self, name: str, values: ArrayLike) -> None:
        """Add values that are compared bit for bit."""
        array = np.ascontiguousarray(values)
        self.arrays[f"{self._scene}/{name}"] = array
        self._set(f"{name}/bits", hashlib.sha256(array.tobytes()).hexdigest()[:16])

    def _set(self, name: str, value: Any) -> None:
        self.values[f"{self._scene}/{name}"] = json.loads(json.dumps(value))

    @contextmanager
    def _warnings(self, name: str) -> Iterator[None]:
        """Record the texts of the warnings of a block."""
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            yield
        texts = {
            str(each.message) for each in caught if issubclass(each.category, clsas.ClsasWarning)
        }
        if texts:
            self._set(f"{name}warnings", sorted(texts))


def write_costs(folder: Path, infos: list[Any], slow: float) -> None:
    """Store costs as if they had been measured on devices, which are those of `list_devices`.

    The format is that of the file of costs in the cache folder, CLSAS_CACHE.
    """
    costs = {f"{name}_ns": cost for name, cost in COSTS_NS.items()}
    costs |= {name: slow * costs[name] for name in ("pixel_ns", "point_ns")}
    table = _signed({"source": "scaled", "measured": _MEASURED, "costs": costs})
    keys = [
        f"{info.label}, {info.driver}, {info.compute_units} compute units, {info.width} lanes"
        f"{', permuting' if info.permute else ''}, clsas {clsas.__version__}"
        for info in infos
    ]
    folder.mkdir(mode=0o700, exist_ok=True)
    (folder / "costs.json").write_text(json.dumps(dict.fromkeys(keys, table)))
    os.environ["CLSAS_CACHE"] = str(folder)


def fields_of(plan: clsas.Plan) -> dict[str, Any]:
    """Return the fields of a plan by their names in `FIELDS`; coefficients as text."""
    values, found = json.loads(plan.to_json()), {}
    for name in FIELDS:
        *parents, last = _path(name, values)
        place = values
        for each in parents:
            place = place.get(each) or {}
        if last in place and not isinstance(place[last], dict):
            value = place[last]
            found[name] = _packed(value) if name.endswith("_coefficients") else value
    return found


def with_fields(plan: clsas.Plan, fields: Mapping[str, Any]) -> clsas.Plan:
    """Return a plan for the same lines and grid with other fields.

    What `FIELDS` does not name remains as it is: the beam, the predictions, and the digests of the
    geometry.
    """
    values = json.loads(plan.to_json())
    for name, value in fields.items():
        *parents, last = _path(name, values)
        place = values
        for each in parents:
            if place.get(each) is None:
                place[each] = {}
            place = place[each]
        place[last] = _unpacked(value) if name.endswith("_coefficients") else value
    if values.pop("digest", None) is not None:
        values = _signed(values)
    return clsas.Plan.from_json(json.dumps(values))


def _signed(record: dict[str, Any]) -> dict[str, Any]:
    """Return a record with its digest, as commits before and after write it."""
    digest = hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()
    return record | {"digest": digest[:16]}


def _path(name: str, values: Mapping[str, Any]) -> list[str]:
    """Return the keys of a field: of its places, the one of which a plan has the most."""

    def known(path: list[str]) -> int:
        place: Any = values
        for number, each in enumerate(path):
            if not isinstance(place, Mapping) or each not in place:
                return number
            place = place[each]
        return len(path)

    return max((each.split(".") for each in FIELDS[name].split("|")), key=known)


def _packed(values: ArrayLike) -> str:
    """Return an array as text: its shape, and float32 numbers, compressed, in base64."""
    array = np.asarray(values, "<f4")
    shape = "x".join(map(str, array.shape))
    return f"{shape} {base64.b64encode(zlib.compress(array.tobytes(), 9)).decode()}"


def _unpacked(text: str) -> Any:
    """Return the nested lists that `_packed` made into text."""
    shape, numbers = text.split()
    array = np.frombuffer(zlib.decompress(base64.b64decode(numbers)), "<f4")
    return array.reshape([int(each) for each in shape.split("x")]).astype(np.float64).tolist()
