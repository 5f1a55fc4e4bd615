"""Worker processes of this machine: nobody else reaches them, and a failed start is one error."""

import importlib
import os
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from clsas.cli import main

pytest.importorskip("cryptography")
distributed = pytest.importorskip("distributed")

ATTACK = Path(__file__).parents[2] / "scripts" / "attack"


@pytest.fixture
def attack(monkeypatch):
    """The script that asks every port of a run as somebody else would."""
    monkeypatch.syspath_prepend(ATTACK)
    module = importlib.import_module("workers")
    monkeypatch.setattr(module, "TIMEOUT_S", 1.0)
    yield module
    for name in ("workers", "case"):
        sys.modules.pop(name, None)


def new_ports(attack, before):
    return [address for address in attack.listening(os.getpid()) if address not in before]


@pytest.mark.slow
def test_workers_answer_only_their_own_run(attack):
    from clsas.mosaics.workers import local_client

    before = attack.listening(os.getpid())
    with local_client(1) as client:
        ports = new_ports(attack, before)
        assert client.submit(sum, (1, 2)).result(timeout=60) == 3
        assert len(ports) == 3  # scheduler, nanny and worker; none of HTTP
        assert attack.reached(ports) == []
        assert client.submit(sum, (1, 3)).result(timeout=60) == 4  # nor did asking harm


@pytest.mark.slow
def test_what_asks_finds_what_dask_leaves_open(attack):
    """The test above would fail with Dask's own cluster."""
    before = attack.listening(os.getpid())
    with distributed.LocalCluster(n_workers=0, dashboard_address=None):
        found = " ".join(attack.reached(new_ports(attack, before)))
    assert "answers Dask in plain text" in found
    assert "answers HTTP /info/main/workers.html" in found
    assert "answers HTTP /metrics" in found


def run_with_workers(folder):
    """Run a mosaic with workers that cannot start; return its messages."""
    scene = folder / "scene.toml"
    scene.write_text("[grid]\nx = { start_m = 0, stop_m = 1, count = 8 }\n"
                     "y = { start_m = 30, stop_m = 31, count = 8 }\n")  # fmt: skip
    (folder / "lines.h5").touch()
    arguments = [scene, "--lines", folder / "lines.h5", "--workers", "1"]
    result = CliRunner().invoke(main, ["mosaic", *map(str, arguments)])
    assert result.exit_code == 1
    return result.stderr.splitlines()


@pytest.mark.slow
def test_a_worker_that_raises_at_start_is_one_line(tmp_path):
    import dask

    with dask.config.set({"distributed.worker.preload": ["no_such_module"]}):
        said = run_with_workers(tmp_path)
    assert said == [
        "Error: a worker process ended while it started: "
        "ModuleNotFoundError: No module named 'no_such_module'"
    ]


def test_a_worker_that_dies_at_start_is_one_line(tmp_path, monkeypatch):
    (tmp_path / "sitecustomize.py").write_text(
        "import os, sys\n"
        "if '--multiprocessing-fork' in sys.orig_argv:\n"
        "    os._exit(3)\n"
    )  # fmt: skip
    paths = os.environ.get("PYTHONPATH")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *([paths] if paths else [])]))
    said = run_with_workers(tmp_path)
    assert said == [
        "Error: a worker process ended while it started: it was killed or exited by itself "
        "(out of memory?)"
    ]


def test_without_cryptography_it_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "cryptography", None)
    (said,) = run_with_workers(tmp_path)
    assert "need the package cryptography" in said
    assert "pip install 'clsas[mosaic]'" in said
