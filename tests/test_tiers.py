"""Every tier takes the tests that are meant for it."""

import subprocess
from types import SimpleNamespace

import pytest
import tiers


def chosen(parameters):
    return [each.values for each in parameters if not each.marks]


def test_for_a_change_every_value_runs_at_least_once():
    parameters = tiers.thinned("abc", [1, 2], whole="b")
    assert [each.values for each in parameters] == [(c, n) for c in "abc" for n in (1, 2)]
    assert chosen(parameters) == [("a", 1), ("b", 1), ("b", 2), ("c", 1)]
    assert len(chosen(tiers.thinned(range(3), range(7), range(2)))) == 7


class Item:
    """A test with marks, in a file."""

    def __init__(self, *marks, nodeid="tests/test_x.py::test_y"):
        self.marks = marks
        self.nodeid = nodeid
        self.path = tiers.ROOT / nodeid.split("::")[0]

    def iter_markers(self, name):
        return [each.mark for each in self.marks if each.name == name]

    def get_closest_marker(self, name):
        return next(iter(self.iter_markers(name)), None)


def config(tier, resume=False, source=pytest.Config.ArgsSource.TESTPATHS, **options):
    return SimpleNamespace(
        getoption=({"tier": tier, "resume": resume} | options).get, args_source=source
    )


def test_each_tier_adds_to_the_one_before(monkeypatch):
    monkeypatch.setattr(tiers, "changed_files", lambda: {"scripts/peers/codes.py"})
    fast, slow, exhaustive = Item(), Item(pytest.mark.slow), Item(pytest.mark.exhaustive)
    peers = Item(pytest.mark.watches("docs", "scripts/peers"))
    thesis = Item(pytest.mark.watches("scripts/peer"))
    items = [fast, slow, exhaustive, peers, thesis]
    assert tiers.left_out(config("fast"), items) == [slow, exhaustive, peers, thesis]
    assert tiers.left_out(config("change"), items) == [exhaustive, thesis]
    assert tiers.left_out(config("all"), items) == []
    monkeypatch.setattr(tiers, "changed_files", lambda: {"tests/test_x.py"})
    assert tiers.left_out(config("change"), items) == [exhaustive]
    monkeypatch.setattr(tiers, "changed_files", lambda: None)  # there is no history
    assert tiers.left_out(config("change"), items) == [exhaustive]


def test_a_run_of_everything_continues_where_it_was_stopped(monkeypatch, tmp_path):
    monkeypatch.setattr(tiers, "PASSED", tmp_path / "kept" / "passed")
    names = [f"tests/test_tiers.py::test_{name}" for name in ("a", "b", "c", "d")]
    items = [Item(nodeid=name) for name in names]
    everything, again = config("all"), config("all", resume=True)
    tiers.begin(everything)
    outcomes = {
        "a": {"setup": "passed", "call": "passed", "teardown": "passed"},
        "b": {"setup": "passed", "call": "failed", "teardown": "passed"},
        "c": {"setup": "skipped", "teardown": "passed"},
        "d": {"setup": "passed", "call": "passed", "teardown": "failed"},
    }
    some = config("all", source=pytest.Config.ArgsSource.ARGS)
    for name, (when, outcome) in (
        (name, each)
        for name, of_test in zip(names, outcomes.values(), strict=True)
        for each in of_test.items()
    ):
        report = SimpleNamespace(
            nodeid=name, when=when, passed=outcome == "passed", skipped=outcome == "skipped"
        )
        for run in (config("change"), some, config("all", keyword="a"), everything):
            tiers.keep(run, report)
    for run in (again, some, config("all", collectonly=True)):
        tiers.begin(run)
    assert tiers.left_out(again, items) == [items[0], items[2]]
    monkeypatch.setattr(tiers, "_digest", lambda: "of other code")
    assert tiers.left_out(again, items) == []
    tiers.begin(everything)
    assert not tiers.PASSED.exists()
    with pytest.raises(pytest.UsageError, match="--resume requires --tier all"):
        tiers.begin(config("change", resume=True))


def git(folder, *arguments):
    command = ["git", "-C", folder, "-c", "user.name=a", "-c", "user.email=a@b", *arguments]
    subprocess.run(command, check=True, capture_output=True)


def test_files_that_differ_from_main_are_found(monkeypatch, tmp_path):
    monkeypatch.setattr(tiers, "ROOT", tmp_path)

    def changed():
        tiers.changed_files.cache_clear()
        return tiers.changed_files()

    def commit(name):
        (tmp_path / name).write_text(name)
        git(tmp_path, "add", ".")
        git(tmp_path, "commit", "-m", name)

    try:
        assert changed() is None
        git(tmp_path, "init", "-b", "main")
        commit("first")
        assert changed() is None  # the commit before is not there
        commit("second")
        (tmp_path / "new").touch()
        assert changed() == {"second", "new"}
        git(tmp_path, "checkout", "-b", "branch")
        commit("third")
        commit("fourth")
        assert changed() == {"third", "fourth", "new"}
    finally:
        tiers.changed_files.cache_clear()
