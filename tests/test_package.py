"""The package as users meet it: its names, and what importing it costs."""

import ast
import importlib
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

import clsas
from clsas import cli
from clsas.core import extras

ROOT = Path(__file__).parents[1]
SLOW = ("matplotlib", "h5py", "pyopencl", "scipy", "pydantic", "rich", "numpy", "finufft")


def imported(program):
    """The slow packages, and scipy.signal and scipy.stats, that a program has imported."""
    code = f"import sys\n{program}\nimport json; print(json.dumps(list(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    modules = json.loads(done.stdout.splitlines()[-1])
    return {name for name in modules if name in (*SLOW, "scipy.signal", "scipy.stats")}


def test_importing_the_package_imports_nothing_slow():
    assert imported("import clsas") == set()


@pytest.mark.parametrize("option", ["--help", "--version"])
def test_help_and_version_import_nothing_slow(option):
    command = f"main([{option!r}], prog_name='clsas', standalone_mode=False)"
    assert imported(f"from clsas.cli import main\n{command}") == set()


@pytest.mark.slow
def test_the_imagers_do_without_slow_parts_of_scipy():
    used = imported("import clsas; clsas.backproject, clsas.plan, clsas.factorize, clsas.compress")
    assert "scipy" in used
    assert not used & {"scipy.signal", "scipy.stats", "matplotlib"}


def test_every_public_name_is_there_and_known_to_type_checkers():
    tree = ast.parse((ROOT / "clsas" / "__init__.py").read_text())
    (checked,) = (node for node in tree.body if isinstance(node, ast.If))
    seen = {name.name: node.module for node in checked.body for name in node.names}
    assert seen.keys() == set(clsas.__all__) == set(dir(clsas)) - {"__version__"}
    for name, module in seen.items():
        there = importlib.import_module("clsas.plot" if name == "plot" else module)
        assert getattr(clsas, name) is (there if name == "plot" else getattr(there, name))
    with pytest.raises(AttributeError, match="'clsas' has no attribute 'imag'"):
        _ = clsas.imag


@pytest.mark.slow
def test_functions_keep_their_names_when_modules_of_these_are_imported():
    program = """
import clsas
import clsas.planning.planner, clsas.mosaics.mosaic, clsas.measures.tradeoff
from clsas.simulation.simulator import simulate_lines
assert all(callable(getattr(clsas, name)) for name in clsas.__all__ if name != "plot")
from clsas import plan, simulate
assert callable(plan) and callable(simulate)
clsas.plot.image_db
"""
    imported(program)


def test_commands_are_listed_as_they_describe_themselves():
    context = cli.main.make_context("clsas", ["devices"])
    for name, (_, what) in cli._COMMANDS.items():
        command = cli.main.get_command(context, name)
        assert re.sub(r"\s+", " ", command.help.split("\n\n")[0]) == what
        assert command.name == name


def test_installation_hints_name_what_the_project_asks_for():
    tomllib = importlib.import_module("tomllib")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for extra, packages in extras.PACKAGES.items():
        assert project["optional-dependencies"][extra] == list(packages)
    assert extras.install_command("plot") == "pip install 'matplotlib>=3.8'"
