"""Errors of arguments with their parts, and limits that types declare."""

import pickle
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import pytest

from clsas.engine.data import validate
from clsas.engine.data.declared import (
    Choice,
    Count,
    Flag,
    Number,
    check_declared,
    check_fields,
    declared,
)
from clsas.engine.data.validate import ArgumentError, ArgumentTypeError

PARTS = ("taper", "be from 0 to 1", "2", "use `beam`", "a.toml [beam]")


@dataclass(frozen=True)
class Declared:
    length_m: Annotated[float, Number("m", above=0.0, most=5.0, help="Length.")] = 1.0
    taps: Annotated[int, Count(2, most=8)] = 4
    shape: Annotated[str, Choice(("hann", "none"))] = "none"
    even: Annotated[bool, Flag("Even.")] = False
    width_m: Annotated[float | None, Number("m", least=-1.0, below=1.0)] = None
    free: object = "unchecked"

    def __post_init__(self):
        check_fields(self)


def function(taps: Annotated[int, Count()], shape: Annotated[str | None, Choice(("hann",))], free):
    """Only declares its parameters."""


def parts(error):
    return error.argument, error.allowed, error.given, error.hint, error.where


@pytest.mark.parametrize("kind", [ArgumentError, ArgumentTypeError])
def test_errors_keep_their_parts_when_they_are_pickled(kind):
    error = kind(*PARTS)
    error.add_note("patch 1,2")
    again = pickle.loads(pickle.dumps(error))
    for each in (error, again):
        assert type(each) is kind
        assert parts(each) == PARTS
        assert str(each) == "a.toml [beam] taper must be from 0 to 1, got 2: use `beam`"
        assert each.__notes__ == ["patch 1,2"]


def test_errors_of_arguments_are_those_of_python():
    assert issubclass(ArgumentError, ValueError)
    assert issubclass(ArgumentTypeError, TypeError)
    assert issubclass(ArgumentTypeError, ArgumentError)
    assert not issubclass(ArgumentError, TypeError)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("x", "be given"), "x must be given"),
        (("x", "be given", "", "add it"), "x must be given: add it"),
        (("x", "be 1", "3 of 4 channels"), "x must be 1, got 3 of 4 channels"),
        (("x", "be 1", (1.0, 2.5)), "x must be 1, got (1, 2.5)"),
        (("x", "be 1", ("yaw", "sway")), "x must be 1, got ('yaw', 'sway')"),
        (("x", "be 1", 0), "x must be 1, got 0"),
        (("x", "be 1", None), "x must be 1, got None"),
    ],
)
def test_messages_contain_the_parts_that_are_given(arguments, message):
    assert str(ArgumentError(*arguments)) == message


def test_sentences_have_other_words_for_argument_and_value():
    error = ArgumentError("range_m", "ascend", (99.0, 1.0), "swap them", "a.toml")
    assert error.sentence("--range", "99:1") == "a.toml --range must ascend, got 99:1: swap them"
    assert error.sentence("--range", "") == "a.toml --range must ascend: swap them"


@pytest.mark.parametrize("kind", [ArgumentError, ArgumentTypeError])
def test_errors_are_placed_within_tables_and_files(kind):
    error = kind("x", "be 1", (2.0, 3.0), "add it")
    placed = error.within("[sonar]").within("a.toml")
    assert type(placed) is kind
    assert parts(placed) == ("x", "be 1", (2.0, 3.0), "add it", "a.toml [sonar]")
    assert error.where == ""


def test_checks_raise_errors_with_parts():
    with pytest.raises(ArgumentError) as error:
        validate.number("speed", 0, "m/s", above=0.0)
    assert parts(error.value) == ("speed", "be finite and > 0 m/s", "0", "", "")
    with pytest.raises(ArgumentTypeError) as error:
        validate.count("taps", 2.5)
    assert parts(error.value) == ("taps", "be a whole number", "2.5", "", "")


@pytest.mark.parametrize(
    ("given", "kind", "message"),
    [
        ({"length_m": 0}, ArgumentError, "length_m must be finite and > 0 and <= 5 m, got 0"),
        ({"length_m": 5.1}, ArgumentError, "length_m must be finite and > 0 and <= 5 m, got 5.1"),
        ({"length_m": "1"}, ArgumentTypeError, "length_m must be one real number in m, got '1'"),
        ({"width_m": 1}, ArgumentError, "width_m must be finite and < 1 and >= -1 m, got 1"),
        ({"width_m": -2}, ArgumentError, "width_m must be finite and < 1 and >= -1 m, got -2"),
        ({"taps": 1}, ArgumentError, "taps must be at least 2, got 1"),
        ({"taps": 9}, ArgumentError, "taps must be at most 8, got 9"),
        ({"taps": 4.0}, ArgumentTypeError, "taps must be a whole number, got 4.0"),
        ({"shape": "han"}, ArgumentError, "shape must be one of 'hann', 'none', got 'han'"),
        ({"even": 1}, ArgumentTypeError, "even must be of type bool, got int"),
        ({"length_m": None}, ArgumentTypeError, "length_m must be one real number in m, got None"),
        ({"taps": None}, ArgumentTypeError, "taps must be a whole number, got None"),
        ({"shape": None}, ArgumentError, "shape must be one of 'hann', 'none', got None"),
        ({"even": None}, ArgumentTypeError, "even must be of type bool, got NoneType"),
    ],
)
def test_fields_keep_what_they_declare(given, kind, message):
    with pytest.raises(kind) as error:
        Declared(**given)
    assert type(error.value) is kind
    assert str(error.value) == message


@pytest.mark.parametrize(
    ("name", "given", "wanted"),
    [
        ("length_m", np.float32(2), 2.0),
        ("length_m", 5, 5.0),
        ("width_m", np.array(-1.0), -1.0),
        ("width_m", None, None),
        ("taps", np.uint8(8), 8),
        ("shape", np.str_("hann"), "hann"),
        ("even", np.True_, True),
    ],
)
def test_fields_become_values_of_python(name, given, wanted):
    found = getattr(Declared(**{name: given}), name)
    assert type(found) is type(wanted)
    assert found == wanted


def test_fields_without_declaration_stay_as_they_are():
    free = np.float32(2)
    assert Declared(free=free).free is free


def test_parameters_of_functions_are_checked_where_given():
    assert check_declared(function, {"taps": np.int8(3), "shape": None}) == {
        "taps": 3,
        "shape": None,
    }
    assert check_declared(function, {"shape": "hann"}) == {"shape": "hann"}
    with pytest.raises(ArgumentTypeError, match="taps must be a whole number, got None"):
        check_declared(function, {"taps": None})
    with pytest.raises(ArgumentError, match="shape must be one of 'hann', got 'none'"):
        check_declared(function, {"shape": "none"})


def test_declarations_are_found_by_name():
    found = declared(Declared)
    assert list(found) == ["length_m", "taps", "shape", "even", "width_m"]
    assert found["length_m"] == Number("m", above=0.0, most=5.0, help="Length.")
    assert found["even"] == Flag("Even.")
    assert declared(function) == {"taps": Count(), "shape": Choice(("hann",))}
