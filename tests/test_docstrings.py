"""The examples in docstrings run, and show what they print."""

import doctest
import importlib

import pytest

import clsas

MODULES = sorted({module for module in clsas._MODULE_OF.values() if module})


@pytest.mark.slow
@pytest.mark.parametrize("name", MODULES)
def test_examples_run(name):
    module = importlib.import_module(f"clsas.{name}")
    failed, _ = doctest.testmod(module)
    assert not failed
