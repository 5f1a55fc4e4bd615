"""Numbers of the steps' results, as JSON types, for reports and records."""

from __future__ import annotations

from typing import Any

import numpy as np

from clsas.engine.data.contrast import contrast, entropy
from clsas.engine.data.image import Image
from clsas.interferometry.result import Heights
from clsas.navigation.autofocus import Autofocus
from clsas.navigation.micronavigation import Micronavigation


def of_navigation(found: Micronavigation) -> dict[str, Any]:
    """Return the size and uncertainty of the corrections that micronavigation found."""
    measured = np.isfinite(found.sway_steps_sd_m)
    return {
        "pings": len(found.sway_m),
        "overlap": int(found.overlap.min()),
        "coherence": float(np.median(found.coherence)),
        "sway_rms_m": float(np.std(found.sway_m)),
        "yaw_rms_rad": float(np.std(found.yaw_rad)),
        "surge_rms_m": float(np.std(found.surge_m)),
        "shape_sd_m": float(np.max(found.shape_sd_m)),
        "sway_step_sd_m": float(np.median(found.sway_steps_sd_m[measured])),
        "yaw_step_sd_rad": float(np.median(found.yaw_steps_sd_rad[measured])),
    }


def of_focus(found: Autofocus) -> dict[str, Any]:
    """Return the size and uncertainty of autofocus's corrections, and the gain in sharpness."""
    rms_m = float(np.sqrt(np.mean(np.sum(found.correction_m**2, axis=1))))
    return {
        "focused": found.focused,
        "correction_rms_m": rms_m,
        "correction_sd_m": float(np.median(found.correction_sd_m)) if found.focused else None,
        "sharpness_before": found.sharpness_before,
        "sharpness_after": found.sharpness_after,
    }


def of_image(image: Image) -> dict[str, Any]:
    """Return measures of a whole image, all of them None if every pixel is zero."""
    peak = float(np.abs(image.pixels).max())
    if peak == 0:
        return {"peak_db": None, "contrast": None, "entropy": None}
    return {
        "peak_db": 20 * float(np.log10(peak)),
        "contrast": contrast(image),
        "entropy": entropy(image),
    }


def of_heights(found: Heights) -> dict[str, Any]:
    """Return the valid share of heights, their span and median deviation, and what limits them.

    Span and deviation are None if no height is valid.
    """
    known_m = found.height_m[found.mask]
    is_any = known_m.size > 0
    return {
        "pixels": found.mask.size,
        "valid": float(found.mask.mean()),
        "height_m": [float(known_m.min()), float(known_m.max())] if is_any else None,
        "median_sd_m": float(np.median(found.sd_m[found.mask])) if is_any else None,
        "window_m": found.window_m,
        "looks": float(np.median(found.looks)),
        "coherence": float(np.median(found.coherence)),
        "ambiguity_m": 2 * np.pi * float(np.median(np.abs(found.m_per_rad))),
    }
