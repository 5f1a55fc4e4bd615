"""The comparison with other codes, without them."""

import sys
from pathlib import Path

import numpy as np
import pytest

import clsas
from clsas.exact import reference

SCRIPTS = Path(__file__).parents[2] / "scripts"
sys.path.append(str(SCRIPTS))
from peers import compare  # noqa: E402


def test_samples_over_frequency_give_the_ideal_image():
    """By the sum that codes for radar form, in float64."""
    case = compare.scene(32)
    lines = case.lines()
    given = compare.as_radar(case, lines)
    points_m = case.grid.positions_m().reshape(-1, 3)[::31]
    range_m = np.linalg.norm(points_m[:, None] - given["positions_m"], axis=-1) - given["ref_m"]
    frequency_hz = given["first_hz"] + given["step_hz"] * np.arange(given["history"].shape[1])
    cycles = 2 * frequency_hz * range_m[..., None] / compare.LIGHT_M_S
    found = np.einsum("pk,npk->n", given["history"], np.exp(2j * np.pi * cycles))
    found /= given["history"].shape[1]
    assert clsas.relative_error_db(found, reference.ideal(lines, points_m)) < -88


def test_a_part_of_the_scene_keeps_its_spacings():
    whole, part = compare.scene(2048), compare.scene(512)
    assert (whole.channels, part.channels) == (2048, 512)
    for one, other in zip(whole.grid.vectors_m[1:], part.grid.vectors_m[1:], strict=True):
        np.testing.assert_allclose(one, other)


def test_errors_do_not_count_a_common_factor():
    ideal = np.array([1, 2j, -3])
    assert compare.error_db(2j * ideal, np.arange(3), ideal) < -120


def test_a_program_that_fails_is_named(tmp_path):
    program = tmp_path / "broken.py"
    program.write_text("raise SystemExit(3)")
    with (
        compare.worker(Path(sys.executable), program, tmp_path / "none") as ask,
        pytest.raises(compare.PeerError, match=r"broken\.py ended with 3"),
    ):
        ask("linear")


@pytest.mark.slow
def test_a_package_that_is_not_there_is_named(tmp_path, monkeypatch):
    monkeypatch.setenv("CLSAS_CACHE", str(tmp_path))
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    with pytest.raises(compare.PeerError, match="no-such-package==1 cannot be installed: ERROR"):
        compare.environment("no-such-package==1")
