"""Every fault of scripts/mutants can be planted, and the tests that it names exist."""

import sys
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path

ROOT = Path(__file__).parents[2]


def _mutants(monkeypatch):
    loader = SourceFileLoader("mutants", str(ROOT / "scripts" / "mutants"))
    module = module_from_spec(spec_from_loader("mutants", loader))
    monkeypatch.setitem(sys.modules, "mutants", module)
    loader.exec_module(module)
    return module.MUTANTS


def test_every_fault_can_be_planted(monkeypatch):
    for mutant in _mutants(monkeypatch):
        found = (ROOT / mutant.file).read_text().count(mutant.text)
        assert found == 1, f"{mutant.name}: {mutant.text!r} stands {found} times in {mutant.file}"
        assert all((ROOT / test).exists() for test in mutant.tests)
