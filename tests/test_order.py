"""Tests pass in any order: they share no random generator, and the order can be repeated."""

import ast
import re
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import pytest

TESTS = Path(__file__).parent
MODULES = sorted(TESTS.rglob("*.py"))
GENERATORS = {"default_rng", "RandomState", "Generator", "Random"}


def generators(tree):
    """Lines on which a module, when it is imported, keeps a random generator."""
    for statement in tree.body:
        if isinstance(statement, (ast.Assign, ast.AnnAssign)):
            call = statement.value
            if isinstance(call, ast.Call):
                name = getattr(call.func, "attr", getattr(call.func, "id", None))
                if name in GENERATORS:
                    yield statement.lineno


@pytest.mark.slow
def test_no_module_shares_a_random_generator():
    found = [
        f"{path.relative_to(TESTS)}:{line}"
        for path in MODULES
        for line in generators(ast.parse(path.read_text()))
    ]
    assert found == []


@pytest.mark.parametrize("code", ["R = np.random.default_rng(3)", "R: object = Random()"])
def test_shared_generators_are_seen(code):
    assert list(generators(ast.parse(code))) == [1]
    assert list(generators(ast.parse(f"def f():\n    {code}"))) == []


@pytest.mark.watches("tests/conftest.py")
def test_the_seed_that_is_printed_repeats_the_order():
    """Files, and the tests of each, are shuffled; a file is run whole."""

    def order(*options):
        command = [sys.executable, "-m", "pytest", "-vv", "-p", "no:cacheprovider"]
        names = ("image", "lines", "pings", "reprs")
        files = [f"tests/engine/data/test_{name}.py" for name in names]
        done = subprocess.run(
            [*command, *options, *files], cwd=TESTS.parent, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stdout
        seed = done.stdout.split("random order: repeat it with --randomly-seed=")[1].split()[0]
        return seed, re.findall(r"^(\S+::\S+) PASSED", done.stdout, re.M)

    seed, once = order()
    assert order(f"--randomly-seed={seed}") == (seed, once)
    assert len(once) > 20
    assert sorted(once) != once
    files = [test.split("::")[0] for test in once]
    assert sum(a != b for a, b in pairwise(files)) == 3
