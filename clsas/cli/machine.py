"""Commands for a new machine: devices, demo."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import click

import clsas
from clsas.cli import options
from clsas.cli.outputs import print_json, printable, progress_bar, say
from clsas.cli.parameters import File, need_matplotlib
from clsas.cli.wording import command
from clsas.engine.device.device import choose, open_device
from clsas.selftest import demo as demonstration

if TYPE_CHECKING:
    from clsas.engine.factorized.costs import KnownCosts


@command()
@click.option(
    "--measure", is_flag=True,
    help="First measure the costs of the device that is used again, which takes 0.3 to 0.6 s.",
)  # fmt: skip
@options.as_json
def devices(measure: bool, as_json: bool) -> None:
    """List OpenCL devices, and show which one is used and why.

    Plans predict times from the costs of a device; their origin and age are listed too.

    \b
    Example:  CLSAS_DEVICE=0 clsas devices
    """
    from clsas.engine.factorized import measured_costs

    used, reason = choose()
    if measure:
        measured_costs.scaled(open_device(used.index))
    found = clsas.list_devices()
    known = {info.index: measured_costs.load(info) for info in found}
    if as_json:
        origins = {
            index: {"source": k.source, "measured": k.measured} for index, k in known.items()
        }
        print_json(
            {"devices": found, "used": used.index, "reason": reason,
             "costs": origins, "costs_file": measured_costs.path()}
        )  # fmt: skip
        return
    for info in found:
        in_stages = "" if info.stage_width == info.width else f" ({info.stage_width} in stages)"
        say(
            f"{info.index}  {info.label}\n"
            f"   driver {info.driver}\n"
            f"   {info.kind.upper()}, {info.compute_units} compute units, "
            f"{info.memory_bytes / 2**30:.1f} GiB ({info.max_buffer_bytes / 2**30:.1f} GiB in one "
            f"buffer), {'fp64' if info.fp64 else 'no fp64'}, vectors of {info.width}{in_stages}\n"
            f"   costs: {_origin(known[info.index])}"
        )
    say(f"Used: {used.index} ({reason})\nCosts are stored in {printable(measured_costs.path())}")


def _origin(known: KnownCosts) -> str:
    """Return the origin of costs and their age, in words."""
    if known.source == "default":
        return "defaults; the first plan with a tolerance measures the device for 0.3 to 0.6 s"
    days = (datetime.now(UTC) - datetime.fromisoformat(known.measured)).days
    age = "today" if days < 1 else f"{days} day{'s' * (days > 1)} ago"
    return f"defaults, scaled by a short measurement on {known.measured[:10]} ({age})"


@command()
@click.option(
    "-o", "--out", type=File(file_okay=False), default="clsas-demo",
    show_default=True, help="Folder for the files: a new one, or that of an earlier demo.",
)  # fmt: skip
@options.device
@options.as_json
def demo(out: Path, device: str | None, as_json: bool) -> None:
    """Simulate, image and measure the thesis's wide-beam case.

    The folder then holds the scene file, the files of every step, and pictures.

    \b
    Example:  clsas demo --out my-demo
    """
    need_matplotlib()
    show_line = (lambda line: None) if as_json else say
    results = demonstration.run(out, device=device, say=show_line, progress=progress_bar)
    if as_json:
        print_json(results)
