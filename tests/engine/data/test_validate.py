import re
import subprocess
import sys
from datetime import timedelta
from fractions import Fraction

import numpy as np
import pytest

from clsas.engine.data import validate


def test_number_returns_a_float():
    assert validate.number("speed", np.float32(1500), "m/s") == 1500.0
    assert type(validate.number("speed", 3)) is float


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_number_refuses_what_is_not_finite(value):
    with pytest.raises(ValueError, match=r"speed must be finite m/s, got"):
        validate.number("speed", value, "m/s")


@pytest.mark.parametrize("value", [10**400, -(10**400), Fraction(10**400)])
def test_number_refuses_what_float64_does_not_hold(value):
    with pytest.raises(ValueError, match=r"step must be finite and > 0 m, got -?inf"):
        validate.positive("step", value, "m")


@pytest.mark.parametrize("value", [2, np.int8(2), np.array(2.0), Fraction(2), np.ma.array(2.0)])
def test_number_takes_every_real_number(value):
    assert validate.number("speed", value) == 2.0


@pytest.mark.parametrize(
    "value",
    [
        *(
            True,
            np.True_,
            np.array(True),
            "fast",
            "3",
            np.str_("3"),
            b"3",
            None,
            [1.0, 2.0],
            [3.0],
            np.ones(1),
        ),
        *(1j, np.complex64(1), np.ma.masked, np.datetime64("now"), timedelta(seconds=1)),
        # NumPy's durations are integers, too.
        *(np.timedelta64(1, "s"), np.timedelta64(1), np.timedelta64("NaT"), np.array(1, "m8[ms]")),
    ],
)
def test_number_refuses_other_kinds(value):
    with pytest.raises(TypeError, match=r"speed must be one .*number in m/s, got"):
        validate.number("speed", value, "m/s")


@pytest.mark.parametrize(
    ("limits", "bad", "good", "words"),
    [
        ({"above": 0}, 0, 1e-300, "> 0"),
        ({"below": 2}, 2, 1.999, "< 2"),
        ({"least": 0}, -1e-300, 0, ">= 0"),
        ({"most": 1}, 1.0001, 1, "<= 1"),
    ],
)
def test_number_keeps_its_limits(limits, bad, good, words):
    assert validate.number("taper", good, **limits) == good
    with pytest.raises(ValueError, match=f"taper must be finite and {words}, got"):
        validate.number("taper", bad, **limits)


@pytest.mark.parametrize("value", [0, -1.5])
def test_positive(value):
    with pytest.raises(ValueError, match=r"range_step_m must be finite and > 0 m"):
        validate.positive("range_step_m", value, "m")


def test_count():
    assert validate.count("taps", np.int32(4)) == 4
    with pytest.raises(ValueError, match="taps must be at least 2, got 1"):
        validate.count("taps", 1, least=2)
    for value in (2.0, "2", True, None):
        with pytest.raises(TypeError, match="taps must be a whole number"):
            validate.count("taps", value)


def test_one_of():
    assert validate.one_of("window", "none", ("none", "hamming")) == "none"
    with pytest.raises(ValueError, match=r"window must be one of 'none', 'hamming', got 'hann'"):
        validate.one_of("window", "hann", ("none", "hamming"))


def test_instance():
    validate.instance("taps", 3, int, str)
    with pytest.raises(TypeError, match="taps must be of type int or str, got float"):
        validate.instance("taps", 3.0, int, str)


def test_array_is_read_only_and_leaves_the_callers_alone():
    given = np.arange(6.0).reshape(2, 3)
    result = validate.array("tx_m", given, np.float64, (None, 3))
    assert np.shares_memory(result, given)
    assert not result.flags.writeable
    assert given.flags.writeable


@pytest.mark.parametrize(
    "given",
    [
        np.arange(12).reshape(4, 3).T,
        np.arange(24.0, dtype=np.float32).reshape(3, 8)[:, ::2],
        np.arange(12.0, dtype=">f8").reshape(3, 4),
        [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9, 10, 11.0]],
    ],
)
def test_array_converts_without_changing_values(given):
    result = validate.array("x", given, np.float64, (3, 4))
    assert result.dtype == np.float64
    assert result.flags.c_contiguous
    np.testing.assert_array_equal(result, np.asarray(given))


def test_array_narrows_complex():
    result = validate.array("samples", np.full((2, 2), 1 + 2j), np.complex64, (None, None))
    assert result.dtype == np.complex64


def test_array_refuses_real_where_complex_is_due():
    with pytest.raises(TypeError, match="samples must be complex numbers, got float64: real s"):
        validate.array("samples", np.ones((2, 2)), np.complex64, (None, None))


@pytest.mark.parametrize(
    ("name", "given", "got"),
    [
        ("samples", None, "NoneType"),
        ("samples", "loud", "str"),
        ("samples", [[None]], "object"),
        ("samples", [[True]], "bool"),
        ("pixels", np.ones((2, 2)), "float64"),
    ],
)
def test_array_speaks_of_phase_only_where_samples_are_real(name, given, got):
    with pytest.raises(TypeError, match=rf"^{name} must be complex numbers, got {got}$"):
        validate.array(name, given, np.complex64, (None, None))


def test_array_refuses_masked_values():
    given = np.ma.array([1.0, 2.0, 3.0], mask=[False, True, False])
    with pytest.raises(ValueError, match="x must have no masked value, got 1 of 3"):
        validate.array("x", given, np.float64, (None,))
    result = validate.array("x", np.ma.array([1.0, 2.0]), np.float64, (None,))
    np.testing.assert_array_equal(result, [1.0, 2.0])


@pytest.mark.parametrize("given", [[1j], ["a"], [None], [True], [np.datetime64("now")]])
def test_array_refuses_other_kinds_where_real_is_due(given):
    with pytest.raises(TypeError, match="x must be real numbers, got"):
        validate.array("x", given, np.float64, (None,))


@pytest.mark.parametrize("given", [np.ones(3), np.ones((0, 3)), np.ones((2, 4)), 1.0])
def test_array_names_the_shapes(given):
    with pytest.raises(ValueError, match=r"tx_m must have shape \(any, 3\) and no empty axis, got"):
        validate.array("tx_m", given, np.float64, (None, 3))


def test_array_refuses_ragged_lists():
    with pytest.raises(ValueError, match="x must be a regular array"):
        validate.array("x", [[1, 2], [3]], np.float64, (None, None))


@pytest.mark.parametrize("bad", [np.nan, np.inf, complex(0, np.nan)])
def test_array_counts_what_is_not_finite(bad):
    given = np.ones((2, 3), np.complex128)
    given[1, 2] = bad
    with pytest.raises(ValueError, match="samples must be finite, got 1 NaN or infinite of 6"):
        validate.array("samples", given, np.complex64, (None, None))


@pytest.mark.parametrize("scale", [1e-300, 1e-50, 1e-40, 1e-38, 1e39, 1e300])
@pytest.mark.parametrize("part", [1, 1j])
def test_array_refuses_values_that_a_narrower_type_does_not_hold(scale, part):
    given = np.zeros((2, 3), np.complex128)
    given[1, 2] = -scale * part
    with pytest.raises(ValueError, match=r"samples must have .* from 1.2e-38 to 3.4e\+38.*scale"):
        validate.array("samples", given, np.complex64, (None, None))


@pytest.mark.parametrize("scale", [1.2e-38, 1e38])
def test_array_keeps_float32s_digits_to_the_ends_of_its_range(scale):
    given = scale * np.random.default_rng(1).uniform(-1, 1, (50, 3))
    given[0] = scale, 1e-60, 0  # lost in float32, relative to the largest value
    held = validate.array("x", given, np.float32, (None, None))
    np.testing.assert_allclose(held, given, rtol=0, atol=6e-8 * scale)


def test_array_holds_zeros():
    assert not validate.array("x", np.zeros(3), np.float32, (3,)).any()


def test_array_stretches_one_entry_over_the_first_axis():
    one = validate.array("tx_m", [1, 2, 3], np.float64, (4, 3), broadcast=True)
    np.testing.assert_array_equal(one, np.tile([1.0, 2, 3], (4, 1)))
    one = validate.array("first_range_m", 7, np.float64, (4,), broadcast=True)
    np.testing.assert_array_equal(one, np.full(4, 7.0))


@pytest.mark.parametrize("given", [5.0, [5.0], np.ones((4, 1)), np.ones((1, 3)), np.ones(4)])
def test_array_does_not_stretch_anything_else(given):
    with pytest.raises(ValueError, match=r"tx_m must have shape \(4, 3\)"):
        validate.array("tx_m", given, np.float64, (4, 3), broadcast=True)


@pytest.mark.slow
def test_shown_is_short_and_escapes_what_a_terminal_obeys():
    assert validate.shown(1.5) == "1.5"
    assert validate.shown("a\x1b[31m\nb") == r"'a\x1b[31m\nb'"
    nested = []
    for _ in range(100_000):
        nested = [nested]
    for long in ("x" * 10**6, list(range(10**6)), nested, 10**10_000, {"x": "y" * 10**6}):
        assert len(validate.shown(long)) <= 100


def test_shown_survives_a_repr_that_raises():
    class Bad:
        def __repr__(self):
            raise RuntimeError

    assert "Bad" in validate.shown(Bad())


def test_printable_keeps_text_and_indented_lines():
    assert validate.printable("größer als 5 µs\n  next") == "größer als 5 µs\n  next"
    assert validate.printable("name\nError: none") == r"name\nError: none"
    assert validate.printable("name\n\n  next\n") == "name\\n\n  next\\n"
    assert validate.printable("a\x1b]0;title\x07\r\u202e\udcff") == (
        r"a\x1b]0;title\x07\r\u202e\udcff"
    )
    assert [len(line) for line in validate.printable("x" * 5000 + "\n  b").split("\n")] == [1000, 3]


def test_escaped_keeps_the_lines_of_a_table():
    assert validate.escaped("a\tb\x1b[2J\n\nµ\x9b") == "a\\tb\\x1b[2J\n\nµ\\x9b"


def test_memory_heeds_the_limit_of_the_address_space():
    script = (
        "import resource; from clsas.engine.data import validate; validate.memory('x', 3 << 30);"
        "resource.setrlimit(resource.RLIMIT_AS, (2 << 30,) * 2); validate.memory('x', 1 << 30);"
        "validate.memory('x', 2 << 30)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert re.search(
        r"x must ask for at most 1\.\d+ GiB, what is left of .*, got 2 GiB", done.stderr
    )


def test_memory_counts_what_the_process_holds():
    """Pages that the process has written count, those of libraries do not."""
    before = validate._memory_bytes()
    held = np.ones(100 << 20, np.uint8)
    assert before - validate._memory_bytes() == pytest.approx(held.nbytes, rel=0.2)
    del held
    assert validate._memory_bytes() == pytest.approx(before, abs=20 << 20)


def test_a_budget_adds_up(monkeypatch):
    monkeypatch.setattr(validate, "_memory_bytes", lambda: 10 << 30)
    budget = validate.Budget()
    budget.take("a", 4 << 30, passing_bytes=6 << 30)
    budget.take("b", 4 << 30)
    with pytest.raises(ValueError, match=r"c must ask for at most 2 GiB, .* got 4 GiB"):
        budget.take("c", 1 << 30, passing_bytes=3 << 30)
    budget.take("d", 2 << 30)
    validate.memory("of another call", 10 << 30)


def test_array_checks_the_memory_of_its_copy_before_it_is_made(monkeypatch):
    """As float64, int8 takes eight times as much; without a conversion nothing is taken."""
    given = np.zeros((1 << 20, 3), np.int8)
    monkeypatch.setattr(validate, "_memory_bytes", lambda: 8 << 20)
    with pytest.raises(ValueError, match=r"tx_m must ask for at most .* got 0\.0234 GiB"):
        validate.array("tx_m", given, np.float64, (None, 3))
    validate.array("tx_m", given, np.int8, (None, 3))


@pytest.mark.parametrize("size", [1e30, float("inf"), 10**400])
def test_memory_refuses_any_size(size):
    with pytest.raises(ValueError, match=r"x must ask for at most .* GiB"):
        validate.memory("x", size)


# Values that equal Python's


@pytest.mark.parametrize("value", [np.int8(4), np.uint64(4), np.array(4), 4])
def test_whole_numbers_of_every_type_become_ints(value):
    for found in (validate.count("n", value), validate.one_of("n", value, (2, 4))):
        assert type(found) is int
        assert found == 4


@pytest.mark.parametrize("value", [True, np.True_, np.array(4.0), np.array([4]), 4.0, "4", None])
def test_nothing_else_is_a_whole_number(value):
    with pytest.raises(TypeError, match="n must be a whole number"):
        validate.count("n", value)
    with pytest.raises(ValueError, match="n must be one of 2, 4, got"):
        validate.one_of("n", value, (2, 4))


def test_flags_are_bools_of_python_or_numpy():
    assert validate.flag("f", np.True_) is True
    assert validate.flag("f", False) is False
    for value in (1, None, "yes", np.zeros(0), np.zeros(1, bool)):
        with pytest.raises(TypeError, match="f must be of type bool"):
            validate.flag("f", value)


@pytest.mark.parametrize(
    ("value", "error"),
    [(slice("a"), TypeError), (slice(0, 1, 0.5), TypeError), (slice(0, 1, 0), ValueError),
     (5, TypeError), (None, TypeError)],
)  # fmt: skip
def test_selections_are_slices_of_whole_numbers(value, error):
    with pytest.raises(error, match="rows must be"):
        validate.selection("rows", value)
    part = slice(np.int64(2), None, np.int64(-1))
    assert validate.selection("rows", part) is part


def test_indices_are_whole_numbers_within_limits():
    found = validate.indices("index", np.array([[0, 4]], np.uint8), 5)
    assert found.dtype == np.int64
    assert found.tolist() == [[0, 4]]
    for value, error in (
        ([0.0], TypeError), ([True], TypeError), ("0", TypeError), ([[0, 1], [2]], ValueError),
        ([5], ValueError), ([-1], ValueError), (np.ma.masked_equal([0, 1], 1), ValueError),
    ):  # fmt: skip
        with pytest.raises(error, match="index must"):
            validate.indices("index", value, 5)


def test_arrays_of_any_shape_may_be_empty_or_have_no_axis():
    for value in (2.5, [], [[1.0, 2.0]]):
        assert validate.array("x", value, np.float64, None).shape == np.shape(value)
    with pytest.raises(ValueError, match="x must be finite"):
        validate.array("x", np.nan, np.float64, None)


def test_real_and_complex_arrays_keep_their_kind():
    assert validate.real_or_complex("x", [1, 2], np.complex64).dtype == np.float32
    assert validate.real_or_complex("x", [1j], np.complex64).dtype == np.complex64
    with pytest.raises(TypeError, match="x must be real or complex numbers"):
        validate.real_or_complex("x", ["a"])
    with pytest.raises(ValueError, match="x must be a regular array"):
        validate.real_or_complex("x", [[1.0], [1.0, 2.0]])


def test_entries_are_of_sequences_and_arrays():
    assert validate.entries("x", np.array([1, 2]), "two") == [1, 2]
    for value in ("ab", b"ab", {1, 2}, {1: 2}, 5, np.array(5), np.ma.masked):
        with pytest.raises(TypeError, match="x must be two, got"):
            validate.entries("x", value, "two")


def test_paths_and_texts_without_a_file_are_refused():
    with pytest.raises(ValueError, match=r"path must be .* without NUL"):
        validate.path("path", "a\0b")
    with pytest.raises(TypeError, match="title must be text, got 5"):
        validate.text("title", 5)
    with pytest.raises(ValueError, match="title must be text of Unicode"):
        validate.text("title", "\ud800")
