"""Print the table of docs/how-to/devices.md from the results of `scripts/drivers`."""

import json
import re
import sys
from pathlib import Path
from statistics import median

HARDWARE = {
    "pypi": "CPUs, by `pip install clsas[pocl]`",
    "pocl": "CPUs, by Debian 13",
    "rusticl": "Mesa's compiler, with vectors of 4",
    "rusticl-gpu": "AMD and Intel GPUs: one lane, work-groups of 64",
}
CASES = ("bp-2k", "ffbp-2k")


def main() -> None:
    folder = Path(sys.argv[1])
    seconds = {driver: bench_seconds(folder / f"{driver}.bench") for driver in HARDWARE}
    print("| driver | version | stands for | self-test | fast tests | bp-2k | ffbp-2k |")
    print("|---|---|---|---|---|---|---|")
    for driver, hardware in HARDWARE.items():
        if not list(folder.glob(f"{driver}.*")):
            continue
        version, passed = selftest(folder / f"{driver}.selftest")
        times = [relative(seconds[driver][case], seconds["pypi"][case]) for case in CASES]
        cells = [driver, version, hardware, passed, tests(folder / f"{driver}.tests"), *times]
        print(f"| {' | '.join(cells)} |")


def selftest(path: Path) -> tuple[str, str]:
    """Return the driver's version, and the number of images within their bounds."""
    if not path.exists() or not path.stat().st_size:
        return "-", "ended early" if path.exists() else "-"
    found = json.loads(path.read_text())
    passed = sum(each["verdict"] == "ok" for each in found["results"])
    return found["driver"], f"{passed} of {len(found['results'])}"


def tests(path: Path) -> str:
    """Return the counts that pytest printed."""
    if not path.exists():
        return "-"
    counted = re.findall(r"(\d+ (?:failed|passed|errors?))", path.read_text()[-500:])
    return ", ".join(counted) or "ended early"


def bench_seconds(path: Path) -> dict[str, list[float]]:
    """Return the seconds of every turn by case; planning factorized images is not included."""
    seconds = {case: [] for case in CASES}
    for line in path.read_text().splitlines() if path.exists() else ():
        found = json.loads(line)
        seconds[found["case"]].append(found["seconds"]["median"])
    return seconds


def relative(seconds: list[float], reference: list[float]) -> str:
    """Return the median of a driver's times, and of their ratios to the reference turn by turn."""
    if not seconds:
        return "-"
    shown = f"{median(seconds):.3g} s"
    if len(seconds) != len(reference):
        return shown
    ratio = median(one / other for one, other in zip(seconds, reference, strict=True))
    return f"{shown} ({ratio:.2g})"


if __name__ == "__main__":
    main()
