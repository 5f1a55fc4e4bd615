"""Exact images step by step: the scene, the decision, the image, and the same in float64."""

from __future__ import annotations

from dataclasses import dataclass, replace

from clsas.engine.device.device import Device, open_device
from clsas.engine.exact.decide import ACCURACY_DB, Decision, decide
from clsas.engine.factorized.plan import ExactImage
from clsas.engine.factorized.sampled import SampledRoots, SampledScene
from clsas.engine.forming import SceneImager
from clsas.engine.scene import Scene
from clsas.selftest import reference


@dataclass(frozen=True, eq=False)
class Prepared:
    """An exact image that is decided and not yet formed. It has the decision's attributes, too."""

    scene: Scene
    decision: Decision
    device: Device

    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(self.decision, name)

    def but(self, **changes):
        """Return the same with another decision."""
        return replace(self, decision=replace(self.decision, **changes))

    @property
    def samples_per_m(self):
        return self.resampling.samples_per_m(self.scene.lines)

    @property
    def error_db(self):
        return self.decision.error_db(self.scene)


def prepare(
    lines, grid, *, device=None, accuracy_db=ACCURACY_DB, beam=None, full_model=False, **fixed
):
    """Return what `clsas.backproject` decides; `full_model` leaves nothing out."""
    full_model = full_model or len(fixed) == 2
    scene = Scene.of(lines, grid, beam, None if full_model else accuracy_db)
    device = open_device(device)
    return Prepared(scene, decide(scene, device, accuracy_db, **fixed), device)


def execute(prepared):
    scene, decision = prepared.scene, prepared.decision
    imager = SceneImager(scene, ExactImage(ACCURACY_DB), prepared.device, decision=decision)
    return imager.form(scene.given_lines)


def same_interpolator(prepared, points_m, **options):
    scene = prepared.scene
    return reference.same_interpolator(
        scene.lines, prepared.decision, points_m, beam=scene.beam, **options
    )


def sampled(lines, grid, beam=None, allowed_power=1.0):
    """Return the sample points of a scene of which nothing is left out."""
    found = SampledScene.of(Scene.of(lines, grid, beam, None), allowed_power)
    assert found is not None
    return SampledRoots.of(found, None if beam is None else beam.limits)
