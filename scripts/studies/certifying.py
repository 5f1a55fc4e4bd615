"""What certificates cost: times of images with and without one, in turns."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import TypeAlias

import numpy as np

import clsas
from clsas.selftest import cases, wreck

COLUMNS = ["image", "seconds without", "with", "share", "pixels", "measured dB"]
TOLERANCE_DB = -50.0
_RUNS = 5  # in turns, after one that builds kernels
_CASES = ("ffbp-thesis", "ffbp-2k", "ffbp-relief", "ffbp-helix", "ffbp-8k")
_NOISE_DB = -60.0  # of white noise, whose band leaves no guard band for short filters

Form: TypeAlias = Callable[[bool], clsas.Certificate | None]
"""Forms an image with or without a certificate."""


def rows(device: str | None = None) -> Iterator[list[str]]:
    """Yield a row for every case."""
    for name in _CASES:
        case = cases.FACTORIZED_CASES[name]
        yield compared(name, of(case.lines(), case.grid, case.beam, device))
    case = cases.FACTORIZED_CASES["ffbp-2k"]
    lines = case.lines()
    yield compared(
        "ffbp-2k, exact", of(lines, case.grid, case.beam, device, accuracy_db=TOLERANCE_DB)
    )
    noise = np.random.default_rng(0).normal(size=(*lines.samples.shape, 2)) @ [1, 1j]
    noise *= 10 ** (_NOISE_DB / 20) * np.sqrt(np.mean(np.abs(lines.samples) ** 2) / 2)
    noisy = replace(lines, samples=lines.samples + noise.astype(np.complex64))
    yield compared("ffbp-2k, white noise", of(noisy, case.grid, case.beam, device))
    relief = cases.FACTORIZED_CASES["ffbp-relief"]
    profile = clsas.SoundSpeed(
        np.array([0.0, 10, 30]), np.array([1500.0, 1495, 1485]), surface_z_m=5.0
    )
    below = replace(relief.lines(), sound_speed=profile)
    yield compared("ffbp-relief, sound-speed profile", of(below, relief.grid, relief.beam, device))
    yield compared("mosaic-wreck", of_wreck(device))


def of(
    lines: clsas.RangeLines,
    grid: clsas.Grid,
    beam: clsas.BeamWindow | None,
    device: str | None,
    accuracy_db: float | None = None,
) -> Form:
    """Return what forms the image of lines, exactly if an accuracy is given."""

    def form(certificate: bool) -> clsas.Certificate | None:
        if accuracy_db is None:
            image = clsas.factorize(
                lines, grid, TOLERANCE_DB, beam=beam, device=device, certificate=certificate
            )
        else:
            image = clsas.backproject(
                lines, grid, accuracy_db=accuracy_db, beam=beam, device=device,
                certificate=certificate,
            )  # fmt: skip
        return certificate_of(image)

    return form


def of_wreck(device: str | None) -> Form:
    """Return what forms the mosaic of the wreck."""
    pixels, beam = cases.MOSAIC_CASES["mosaic-wreck"]
    lines, grid = wreck.lines(), wreck.grid(pixels)

    def form(certificate: bool) -> clsas.Certificate | None:
        mosaic = clsas.mosaic(
            lines, grid, tolerance_db=TOLERANCE_DB, beam=beam, device=device,
            certificate=certificate,
        )  # fmt: skip
        return certificate_of(mosaic.image())

    return form


def certificate_of(image: clsas.Image) -> clsas.Certificate | None:
    """Return the certificate of an image that was just formed."""
    assert image.formed is not None
    return image.formed.certificate


def compared(name: str, form: Form) -> list[str]:
    """Return a row: median times of an image without and with a certificate."""
    seconds: dict[bool, list[float]] = {False: [], True: []}
    form(True)
    for _ in range(_RUNS):
        for certificate in seconds:
            start = time.perf_counter()
            found = form(certificate)
            seconds[certificate].append(time.perf_counter() - start)
    assert found is not None
    without, with_one = (statistics.median(times) for times in seconds.values())
    # The certificate's own time varies less than the difference of two images.
    share = f"{100 * found.seconds / without:.1f} %"
    return [
        name, f"{without:.3f}", f"{with_one:.3f}", share, str(found.pixels),
        f"{found.error_db:.1f}",
    ]  # fmt: skip
