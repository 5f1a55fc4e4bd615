"""Try to reach the workers of `clsas mosaic --workers` as another local user would.

    python scripts/attack/workers.py --workers 2

The script lists every port on which processes of the run listen. It sends each port requests in
HTTP and HTTPS, and in the protocol of Dask: in plain text, with TLS, and with a certificate that it
made itself. If run as root, it does so as the user nobody. The exit code is 1 if any port answers.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import multiprocessing
import os
import socket
import ssl
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import psutil
from case import command, write_scene
from distributed import Security
from distributed.core import connect

PAGES = ("/", "/info/main/workers.html", "/json/counts.json", "/metrics", "/health", "/status")
TIMEOUT_S = 2.0  # for one answer
NOBODY = 65534
SETTLED_S = 3.0  # after which all ports of a worker are open


def listening(pid: int) -> dict[tuple[str, int], str]:
    """Return the addresses where a process and its children listen, and which of them does."""
    found = {}
    with contextlib.suppress(psutil.NoSuchProcess):
        root = psutil.Process(pid)
        for process in (root, *root.children(recursive=True)):
            with contextlib.suppress(psutil.NoSuchProcess):
                for each in process.net_connections("inet"):
                    if each.status == psutil.CONN_LISTEN:
                        found[each.laddr[:2]] = "main" if process == root else "worker"
    return found


def answers_http(address: tuple[str, int], page: str, encrypted: bool) -> bool:
    """Return whether a port answers a request for a page."""
    try:
        with socket.create_connection(address, TIMEOUT_S) as plain:
            connection = plain
            if encrypted:
                context = ssl._create_unverified_context()
                connection = context.wrap_socket(plain)
            with connection:
                connection.sendall(f"GET {page} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
                return connection.recv(16).startswith(b"HTTP/")
    except OSError:  # refused, reset, timed out, or rejected by TLS
        return False


def answers_dask(address: tuple[str, int], security: Security | None, protocol: str) -> bool:
    """Return whether a port tells a Dask client its identity, the step before running code."""

    async def ask() -> bool:
        arguments = {} if security is None else security.get_connection_args("client")
        url = f"{protocol}://{address[0]}:{address[1]}"
        comm = await connect(url, timeout=TIMEOUT_S, **arguments)
        try:
            await comm.write({"op": "identity", "reply": True})
            return bool(await asyncio.wait_for(comm.read(), TIMEOUT_S))
        finally:
            comm.abort()

    try:
        return asyncio.run(asyncio.wait_for(ask(), 3 * TIMEOUT_S))
    except (TimeoutError, OSError, TypeError, ValueError, RuntimeError):
        return False


def without_certificate() -> Security:
    """Return what connects by TLS and shows no certificate."""

    class Bare(Security):
        def get_connection_args(self, role: str) -> dict[str, object]:
            context = ssl._create_unverified_context()
            return super().get_connection_args(role) | {"ssl_context": context}

    return Bare()


def reached(addresses: list[tuple[str, int]]) -> list[str]:
    """Return the answers of some ports to a client from outside the run."""
    with ThreadPoolExecutor(max(len(addresses), 1)) as pool:
        return [each for answers in pool.map(reached_at, addresses) for each in answers]


def reached_at(address: tuple[str, int]) -> list[str]:
    """Return the answers of one port."""
    name = f"{address[0]}:{address[1]}"
    found = [
        f"{name} answers {'HTTPS' if encrypted else 'HTTP'} {page}"
        for page in PAGES
        for encrypted in (False, True)
        if answers_http(address, page, encrypted)
    ]
    ways = {
        "in plain text": (None, "tcp"),
        "without a certificate": (without_certificate(), "tls"),
        "with another certificate": (Security.temporary(), "tls"),
    }
    found += [
        f"{name} answers Dask {way}" for way, how in ways.items() if answers_dask(address, *how)
    ]
    if not address[0].startswith("127.") and address[0] != "::1":
        found.append(f"{name} can be reached from other machines")
    return found


def reached_by_another(addresses: list[tuple[str, int]]) -> list[str]:
    """Return the result of `reached` as the user nobody, if this process can change users."""
    context = multiprocessing.get_context("fork")
    ours, theirs = context.Pipe()

    def ask() -> None:
        if os.geteuid() == 0:
            os.setgroups([])
            os.setgid(NOBODY)
            os.setuid(NOBODY)
        theirs.send((os.geteuid(), reached(addresses)))
        os._exit(0)  # without waiting for threads with unanswered requests

    process = context.Process(target=ask)
    process.start()
    user, found = ours.recv() if ours.poll(600) else (None, ["the requests did not end"])
    process.join()
    print(f"tried {len(addresses)} ports as user {user}")
    return found


def attack(folder: Path, workers: int) -> list[str]:
    """Start a run, try all of its ports, let it finish, and return the answers."""
    scene = write_scene(folder)
    subprocess.run(command(scene, folder / "alone.zarr"), check=True, capture_output=True)
    survey = folder / "survey"
    survey.mkdir()
    next(folder.glob("*.lines.h5")).rename(survey / "0.h5")
    # A run that waits for more files lives until all ports have been tried.
    arguments = [*command(scene, folder / "a.zarr", workers), "--lines", str(survey)]
    process = subprocess.Popen(
        [*arguments, "--follow", "--idle-s", "3600"],
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
    )
    try:
        found = {}
        while list(found.values()).count("worker") < workers:
            if process.poll() is not None:
                raise RuntimeError(f"the run failed: {process.stderr.read()}")
            time.sleep(0.1)
            found = listening(process.pid)
        time.sleep(SETTLED_S)
        found = listening(process.pid)
        for (host, port), who in sorted(found.items()):
            print(f"{who} listens on {host}:{port}")
        answers = reached_by_another(list(found))
        (survey / "end").touch()
        if process.wait(600):
            raise RuntimeError(f"the run failed: {process.stderr.read()}")
    finally:
        process.kill()
    return answers


def main() -> None:
    """Attack the workers, and report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="workers-") as folder:
        answers = attack(Path(folder), options.workers)
    for each in answers:
        print("REACHED:", each)
    if answers:
        sys.exit(1)
    print("nothing was reached")


if __name__ == "__main__":
    main()
