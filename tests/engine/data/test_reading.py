import contextlib
import os
import sys
import tracemalloc

import pytest

from clsas.engine.data import reading, validate
from clsas.files import airsas, height_files
from clsas.files.csv_files import read_columns

DEEP = 100_000


def test_an_ordinary_file_is_read(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"abc")
    assert reading.read_bytes(path) == b"abc"


def test_pipes_and_devices_are_refused_unopened(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("/dev/zero")
    for name, kind in (("pipe", "a pipe"), ("link", "a device")):
        with pytest.raises(ValueError, match=f"{name} must be an ordinary file, got {kind}"):
            reading.read_bytes(tmp_path / name)


def test_a_text_too_large_to_be_parsed_is_refused_unread(tmp_path, monkeypatch):
    path = tmp_path / "file"
    path.touch()
    os.truncate(path, 1 << 40)  # a hole
    monkeypatch.setattr(validate, "_memory_bytes", lambda: 1 << 30)
    with pytest.raises(ValueError, match="file must ask for at most 1 GiB"):
        reading.read_bytes(path)


LETTERS = "abcdefghijklmnopqrstuvwxyz"


def of_columns(path):
    return read_columns(path, (*"abcd", "\u0100"), lambda names: None, "numbers")


def parsed_toml(path):
    return reading.parse_toml(reading.read_bytes(path, reading.TOML_BYTES))


def parsed_json(path):
    return reading.parse_json(reading.read_bytes(path))


@pytest.mark.parametrize(
    ("read", "factor", "text"),
    [
        (parsed_json, reading.JSON_BYTES, f"[{','.join(['[]'] * 9000)}]"),
        (parsed_json, reading.JSON_BYTES, f"[{','.join(['{}'] * 9000)}]"),
        (parsed_toml, reading.TOML_BYTES, f"a = [{','.join(['{a.b=1}'] * 4000)}]"),
        (
            parsed_toml,
            reading.TOML_BYTES,
            "\n".join(f"[{a}{b}.{'.'.join(LETTERS)}]" for a in LETTERS for b in LETTERS),
        ),
        (of_columns, reading.COLUMNS_BYTES, "a\n" + "1\n" * 15000),
        (of_columns, reading.COLUMNS_BYTES, ",".join("abcd") + "\n" + "12,1,1,1\n" * 3500),
        (of_columns, reading.COLUMNS_BYTES, ",".join(["\u0100"] * 10000)),
        (of_columns, reading.COLUMNS_BYTES, "a\n" + ",".join(["12"] * 10000)),
        (height_files._from_csv, reading.COLUMNS_BYTES, "1,2\n" * 8000),
        (height_files._from_csv, reading.COLUMNS_BYTES, ",".join("1" * 15000)),
        (lambda path: airsas._rows(path, 0, 0), reading.ROWS_BYTES, "1\n" * 15000),
        (lambda path: airsas._rows(path, 0, 0), reading.ROWS_BYTES, "\u0100\n" * 10000),
    ],
)
def test_parsing_takes_no_more_memory_than_is_checked(tmp_path, read, factor, text):
    path = tmp_path / "file"
    path.write_text(text)
    with contextlib.suppress(ValueError):
        read(path)  # the first time loads modules
    tracemalloc.start()
    try:
        before, _ = tracemalloc.get_traced_memory()
        with contextlib.suppress(ValueError):  # a refused table takes memory, too
            read(path)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak - before < factor * path.stat().st_size


@pytest.fixture
def usual_recursion_limit():
    """Set Python's default limit, which Hypothesis raises in the process of its tests."""
    limit = sys.getrecursionlimit()
    sys.setrecursionlimit(1000)
    yield
    sys.setrecursionlimit(limit)


@pytest.mark.parametrize("depth", [1500, DEEP])
@pytest.mark.usefixtures("usual_recursion_limit")
def test_nesting_is_no_recursion_error(depth):
    for text in (b"a=" + b"[" * depth + b"]" * depth, b"a=" + b"{a=" * depth):
        with pytest.raises(ValueError, match=r"nested too deep"):
            reading.parse_toml(text)


def test_nested_json_is_no_recursion_error():
    for text in ("[" * DEEP + "]" * DEEP, '{"a":' * DEEP):
        with pytest.raises(ValueError, match="nested too deep"):
            reading.parse_json(text)


def test_what_is_parsed():
    assert reading.parse_toml(b"a = [[1]]") == {"a": [[1]]}
    assert reading.parse_json('{"a": [1]}') == {"a": [1]}
    with pytest.raises(ValueError, match="Expecting"):
        reading.parse_json("{")
