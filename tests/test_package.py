"""The package as users meet it: its names, and what importing it costs."""

import ast
import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import clsas
from clsas import cli
from clsas.engine.data import extras

ROOT = Path(__file__).parents[1]
SLOW = ("matplotlib", "h5py", "pyopencl", "scipy", "pydantic", "rich", "numpy")


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


def foreign(source):
    """What a module of the engine must not import: other packages, and the rest of clsas.

    Functions may import the rest of clsas, and type checkers anything.
    """

    def within(node, called=False):
        names = [name.name for name in node.names] if isinstance(node, ast.Import) else []
        if isinstance(node, ast.ImportFrom):
            names = ["." * node.level + (node.module or "")]
        for name in names:
            package = name.partition(".")[0]
            ours = name == "clsas.engine" or name.startswith("clsas.engine.")
            if package not in known and not ours and not (called and package == "clsas"):
                yield name
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            return
        for child in ast.iter_child_nodes(node):
            yield from within(child, called or isinstance(node, ast.FunctionDef))

    known = {"numpy", "scipy", "pyopencl", *sys.stdlib_module_names}
    return list(within(ast.parse(source)))


def test_the_engine_imports_numpy_scipy_and_pyopencl_alone():
    modules = sorted((ROOT / "clsas" / "engine").rglob("*.py"))
    found = {str(path): foreign(path.read_text()) for path in modules}
    assert {path: names for path, names in found.items() if names} == {}


@pytest.mark.parametrize(
    ("source", "names"),
    [
        ("import math, scipy.fft\nfrom clsas.engine.data import grid", []),
        ("if TYPE_CHECKING:\n    import xarray\ndef plot():\n    import clsas.maps", []),
        ("class A:\n    def f(self):\n        with b:\n            import gsw", ["gsw"]),
        ("try:\n    from pyproj.crs import CRS\nfinally:\n    pass", ["pyproj.crs"]),
        ("import numpy, h5py.h5s", ["h5py.h5s"]),
        ("from clsas.maps import tiles", ["clsas.maps"]),
        ("from clsas.engines import tiles\nimport clsas", ["clsas.engines", "clsas"]),
        ("from ..maps import tiles", ["..maps"]),
    ],
)
def test_foreign_imports_are_found_wherever_they_are(source, names):
    assert foreign(source) == names


@pytest.mark.slow
def test_the_imagers_do_without_slow_packages():
    used = imported("import clsas; clsas.backproject, clsas.plan, clsas.Plan, clsas.compress")
    assert used == {"numpy", "scipy", "pyopencl"}


def test_every_public_name_is_there_and_known_to_type_checkers():
    assert set(clsas.__all__) == set(dir(clsas)) - {"__version__"}
    for name in clsas.__all__:
        assert getattr(clsas, name) is not None
    stub = ast.parse((ROOT / "clsas" / "__init__.pyi").read_text())
    imported = [each for each in stub.body if isinstance(each, ast.ImportFrom)]
    assert len(imported) == len(clsas.__all__)
    for (alias,) in (each.names for each in imported):
        assert alias.asname == alias.name  # else checkers would take it for private
    with pytest.raises(AttributeError, match="'clsas' has no attribute 'imag'"):
        _ = clsas.imag


@pytest.mark.slow
def test_functions_keep_their_names_when_modules_of_these_are_imported():
    program = """
import clsas
import clsas.engine.factorized.planner, clsas.mosaics.mosaic, clsas.measures.tradeoff
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
    asked = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]

    def with_included(requirements):
        for each in requirements:
            included = re.fullmatch(r"clsas\[(.*)\]", each)
            if included is None:
                yield each
            else:
                for extra in included[1].split(","):
                    yield from with_included(asked[extra])

    assert extras.PACKAGES.keys() == asked.keys() - {"all", "test", "docs"}
    for extra, packages in extras.PACKAGES.items():
        assert packages == tuple(with_included(asked[extra]))
    assert extras.install_command("plot") == "pip install 'matplotlib>=3.10'"


def test_a_missing_package_is_named_with_the_extra_that_brings_it(monkeypatch):
    for name in ("h5py", "zarr", "no_such_package"):
        monkeypatch.setitem(sys.modules, name, None)
    message = r"^h5py is not installed, and is needed for files: pip install 'h5py>=\S+ 'pydantic"
    with pytest.raises(ImportError, match=message), extras.needed("files"):
        import h5py
    with pytest.raises(ImportError, match="'zarr>="), extras.needed("mosaics", "mosaic"):
        import h5py  # noqa: F401
    # Outer blocks pass on what inner ones say.
    with pytest.raises(ImportError, match="zarr is not installed, and is needed for stores"):  # noqa: SIM117
        with extras.needed("the command line", "cli"), extras.needed("stores"):
            import zarr  # noqa: F401
    with pytest.raises(ModuleNotFoundError, match="no_such_package"), extras.needed("files"):
        import no_such_package  # noqa: F401
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"is needed for pictures: pip install 'matplotlib>="):
        extras.check_installed("matplotlib", "pictures")
