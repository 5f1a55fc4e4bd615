"""Time of heights from two banks, against that of one image, on speckle of a known relief."""

from __future__ import annotations

from clsas.selftest import bench, cases

COLUMNS = [
    "pixels", "image s", "sweep s", "refinement s", "heights over image", "valid %",
    "rms error mm", "rms deviation mm",
]  # fmt: skip
Row = list[object]


def rows(device: str) -> list[Row]:
    """Return times and errors of all cases of heights; see `clsas.selftest.bench.run_heights`."""
    return [_row(bench.run_heights(case, device=device)) for case in cases.HEIGHTS_CASES]


def _row(found: dict) -> Row:
    return [
        "{} x {}".format(*found["pixels"]),
        f"{found['image_seconds']['median']:.3g}",
        f"{found['sweep_seconds']:.3g}",
        f"{found['refinement_seconds']:.3g}",
        f"{found['images']:.0f}",
        f"{100 * found['valid_share']:.0f}",
        f"{1e3 * found['error_m']:.1f}",
        f"{1e3 * found['deviation_m']:.1f}",
    ]
