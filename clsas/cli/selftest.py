"""Command that tests the accuracy of a device: selftest."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import click

from clsas.cli import options
from clsas.cli.outputs import print_json, printable, progress_bar, say
from clsas.cli.wording import command
from clsas.engine.device.device import open_device

if TYPE_CHECKING:
    from clsas.selftest.accuracy import Result


@command()
@options.device
@options.as_json
@click.pass_context
def selftest(ctx: click.Context, device: str | None, as_json: bool) -> None:
    """Test the accuracy of a device, in about a minute.

    Every imager forms images of extreme scenes whose ideal image is known analytically. The exit
    code is 1 if the error of any image exceeds its bound, or an image cannot be formed.

    \b
    Example:  clsas selftest --device 0
    """
    from clsas.selftest import accuracy

    opened, begun = open_device(device), time.perf_counter()
    with progress_bar("testing") as progress:
        results = accuracy.run(opened, progress=progress)
    seconds = time.perf_counter() - begun
    missed = sum(not result.passed for result in results)
    if as_json:
        print_json(
            {
                "device": opened.info.label,
                "driver": opened.info.driver,
                "seconds": seconds,
                "passed": not missed,
                "results": [{**vars(result), "verdict": _verdict(result)} for result in results],
            }
        )
    else:
        say(f"{opened.info.label}, driver {opened.info.driver}; errors in dB")
        say(f"{'asked':>6} {'measured':>9} {'bound':>6}  verdict  case")
        for result in results:
            asked = "-" if result.asked_db is None else f"{result.asked_db:.0f}"
            measured = "-" if result.measured_db is None else f"{result.measured_db:.1f}"
            failure = f": {printable(result.failure)}" if result.failure else ""
            say(
                f"{asked:>6} {measured:>9} {result.bound_db:6.0f}  "
                f"{_verdict(result):7}  {result.case}{failure}"
            )
        say(f"{len(results) - missed} of {len(results)} within bounds, {seconds:.0f} s")
    if missed:
        ctx.exit(1)


def _verdict(result: Result) -> str:
    if result.failure:
        return "FAILED"
    return "ok" if result.passed else "MISSED"
