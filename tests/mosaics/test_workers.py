"""Worker processes on this machine: other users cannot reach them; a failed start is one error."""

import importlib
import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
from click.testing import CliRunner

from clsas.cli import main

pytest.importorskip("cryptography")
distributed = pytest.importorskip("distributed")

ATTACK = Path(__file__).parents[2] / "scripts" / "attack"


@pytest.fixture
def attack(monkeypatch):
    """Run the script that tries every port of a run as another user."""
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


@pytest.mark.exhaustive
def test_what_asks_finds_what_dask_leaves_open(attack):
    """The test above fails with an ordinary cluster of Dask, as it should."""
    before = attack.listening(os.getpid())
    with distributed.LocalCluster(n_workers=0, dashboard_address=None):
        found = " ".join(attack.reached(new_ports(attack, before)))
    assert "answers Dask in plain text" in found
    assert "answers HTTP /info/main/workers.html" in found
    assert "answers HTTP /metrics" in found


def run_with_workers(folder):
    """Return the messages of a mosaic whose workers cannot start."""
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
    assert said.startswith(
        "Error: cryptography is not installed, and is needed for the certificate"
    )
    assert "'cryptography>=" in said


VICTIM = """
import sys

from clsas.mosaics.workers import local_client

if __name__ == "__main__":
    with local_client(1) as client:
        look = "[*__import__('sys').path, __import__('h5py').__file__, __import__('zarr').__file__]"
        print(*client.submit(eval, look).result(timeout=120), *sys.path, sep="\\n")
"""


@pytest.mark.slow
@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give files to another user")
def test_nothing_is_imported_that_another_user_planted(tmp_path):
    """Neither from the folder that Dask makes where all can write, nor from that where one works.

    The other user was there first, and made that folder.
    """
    other = 54321
    private, shared = tmp_path / "private", tmp_path / "shared"
    ran = tmp_path / "ran"
    planted = shared / "dask-scratch-space"
    for folder, mode in ((private, 0o700), (shared, 0o1777), (planted, 0o777)):
        folder.mkdir()
        folder.chmod(mode)
    (private / "victim.py").write_text(textwrap.dedent(VICTIM))
    for folder in (shared, planted):
        for name in ("multiprocessing", "msgpack", "numpy", "h5py", "zarr", "clsas"):
            module = folder / f"{name}.py"
            module.write_text(f"open({str(ran)!r}, 'a').write({str(module)!r})\n")
            os.chown(module, other, other)
    os.chown(planted, other, other)
    found = subprocess.run(
        [sys.executable, private / "victim.py"],
        env=os.environ | {"TMPDIR": str(shared), "CLSAS_CACHE": str(private / "cache")},
        cwd=shared,
        capture_output=True,
        text=True,
        check=False,
    )
    assert not ran.exists(), ran.read_text()
    assert found.returncode == 0, found.stderr
    assert not [path for path in found.stdout.splitlines() if Path(path).is_relative_to(shared)]


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a folder to another user")
def test_a_folder_of_another_user_is_refused(tmp_path, monkeypatch):
    for each in tmp_path.parents:
        if not each.stat().st_mode & 0o001:
            each.chmod(0o711)  # so that others could reach the folder
    cache = tmp_path / "cache"
    (cache / "workers").mkdir(parents=True)
    os.chown(cache / "workers", 54321, 54321)
    monkeypatch.setenv("CLSAS_CACHE", str(cache))
    (said,) = run_with_workers(tmp_path)
    assert f"{cache / 'workers'} belongs to user 54321" in said
    assert "CLSAS_CACHE" in said


def test_ctrl_c_while_workers_start_is_heeded_once_they_have(monkeypatch):
    """So that no process is left behind."""
    from clsas.mosaics import workers

    events = []

    class Cluster:
        def __init__(self, **_):
            os.kill(os.getpid(), signal.SIGINT)
            events.append("started")

        def __enter__(self):
            return self

        def __exit__(self, *_):
            events.append("ended")

    monkeypatch.setattr(workers, "SpecCluster", Cluster)
    monkeypatch.setattr(workers, "Client", lambda cluster: cluster)
    with pytest.raises(KeyboardInterrupt), workers.local_client(1):
        events.append("ran")
    assert events == ["started", "ended", "ended"]  # the client, the cluster
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())


@pytest.mark.slow
def test_workers_do_not_heed_ctrl_c_even_if_they_started_again():
    from clsas.mosaics.workers import local_client

    blocked = "__import__('signal').pthread_sigmask(0, ())"
    with local_client(1) as client:
        assert signal.SIGINT in client.submit(eval, blocked, pure=False).result(timeout=60)
        client.restart()
        assert signal.SIGINT in client.submit(eval, blocked, pure=False).result(timeout=60)
