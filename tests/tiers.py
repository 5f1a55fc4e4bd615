"""Which tests a run takes: three tiers, and tests of programs whose files have not changed.

Tests without a mark run in every tier, `slow` ones for every change and with all, and `exhaustive`
ones only with all. A test that is marked with `watches(path, ...)` never runs in the fast tier, and
for a change only if one of these files or folders, or its own, differs from the main branch. With
`--resume`, a run of everything leaves out what passed in the one that it continues.
"""

import hashlib
import itertools
import subprocess
from functools import cache
from pathlib import Path

import pytest

EXHAUSTIVE = [pytest.mark.exhaustive]
ROOT = Path(__file__).resolve().parents[1]
PASSED = ROOT / ".cache" / "passed"
TIERS = {
    "fast": "the fast tests (scripts/test --fast)",
    "change": "the tests of every change (scripts/test)",
    "all": "all tests (scripts/test --all)",
}


def add_options(parser):
    group = parser.getgroup("clsas")
    group.addoption(
        "--tier", choices=TIERS, default="change", help="tests to run [default: %(default)s]"
    )
    group.addoption(
        "--resume", action="store_true", help="leave out tests that passed in the last run of all"
    )


def left_out(config, items):
    """Return the tests that a run does not take, in their order."""
    tier = config.getoption("tier")
    if tier == "all" and not config.getoption("resume"):
        return []
    if tier == "all":
        passed = _passed()
        return [item for item in items if _record(item.nodeid) in passed]
    if tier == "fast":
        marks = ("slow", "exhaustive", "watches")
        return [item for item in items if any(item.get_closest_marker(name) for name in marks)]
    return [item for item in items if item.get_closest_marker("exhaustive") or _is_unchanged(item)]


def begin(config):
    """Forget what passed before, unless a run continues."""
    if config.getoption("resume") and config.getoption("tier") != "all":
        raise pytest.UsageError("--resume requires --tier all")
    if _is_whole(config) and not config.getoption("resume"):
        PASSED.unlink(missing_ok=True)


def keep(config, report):
    """Remember a test that passed and left everything as it was, or that cannot run here."""
    if not _is_whole(config):
        return
    if report.skipped or (report.when == "call" and report.passed):
        _ending.add(report.nodeid)
    elif report.when == "teardown" and report.passed and report.nodeid in _ending:
        PASSED.parent.mkdir(exist_ok=True)
        with PASSED.open("a") as file:
            file.write(_record(report.nodeid) + "\n")


_ending: set[str] = set()  # names of tests that passed or were skipped, before they are cleared up


def _is_whole(config):
    """Whether a run takes all tests, not only those of some files or names."""
    chosen = any(config.getoption(name) for name in ("keyword", "markexpr", "collectonly"))
    is_given = config.args_source is pytest.Config.ArgsSource.ARGS
    return config.getoption("tier") == "all" and not chosen and not is_given


def summary(config):
    """Return the tier of what ran, and how to run the others."""
    ran = config.getoption("tier")
    others = ", ".join(name for tier, name in TIERS.items() if tier != ran)
    return f"Tier: {TIERS[ran]}. Others: {others}."


def _is_unchanged(item):
    """Whether a test watches files of which none has changed."""
    watched = [path for mark in item.iter_markers("watches") for path in mark.args]
    changed = changed_files()
    if not watched or changed is None:
        return False
    watched.append(str(item.path.relative_to(ROOT)))
    return not any(f"{name}/".startswith(f"{path}/") for name in changed for path in watched)


@cache
def changed_files():
    """Return the paths that differ from main, or None if there is no history.

    On main itself, they are those of the last commit, and what is not committed.
    """
    main = _git("rev-parse", "--verify", "--quiet", "main") or _git("rev-parse", "origin/main")
    base = main and _git("merge-base", "HEAD", *main)
    if base and base == _git("rev-parse", "HEAD"):
        base = _git("rev-parse", "--verify", "--quiet", "HEAD~1")
    if not base:
        return None
    new = _git("ls-files", "--others", "--exclude-standard") or []
    return frozenset([*_git("diff", "--name-only", *base), *new])


def _git(*arguments):
    """Return the lines that a git command prints, or None if it fails."""
    try:
        done = subprocess.run(["git", "-C", ROOT, *arguments], capture_output=True, text=True)
    except OSError:
        return None
    return None if done.returncode else done.stdout.splitlines()


def _passed():
    return frozenset(PASSED.read_text().splitlines() if PASSED.exists() else ())


def _record(nodeid):
    """Return a test's name, with a digest of everything that it may test."""
    return f"{_digest()} {nodeid}"


@cache
def _digest():
    """Return a digest of all files of the checkout that git knows or might add."""
    found = hashlib.sha256(package_digest())
    for name in sorted(_git("ls-files", "--cached", "--others", "--exclude-standard") or []):
        if (ROOT / name).is_file():
            found.update((ROOT / name).read_bytes())
    return found.hexdigest()[:16]


@cache
def package_digest():
    """Return a digest of the package, its kernels, and the modules that tests share."""
    paths = [ROOT / "pyproject.toml", *(ROOT / "tests").glob("*.py"), *(ROOT / "cl").iterdir()]
    paths += (ROOT / "clsas").rglob("*.py")
    found = hashlib.sha256()
    for path in sorted(paths):
        found.update(path.read_bytes())
    return found.digest()


def thinned(*axes, whole=()):
    """Return parameters for all combinations of values, of which few run for every change.

    For a change every value of every axis runs at least once: the longest axis is gone through, and
    the others in turn beside it. The rest is `exhaustive`, except for values of the first axis that
    are in `whole`, which run with all others.
    """
    axes = [list(axis) for axis in axes]
    assert all(value in axes[0] for value in whole), "whole must have values of the first axis"
    longest = max(map(len, axes))
    often = {tuple(number % len(axis) for axis in axes) for number in range(longest)}
    return [
        pytest.param(
            *(axis[number] for axis, number in zip(axes, numbers, strict=True)),
            marks=[] if numbers in often or axes[0][numbers[0]] in whole else EXHAUSTIVE,
        )
        for numbers in itertools.product(*(range(len(axis)) for axis in axes))
    ]


def name_of(value):
    """Return the name of a function, by which pytest calls a parameter, or None."""
    return getattr(value, "__name__", None)


def few(values, often):
    """Return parameters, of which only those in `often` run for every change."""
    values = list(values)
    assert all(value in values for value in often), "often must have some of the values"
    return [
        pytest.param(
            *(value if isinstance(value, tuple) else (value,)),
            marks=[] if value in often else EXHAUSTIVE,
        )
        for value in values
    ]


def also(*values):
    """Return further values of a parameter, which run only with all tests."""
    return [pytest.param(value, marks=EXHAUSTIVE) for value in values]
