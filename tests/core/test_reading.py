import os
import sys

import pytest

from clsas.core import reading, validate

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
