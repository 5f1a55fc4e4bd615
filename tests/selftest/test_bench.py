import dataclasses
import json
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path

import numpy as np
import pytest
from stored_tables import printed
from studies import tables
from studies.scaling import scaled

from clsas.engine.data.beam import BeamWindow
from clsas.selftest import bench, cases

SCRIPT = Path(__file__).parents[2] / "scripts" / "bench"
SMALL = cases.Case(200, 8.25e-3, 1e6, 100e3, (-0.3, 0.3), (40.0, 40.6), 128)


def test_cases_are_sampled():
    """Channels and pixels are dense enough for the beam and the band."""
    for name, case in cases.FACTORIZED_CASES.items():
        if name in cases.DENSE_CASES:
            continue
        wavelength_m = 1500 / case.carrier_hz
        grid = case.grid
        assert grid.shape == (case.pixels, case.pixels)
        x_m, y_m = grid.axes_m
        assert y_m[1] - y_m[0] < 1500 / (2 * case.bandwidth_hz), name
        if case.beam is not None:
            sine = np.sin(np.radians(case.beam.width_deg / 2))
            assert case.spacing_m < wavelength_m / (4 * sine) * 1.01, name
            assert x_m[1] - x_m[0] == pytest.approx(0.02, rel=1e-3)


def test_dense_cases_have_the_channels_that_they_promise():
    found = cases.DENSE_CASES
    assert [each.channels for each in found.values()] == [54000, 54000, 16000, 4096]
    assert found["ffbp-helix"].grid.shape == (150, 150)
    assert found["ffbp-helix-fine"].grid.shape == (600, 600)
    assert found["ffbp-volume"].grid.shape == (64, 128, 128)
    helix_m = found["ffbp-helix"].track()
    assert np.linalg.norm(helix_m[:, :2], axis=1) == pytest.approx(0.83)
    assert (helix_m[0, 2], helix_m[-1, 2]) == pytest.approx((0.09, 0.84), abs=1e-4)
    passes_m = found["ffbp-passes"].track().reshape(20, 800, 3)
    ahead = passes_m[:, -1] - passes_m[:, 0]
    assert len(np.unique(np.round(ahead / np.linalg.norm(ahead, axis=1)[:, None], 6), axis=0)) == 3
    assert len(np.unique(passes_m[:, 0, 2])) == 4


def test_scaled_cases_keep_what_they_look_like_in_wavelengths():
    base, small = scaled(2048), scaled(512)
    assert (base.channels, base.pixels, small.channels, small.pixels) == (2048, 2048, 512, 512)
    assert base.carrier_hz == 120e3
    assert small.spacing_m == pytest.approx(4 * base.spacing_m)
    for name in ("carrier_hz", "bandwidth_hz"):
        assert getattr(small, name) == pytest.approx(getattr(base, name) / 4)
    assert (base.x_m, base.y_m, base.beam) == (small.x_m, small.y_m, small.beam)


@pytest.mark.watches("clsas/selftest", "scripts/bench", "scripts/studies")
@pytest.mark.parametrize("beam", [None, BeamWindow(1.5, "hann")])
def test_factorized_against_exact(beam, monkeypatch):
    case = dataclasses.replace(SMALL, beam=beam)
    monkeypatch.setitem(cases.FACTORIZED_CASES, "small", case)
    seen = []
    result = bench.run_factorized(
        "small", tolerance_db=-40, repeats=2, progress=lambda *done: seen.append(done)
    )
    assert seen == [(1, 3), (2, 3), (3, 3)]
    assert result["case"] == "small"
    assert (result["channels"], result["pixels"]) == (200, [128, 128])
    assert result["tolerance_db"] == -40
    assert result["error_db"] < -38
    assert result["predicted_error_db"] <= -40
    assert result["plan"].startswith("Plan: tolerance -40 dB")
    timed = ("plan_", "", "again_", "moved_", "whole_", "exact_", "default_")
    for key in (f"{name}seconds" for name in timed):
        assert 0 < result[key]["min"] <= result[key]["median"] <= result[key]["max"]
    for key, speedup in (("seconds", "speedup"), ("again_seconds", "speedup_again")):
        ratio = result["exact_seconds"]["median"] / result[key]["median"]
        assert result[speedup] == pytest.approx(ratio)
    ratio = result["default_seconds"]["median"] / result["seconds"]["median"]
    assert result["speedup_over_default"] == pytest.approx(ratio)
    assert result["predicted_seconds"] > 0
    assert {"device", "driver", "samples"} < result.keys()
    assert json.loads(json.dumps(result)) == result


@pytest.mark.watches("clsas/selftest", "scripts/bench", "scripts/studies")
def test_heights_against_one_image(monkeypatch):
    monkeypatch.setitem(cases.HEIGHTS_CASES, "small", cases.Dunes(128, (-1.0, 1.0)))
    seen = []
    result = bench.run_heights("small", repeats=1, progress=lambda *done: seen.append(done))
    assert seen == [(1, 1)]
    assert result["pixels"] == [128, 128]
    assert result["valid_share"] > 0.7
    assert 0.7 < result["error_m"] / result["deviation_m"] < 1.4
    parts = result["sweep_seconds"] + result["refinement_seconds"]
    assert result["seconds"]["median"] == pytest.approx(parts, rel=1e-3)
    assert result["images"] == pytest.approx(parts / result["image_seconds"]["median"], rel=1e-3)
    assert json.loads(json.dumps(result)) == result


def test_unknown_cases_are_refused():
    with pytest.raises(
        ValueError, match=r"case must be one of 'bp-thesis', 'bp-2k', got 'ffbp-2k'"
    ):
        bench.run("ffbp-2k")
    with pytest.raises(ValueError, match=r"case must be one of 'ffbp-thesis', .* got 'bp-2k'"):
        bench.run_factorized("bp-2k")
    with pytest.raises(ValueError, match=r"case must be one of 'heights-512', 'heights', got 'h'"):
        bench.run_heights("h")


def test_scaling_fits_exponents_and_writes_them(monkeypatch, tmp_path, capsys):
    pytest.importorskip("matplotlib")

    def measured(case, **_):
        """Times that are proportional to N^2 and N^3."""
        n = case.pixels / 256
        figures = dict.fromkeys(["error_db", "predicted_error_db"], -50.0)
        seconds = {"seconds": 0.1 * n**2, "exact_seconds": n**3, "plan_seconds": 0.1}
        times = {name: {"median": value} for name, value in seconds.items()}
        return {"device": "abacus", "driver": "1.0", "speedup": 10 * n, **times, **figures}

    monkeypatch.setattr(bench, "run_factorized", measured)
    tables.scaling(None, 1024, tmp_path / "s.png")
    told = capsys.readouterr().out
    (header, rows), (_, growths) = printed(told)
    assert [row[0] for row in rows] == ["256", "384", "512", "768", "1024"]
    of_octaves = [row[header.index("factorized_s")] for row in rows[::2]]
    assert of_octaves == ["0.1", "0.4", "1.6"]
    assert [row[header.index("exact_s")] for row in rows[::2]] == ["1", "8", "64"]
    assert growths == [
        ["factorized", "2.00", "2.00 to 2.00", "5", "256 to 1024"],
        ["exact", "3.00", "3.00 to 3.00", "5", "256 to 1024"],
    ]
    assert (tmp_path / "s.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_intervals_of_exponents_contain_the_true_one_as_often_as_they_claim():
    random, sizes = np.random.default_rng(1), np.array([64, 256, 384, 512, 768, 1024])
    found = [
        tables.growth(sizes, sizes**2.5 * np.exp(0.1 * random.standard_normal(len(sizes))))
        for _ in range(1000)
    ]
    covered = np.mean([abs(each.exponent - 2.5) <= each.half_width for each in found])
    assert covered == pytest.approx(0.95, abs=0.02)
    assert {tuple(each.sizes) for each in found} == {tuple(sizes[1:])}  # 64 has fixed costs
    assert tables.growth([256, 512], [1.0, 4.0]).cells == ["2.00", "", "2", "256 to 512"]


@pytest.mark.watches("clsas/selftest", "scripts/bench", "scripts/studies")
def test_the_table_of_factorized_cases(monkeypatch, capsys):
    monkeypatch.setattr(cases, "FACTORIZED_CASES", {"small": SMALL})
    tables.factorized([None])
    header, _, row = capsys.readouterr().out.splitlines()
    assert "speedup" in header
    assert row.startswith("| small | ")
    assert header.count("|") == row.count("|")


def test_the_script_prints_the_table_that_is_named(monkeypatch, capsys):
    monkeypatch.setattr(tables, "factorized", lambda devices, names: print(devices, names))
    loader = SourceFileLoader("bench_script", str(SCRIPT))
    script = module_from_spec(spec_from_loader("bench_script", loader))
    loader.exec_module(script)
    monkeypatch.setattr("sys.argv", ["bench", "factorized", "--device", "0", "--case", "ffbp-2k"])
    script.main()
    assert capsys.readouterr().out == "['0'] ['ffbp-2k']\n"
