"""Lines that are kept on disk are those of their arguments."""

import pytest
import scenes
import tiers

CALLS = []


def level(x):
    return 0 * x


def slope(x):
    return 0.5 * x


def made(relief, *, seed=1):
    CALLS.append((relief, seed))
    return [relief(2.0), seed]


@pytest.fixture
def again(monkeypatch, tmp_path):
    """Return `made` as in a new process."""
    monkeypatch.setattr(scenes, "FOLDER", tmp_path / "scenes")
    CALLS.clear()
    return lambda: scenes.kept(made)


def test_another_process_makes_nothing_again(again):
    assert again()(level) == again()(level) == [0.0, 1]
    assert [(level, 1)] == CALLS


def test_other_arguments_and_other_reliefs_are_other_scenes(again):
    found = [again()(level), again()(slope), again()(slope, seed=2)]
    assert found == [[0.0, 1], [1.0, 1], [1.0, 2]]
    assert len(CALLS) == 3


def test_what_another_package_made_is_removed(again, monkeypatch):
    again()(level)
    monkeypatch.setattr(tiers, "package_digest", lambda: bytes(32))
    again()(level)
    assert len(CALLS) == 2
    assert len(list(scenes.FOLDER.iterdir())) == 1
