"""Messages of commands name options and files, not arguments and functions of Python."""

import re
import shutil
import warnings
from dataclasses import replace

import click
import numpy as np
import pytest
from click.testing import CliRunner
from reliefs import flat_banks

import clsas
from clsas import cli
from clsas.cli.options import DeclaredOption
from clsas.cli.wording import command, error_message, in_options
from clsas.engine.data.validate import ArgumentError, ArgumentTypeError

GRID = ("--x", "-0.5:0.5:21", "--y", "31.5:32.5:21")
HEIGHTS = ("heights", "banks.h5", *GRID, "-o", "new.h5", "--search-m")
NAVIGATE = ("navigate", "pings.h5", "-o", "new.h5")
PLAN = ("plan", "low.h5", *GRID)
EXPORT = ("export", "image.h5", "new.tif")
# Names of arguments, attributes and functions, and tuples.
PYTHON = re.compile(r"(?<![\w./-])[a-z]+_[a-z_]+|\bclsas\.\w|\w\.\w+\(|\bNone\b|\('|\(-?[\d.]+, ")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("files")
    low, high = flat_banks()
    names = "samples", "first_range_m", "tx_m", "rx_m"
    arrays = {name: np.concatenate([getattr(low, name), getattr(high, name)]) for name in names}
    both = replace(low, **arrays, bank_numbers=np.repeat([0, 1], low.channels))
    clsas.save(folder / "low.h5", low)
    clsas.save(folder / "banks.h5", both)
    grid = clsas.Grid.plane((-0.5, 0.5, 21), (31.5, 32.5, 21))
    clsas.save(folder / "image.h5", clsas.Image(np.ones((21, 21), np.complex64), grid))
    pings = np.repeat(np.arange(4.0), 4)
    rx_m = np.stack([0.1 * pings + np.tile(0.05 * np.arange(4), 4), 0 * pings, 0 * pings], axis=1)
    tx_m = np.stack([0.1 * pings, 0 * pings, 0 * pings], axis=1)
    samples = np.ones((16, 200), np.complex64)
    clsas.save(
        folder / "pings.h5",
        clsas.RangeLines(
            samples=samples,
            first_range_m=np.full(16, 20.0),
            range_step_m=0.01,
            carrier_hz=100e3,
            tx_m=tx_m,
            rx_m=rx_m,
            sound_speed_m_s=1500.0,
        ),
    )
    (folder / "scene.toml").write_text('[image]\nbeam = { shape = "inverse", width_deg = 30 }\n')
    return folder


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ((*HEIGHTS, "0:1e9"), "two ascending numbers in m from -1e+08 to 1e+08, got 0:1e+09"),
        ((*HEIGHTS, "-9:40"), "--search-m must end below the sonar"),
        ((*HEIGHTS, "0:0.001"), "the two banks must be apart across the line of sight"),
        ((*HEIGHTS, "0:0.001"), "or more over --search-m, got phase"),
        ((*HEIGHTS, "-1:1", "--window-m", 9), "--window-m must be finite and > 0 and <= 1.05 m"),
        ((*HEIGHTS, "-1:1", "--x", "0:0:1"), "the grid of --x and --y must have at least 2 rows"),
        (("heights", "low.h5", *HEIGHTS[2:], "-1:1"), "low.h5 must have at least 2 receiver"),
        (("heights", "banks.h5", "pings.h5", *HEIGHTS[2:], "-1:1"), "the two banks must contain"),
        ((*NAVIGATE, "--range-m", "1:99"), "20 to 21.99 m, with the nearest first, got 1:99"),
        ((*NAVIGATE, "--unknown", "yaw"), "--unknown must include 'sway', got yaw"),
        ((*NAVIGATE, "--window-m", -1), "'--window-m': must be finite and > 0 m, got -1"),
        ((*NAVIGATE, "--yaw-sd-deg", 200), "<= 180 degrees, got 200"),
        ((*PLAN, "--beam-deg", 700), "'--beam-deg': must be finite and >= 0.001 and <= 180"),
        ((*PLAN, "--stages", "999x999"), "--stages must leave a line and a pixel"),
        ((*PLAN, "--z", "nan"), "'--z': must be finite m, got nan"),
        ((*PLAN, "--x", "1e9:2e9:3"), "'--x': stop must be finite"),
        ((*PLAN, "--device", "abacus"), "No device matches 'abacus' (--device)"),
        (("image", "image.h5", *GRID, "-o", "new.h5"), "must hold range lines (clsas compress"),
        (("convert", "banks.h5", "new.cphd"), "FILE must be of one bank, got 2: write --bank 0"),
        (("compress", "low.h5", "-o", "new.h5", "--window", "oak"), "a window of SciPy, such"),
        (("mosaic", "--lines", "low.h5", *GRID, "-o", "m.zarr", "--memory-mib", 1),
         "--memory-mib must be"),
        (("quality", "image.h5", "--near", "9,9"), "--near must be inside the image"),
        (("show", "image.h5", "--north-arrow"), "--north-arrow must be off for an image without a"),
        ((*EXPORT, "--origin", "91,0", "--heading-deg", 0), "latitude of --origin must be from"),
        ((*EXPORT, "--pixel-m", 1, "--origin", "60,5", "--heading-deg", 0),
         "no effect on .tif with --as db without --north-up"),
        (EXPORT, "INPUT must have a georeference for a GeoTIFF"),
        (EXPORT, "give --crs (or --origin), or form the image"),
        (("known-points", "low.h5", "--point", "0,900", "-o", "new.h5"), "--point must lie where"),
        # A file keeps its own words.
        (("plan", "low.h5", "--scene", "scene.toml", *GRID), "scene.toml: [image.beam] element"),
    ],
)  # fmt: skip
def test_messages_name_what_the_user_typed(arguments, expected, folder, monkeypatch):
    monkeypatch.chdir(folder)
    result = CliRunner().invoke(cli.main, [str(each) for each in arguments], prog_name="clsas")
    assert result.exit_code in (1, 2)
    assert expected in result.stderr
    if "scene.toml" not in arguments:
        assert not PYTHON.search(result.stderr), result.stderr


def said(text, options=("search_m", "unknowns", "beam", "scene", "bank"), word=in_options):
    """Return what a command with some options says instead of a text."""
    found = []

    @command(context_settings={"ignore_unknown_options": True})
    def run(**_):
        found.append(word(text))

    for name in options:
        option = "--unknown" if name == "unknowns" else f"--{name.replace('_', '-')}"
        argument = "number" if name == "bank" else name
        run.params.append(DeclaredOption([option, name], argument=argument))
    run.main([], standalone_mode=False)
    return found[0]


def test_every_kind_of_name_is_translated():
    for text, expected in [
        ("`search_m=(-1.0, 2.5)` is wide", "--search-m -1:2.5 is wide"),
        ("the grid larger or `search_m` smaller", "the grid larger or --search-m smaller"),
        ("Leave out yaw with `unknowns=('sway',)`", "Leave out yaw with --unknown sway"),
        ("`search_m=depth` has no value", "--search-m depth has no value"),
        ("`search_m[0]` is first", "--search-m[0] is first"),
        ("use `clsas.autofocus`", "use clsas focus"),
        ("x must hold `RangeLines`, got `Image`", "x must hold range lines, got an image"),
        ("need the same `sound_speed`", "need the same sound-speed profile"),
        ("`beam` is an option, the beam is not", "--beam is an option, the beam is not"),
        ("`number` must be 0", "--bank must be 0"),
        ("use `lines.bank(2)`", "use --bank 2"),
        ("`scene.select(...)` is no option", "`scene.select(...)` is no option"),
        ("the key search_m and `other` stay", "the key search_m and `other` stay"),
        ("`search_m\n`", "`search_m\n`"),
    ]:
        assert said(text) == expected
    assert said("use `lines.bank(2)`", options=()) == "use clsas convert --bank 2"
    assert said("use `Georeference.local`", options=("origin",)) == "use --origin"
    assert said("use `Georeference.local`") == "use `Georeference.local`"  # no such option
    assert in_options("`search_m`") == "`search_m`"  # no command is running


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (
            ArgumentError("search_m", "end below `beam`", (-1.0, 2.5), "use `clsas.heights`"),
            "--search-m must end below --beam, got -1:2.5: use clsas heights",
        ),
        (
            ArgumentError("unknowns", "be known", ("yaw", "sway"), where="scene.toml: [focus]"),
            "scene.toml: [focus] unknowns must be known, got ('yaw', 'sway')",
        ),
        (ArgumentTypeError("shift_m", "be a number"), "shift_m must be a number"),
        (ValueError("search_m is `search_m`"), "search_m is --search-m"),
    ],
)
def test_errors_of_arguments_name_options(error, expected):
    assert said(error, word=error_message) == expected


@pytest.mark.parametrize(
    "name",
    [
        "tx_m/image.h5",
        "clsas.heights.h5",
        "my sound_speed/x and rx_m.h5",
        "search_m.h5",
        "a.b or Image",
    ],
)
def test_paths_keep_their_words(name, folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    shutil.copy(folder / "image.h5", path)
    for typed in (name, path):
        arguments = "convert", str(typed), "new.h5", "--compensate-density"
        result = CliRunner().invoke(cli.main, arguments, prog_name="clsas")
        assert result.exit_code == 1
        assert result.stderr.startswith(f"Error: {typed} must hold range lines"), result.stderr


def test_warnings_are_translated_too(folder, monkeypatch):
    monkeypatch.chdir(folder)
    arguments = ("image", "banks.h5", *GRID, "-o", "new.h5", "--exact")
    with warnings.catch_warnings():
        result = CliRunner().invoke(cli.main, arguments, prog_name="clsas")
    assert result.exit_code == 0, result.output
    assert "--bank 0 selects the first bank; " in result.stderr
    assert not PYTHON.search(result.stderr)
    monkeypatch.setattr(cli, "_worded", str)
    before = CliRunner().invoke(cli.main, arguments, prog_name="clsas")
    assert "lines.bank(0)" in before.stderr  # so that there was something to translate


def test_every_command_has_its_options_translated():
    context = click.Context(cli.main)
    for name in cli.main.list_commands(context):
        found = cli.main.get_command(context, name)
        assert type(found).__name__ == "Command", name
        assert type(found).__module__ == "clsas.cli.wording"
