"""The study of phase errors: looks in a window, sensitivity, and a small case."""

import numpy as np
import pytest
from studies import fidelity

import clsas


def test_looks_of_noise_are_its_pixels():
    random = np.random.default_rng(0)
    noise = random.standard_normal((300, 300, 2)) @ [1, 1j]
    assert fidelity.looks(noise) == pytest.approx(81, rel=0.01)
    # Pixels in blocks of 3 x 3 are equal: their correlation falls linearly over three pixels.
    blocks = np.kron(random.standard_normal((100, 100, 2)) @ [1, 1j], np.ones((3, 3)))
    expected = (81 / (9 + 2 * (8 * (2 / 3) ** 2 + 7 * (1 / 3) ** 2))) ** 2
    assert fidelity.looks(blocks) == pytest.approx(expected, rel=0.02)


@pytest.mark.watches("scripts/studies", "scripts/bench")
def test_phases_of_factorized_images_err_less_than_their_pixels(monkeypatch):
    """On a raised plane of points, whose phase also shows the sensitivity of the case."""
    random, count = np.random.default_rng(1), 4000
    xyz_m = random.uniform([-2, 28, 0], [2, 32, 0], (count, 3))
    height_m = 0.1
    xyz_m[:, 2] = height_m
    tx_m = np.zeros((2 * 200, 3))
    tx_m[:, 0] = np.repeat(np.linspace(-3, 3, 200), 2)
    tx_m[:, 2] = 12.0
    banks = np.tile([0, 1], 200)
    rx_m = tx_m + np.multiply.outer(banks - 0.5, [0, 0, 0.25])
    points = clsas.PointTargets(xyz_m, random.standard_normal((count, 2)) @ [1, 1j])
    lines = clsas.simulate_lines(
        tx_m, rx_m, points, carrier_hz=100e3, bandwidth_hz=30e3, window="hamming"
    )
    lines = clsas.RangeLines(**vars(lines) | {"bank_numbers": banks})
    grid = clsas.Grid.plane((-1, 1, 101), (29, 31, 101))
    case = fidelity.Case(lines, grid, clsas.BeamWindow(10.0, "hann"))
    product, coherence = fidelity.interferogram(case.images(None, "cpu"))
    assert np.median(coherence) > 0.95
    turn = float(np.angle(product.sum()))
    assert abs(turn) == pytest.approx(case.turn_rad_m * height_m, rel=0.05)
    monkeypatch.setitem(fidelity.SCENES, "small", lambda: case)
    monkeypatch.setattr(fidelity, "TOLERANCES_DB", (-30,))
    (row,) = fidelity.rows("cpu", ("small",))
    values = dict(zip(fidelity.COLUMNS, row, strict=True))
    assert float(values["error of the images dB"]) < -30
    assert float(values["phase error / image error"]) < 1.2 * float(values["1/sqrt(looks)"])
    assert float(values["99.9 % below mrad"]) > float(values["phase error mrad"])
