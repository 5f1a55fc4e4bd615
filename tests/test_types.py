"""Type checkers accept the code of the README and the tour, and array-likes in constructors."""

import ast
import inspect
import re
import sys
from pathlib import Path

import pytest

from clsas.engine.data.image import Image
from clsas.engine.data.lines import RangeLines
from clsas.simulation.scenes import PointTargets

ROOT = Path(__file__).parents[1]


@pytest.mark.watches("README.md", "docs/tour.md", "clsas/__init__.py")
def test_the_readme_and_the_tour_pass_mypy(tmp_path, monkeypatch):
    api = pytest.importorskip("mypy.api")
    text = "".join(path.read_text() for path in (ROOT / "README.md", ROOT / "docs" / "tour.md"))
    snippets = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    assert len(snippets) > 2
    program = tmp_path / "readme.py"
    program.write_text("\n".join(snippets))
    monkeypatch.setenv("MYPYPATH", str(ROOT))
    monkeypatch.chdir(tmp_path)
    report, errors, code = api.run(
        [
            "--strict",
            "--follow-imports=silent",
            f"--python-executable={sys.executable}",
            "readme.py",
        ]
    )
    assert code == 0, report + errors


@pytest.mark.parametrize("kind", [Image, PointTargets, RangeLines])
def test_constructors_are_as_type_checkers_see_them(kind):
    (described,) = (
        node
        for part in ast.parse(inspect.cleandoc(inspect.getsource(kind))).body[0].body
        if isinstance(part, ast.If)
        for node in part.body
    )
    arguments = described.args.args[1:]
    defaults = [ast.literal_eval(default) for default in described.args.defaults]
    parameters = inspect.signature(kind).parameters.values()
    assert [argument.arg for argument in arguments] == [p.name for p in parameters]
    assert defaults == [p.default for p in parameters if p.default is not p.empty]
    for argument, parameter in zip(arguments, parameters, strict=True):
        if "NDArray" in parameter.annotation:
            assert ast.unparse(argument.annotation).startswith("ArrayLike")
