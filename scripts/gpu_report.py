"""Run the tests, tuning and benchmarks of clsas on one device, and write a report in Markdown.

`scripts/gpu` runs this in an environment with everything that it needs.
"""

import argparse
import os
import platform
import subprocess
import sys
import time
from datetime import UTC, datetime
from pathlib import Path

from clsas.engine.device.device import DeviceError, open_device

ROOT = Path(__file__).parents[1]
PYTHON = sys.executable
LIMIT_S = 3600
"""Limit for each part. A part that hangs is ended, and the next one runs."""

PARTS = {
    "Devices": [PYTHON, "-m", "clsas", "devices"],
    "Self test": [PYTHON, "-m", "clsas", "selftest", "--device", "{device}"],
    "Tests": [PYTHON, "-m", "pytest", "-q", "--durations=10"],
    "Tuning": [PYTHON, "scripts/bench", "tuning", "--device", "{device}"],
    "Exact imaging": [PYTHON, "scripts/bench", "speed", "--device", "{device}"],
    "Factorized imaging": [PYTHON, "scripts/bench", "factorized", "--device", "{device}"],
    "Scaling": [PYTHON, "scripts/bench", "scaling", "--largest", "8192", "--device", "{device}"],
}

QUICK = {
    "Devices": PARTS["Devices"],
    "Self test": PARTS["Self test"],
    "Tests": [*PARTS["Tests"], "tests/engine/device"],
    "Factorized imaging": [*PARTS["Factorized imaging"], "--case", "ffbp-thesis"],
    "Scaling": [PYTHON, "scripts/bench", "scaling", "--largest", "512", "--device", "{device}"],
}
"""A selection that takes some minutes and shows whether a report can be made."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="gpu", help="device, as listed by `clsas devices`")
    parser.add_argument("--out", type=Path, default=Path("gpu-report.md"))
    parser.add_argument("--only", default="", help="text that the name of a part must contain")
    parser.add_argument(
        "--quick", action="store_true", help="run only some parts, which take minutes"
    )
    given = parser.parse_args()
    parts = QUICK if given.quick else PARTS
    try:
        info = open_device(given.device).info
    except DeviceError as error:
        print(f"Error: {error}", file=sys.stderr)
        return 1
    now = datetime.now(UTC)
    with given.out.open("w") as report:
        report.write(
            f"# clsas on {info.name}\n\n{now:%d %B %Y}, commit {commit()}. Driver {info.driver} of "
            f"{info.platform}, {info.compute_units} compute units, "
            f"{info.memory_bytes / 2**30:.1f} GiB; {platform.platform()}, {os.cpu_count()} cores.\n"
        )
        failed = [
            name
            for name, command in parts.items()
            if given.only in name and not run(name, command, given.device, report)
        ]
        ended = f"failed: {', '.join(failed)}" if failed else "all parts succeeded"
        report.write(f"\n{ended[0].upper()}{ended[1:]}.\n")
    print(f"wrote {given.out}; {ended}")
    return int(bool(failed))


def run(name, command, device, report):
    """Run a part and write its output to the report; return whether it succeeded."""
    command = [word.format(device=device) for word in command]
    shown = " ".join(["python" if word == PYTHON else word for word in command])
    print(f"== {name}: {shown}", flush=True)
    start = time.monotonic()
    try:
        done = subprocess.run(
            command, cwd=ROOT, env=os.environ | {"CLSAS_DEVICE": device}, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=LIMIT_S,
        )  # fmt: skip
        printed, ended = done.stdout, f"exit code {done.returncode}"
    except subprocess.TimeoutExpired as error:
        printed, ended = (error.stdout or b"").decode(errors="replace"), "ended by the limit"
    seconds = time.monotonic() - start
    text = printed if printed.startswith("|") else f"```\n{printed}```\n"
    report.write(f"\n## {name}\n\n`{shown}`: {ended} after {seconds:.0f} s.\n\n{text}")
    report.flush()
    return ended == "exit code 0"


def commit():
    """Return the commit of this checkout, or why it is unknown."""
    command = ["git", "-C", ROOT, "rev-parse", "--short", "HEAD"]
    try:
        done = subprocess.run(command, text=True, capture_output=True)
    except FileNotFoundError:
        return "unknown (git is not installed)"
    return done.stdout.strip() or "unknown (no git checkout)"


if __name__ == "__main__":
    sys.exit(main())
