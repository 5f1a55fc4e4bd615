"""The attack on the public API: it covers all names, and a part of it passes."""

import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("matplotlib")
pytest.importorskip("zarr")
pytest.importorskip("sarkit", reason="sarkit (extra radar) is not installed")

ATTACK = Path(__file__).parents[2] / "scripts" / "attack"
EVERY = {"data": 4, "sonars": 6, "imaging": 40, "files": 30}
"""Groups that take little time; one value in so many is tried."""


@pytest.fixture(scope="module")
def judge():
    sys.path.insert(0, str(ATTACK))
    try:
        from api_calls import judge

        yield judge
    finally:
        sys.path.remove(str(ATTACK))
        for name in [name for name in sys.modules if name.split(".")[0] == "api_calls"]:
            del sys.modules[name]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("attack")


@pytest.mark.slow
def test_every_public_function_and_argument_is_attacked(judge, folder):
    calls = {}
    for group in judge.GROUPS:
        calls |= judge.table(group, folder)
    names = {name.split(":")[0] for name in calls}
    assert names == set(judge.public())
    left_out = [
        f"{name}({argument})"
        for name, call in calls.items()
        for argument in judge.arguments_of(call)
        if ":" not in name and argument not in call.arguments
    ]
    assert left_out == []


@pytest.mark.exhaustive
@pytest.mark.parametrize("group", EVERY)
def test_wrong_values_are_refused_by_name_and_equal_ones_accepted(group):
    """In a separate process with limited memory."""
    command = [ATTACK / "api", "--groups", group, "--every", EVERY[group], "--list"]
    run = subprocess.run(
        [sys.executable, *map(str, command)], capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stdout + run.stderr
    assert int(run.stdout.split(" calls")[0]) > 50


def test_the_judgement_finds_what_is_wrong(judge):
    """A function with a different mistake for each value."""

    def wrong(length_m):
        if length_m is None:
            raise AttributeError("length_m")
        if isinstance(length_m, str):
            raise ValueError("no")
        return 0.0 if isinstance(length_m, dict) else float("nan")

    call = judge.Call(wrong, {"length_m": 2.0})
    valid = judge.Result(1.0)
    kinds = {}
    for value in judge.values_for(call, "length_m", 2.0, {}, Path()):
        failure = judge.outcome(call, "length_m", value, valid)
        kinds[value.label] = failure and failure.kind
    assert kinds["None"] == "wrong exception"
    assert kinds["str"] == "names no argument"
    assert kinds["dict"] == "accepts a wrong value"
    assert kinds["times 0"] == "returns NaN"
    assert kinds["float64"] == "returns NaN"

    call = judge.Call(lambda length_m: 2 * length_m, {"length_m": 2.0})
    assert judge.outcome(
        call, "length_m", judge.Value("", 3.0, "equal"), judge.Result(4.0)
    ).kind == ("differs from the valid call")
    assert judge.outcome(call, "length_m", judge.Value("", 2.0, "equal"), judge.Result(4.0)) is None
