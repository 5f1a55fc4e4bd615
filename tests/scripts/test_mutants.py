"""Every fault of scripts/faults.toml can be planted."""

import sys
from dataclasses import replace
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture
def mutants(monkeypatch):
    loader = SourceFileLoader("mutants", str(ROOT / "scripts" / "mutants"))
    module = module_from_spec(spec_from_loader("mutants", loader))
    monkeypatch.setitem(sys.modules, "mutants", module)
    loader.exec_module(module)
    return module


def test_every_fault_can_be_planted(mutants):
    faults = mutants.read_faults()
    for fault in faults:
        source = (ROOT / fault.file).read_text()
        assert fault.planted(source) != source
    assert len({fault.name for fault in faults}) == len(faults) >= 80


def test_what_is_likely_to_find_a_fault_runs_first(mutants):
    kernel = mutants.Fault("", "", "cl/beam.h", "", "")
    before = mutants.Result("tests/engine/data/test_beam.py::test_x", "fast", 1.0)
    first, *_, last = mutants.runs(kernel, ROOT, before)
    assert first == ("fast", ["tests/engine/data/test_beam.py::test_x"])
    assert last == ("change", ["tests"])
    near = [tests for _, tests in mutants.runs(kernel, ROOT, None)]
    assert near[0][0] == "tests/imagers"
    named = replace(kernel, by="tests/engine/test_promise.py::test_x")
    assert list(mutants.runs(named, ROOT, before)) == [("change", [named.by])]
