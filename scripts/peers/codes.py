"""Codes that are compared, and the settings of each that are measured."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from peers.workers import PeerError, built, environment

FASTSAR = "fastsar==0.1.8"
TORCH = "torch==2.13.0"
_NOT_GIVEN = "--torchbp must give a checkout, since it is not on PyPI"


@dataclass(frozen=True)
class Method:
    """A code with settings that form an image.

    Attributes
    ----------
    code : str
        Name of the code.
    kind : str
        "exact" or "factorized".
    words : str
        Settings, in words.
    settings : dict
        Settings, for the program that runs the code.
    best : bool
        True if these are the code's best settings for about -50 dB, or for the least error that it
        reaches. Tables of time by size and by cores contain only these.
    """

    code: str
    kind: str
    words: str
    settings: dict
    best: bool = False


@dataclass(frozen=True)
class Code:
    """An installed code: the Python of its environment, and the program that runs it."""

    python: Path | str
    program: Path


def installed(torchbp: Path | None) -> tuple[dict[str, Code], dict[str, str]]:
    """Return the installed codes by name, and the reasons why others are missing."""
    codes, absent = {"clsas": Code(sys.executable, _program("clsas"))}, {}
    try:
        codes["FastSAR"] = Code(environment(FASTSAR, [FASTSAR]), _program("fastsar"))
    except PeerError as error:
        absent["FastSAR"] = str(error)
    try:
        if torchbp is None:
            raise PeerError(_NOT_GIVEN)
        codes["torchbp"] = Code(built(torchbp, TORCH), _program("torchbp"))
    except PeerError as error:
        absent["torchbp"] = str(error)
    return codes, absent


def _program(code: str) -> Path:
    return Path(__file__).with_name(f"with_{code}.py")


def methods(devices: list[str]) -> Iterator[Method]:
    """Yield all methods: first the exact ones of every code, then the factorized ones."""
    for device in devices:
        for level in (-50.0, -80.0):
            settings = {"device": device, "accuracy_db": level}
            yield Method("clsas", "exact", f"{device}, {level:g} dB", settings, level == -50)
    for kind, factor, best in (("linear", 8, True), ("cubic", 4, False), ("cubic", 8, False)):
        settings = {"former": "exact", "interpolator": kind, "upsampling": factor}
        words = f"{kind} on {factor}-fold lines"
        yield Method("FastSAR", "exact", words, settings, best)
    for factor in (8, 16):
        settings = {"former": "exact", "upsampling": factor}
        words = f"Cartesian, linear on {factor}-fold lines"
        yield Method("torchbp", "exact", words, settings, factor == 8)
    for device in devices:
        for level in (-50.0, -40.0):
            settings = {"device": device, "tolerance_db": level}
            yield Method("clsas", "factorized", f"{device}, {level:g} dB", settings, level == -50)
    for level in (-50.0, -40.0):
        settings = {"former": "whole", "target_db": level}
        words = f"one image, target {level:g} dB"
        yield Method("FastSAR", "factorized", words, settings, level == -50)
    settings = {"former": "mosaic", "patch": 512, "target_db": -50.0}
    yield Method("FastSAR", "factorized", "mosaic of 512 x 512, target -50 dB", settings)
    yield from _torchbp_factorized()


def _torchbp_factorized() -> Iterator[Method]:
    """Yield the best settings from a sweep over the few options of these functions.

    More stages are faster on a straight track, but lose a part of what a circular track records.
    """
    adaptive = {"former": "cfbp_adaptive", "upsampling": 8}
    deep = {"stages": 6, "merge_cost": 4.0}
    fine = {"stages": 4, "oversample_y": 1.8, "guard_y": 0.1, "interp_method": ["knab", 12, 1.8]}
    polar = {"upsampling": 4, "grid": 1.5, "lanczos": 8}
    found: dict[str, dict] = {
        "cfbp_adaptive, 6 stages, 8-fold lines": {**adaptive, **deep},
        "cfbp_adaptive, 4 stages, 1.8-fold grids, 12 taps, 16-fold lines": {
            **adaptive,
            **fine,
            "upsampling": 16,
        },
        "cfbp_adaptive, 2 stages, 4-fold grids, 8-fold lines": {
            **adaptive,
            "stages": 2,
            "oversample_y": 4.0,
        },
        "ffbp, 5 stages, whole guard bands, 4-fold lines": {
            "former": "ffbp",
            **polar,
            "stages": 5,
            "guard_max_ratio": 1.0,
        },
        "afbp, 4 subapertures, 4-fold lines": {"former": "afbp", **polar, "nsub": 4},
    }
    for number, (words, settings) in enumerate(found.items()):
        yield Method("torchbp", "factorized", words, settings, number == 0)
