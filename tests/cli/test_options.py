"""Options are declared once: units, limits, defaults and help of the library's arguments."""

import ast
import re
from pathlib import Path
from typing import get_args

import click
import pytest

import clsas
from clsas import cli
from clsas.cli.options import DeclaredOption
from clsas.cli.parameters import SPAN, STAGES
from clsas.engine.data.declared import Declared

for module in ("zarr", "matplotlib", "rasterio", "distributed"):
    pytest.importorskip(module)

ROOM = Path(clsas.__file__).parent
UNIT = re.compile(r"\((?:m|s|dB|Hz|%|MiB|rad|degrees|m/s|pings|wavelengths)\)")
KINDS = {kind.__name__ for kind in get_args(Declared)}
OWN_KEYS = {"patches", "memory_mib", "bank"}  # of scene files, which no function takes as they are


def options():
    context = click.Context(cli.main)
    for name in cli.main.list_commands(context):
        for param in cli.main.get_command(context, name).params:
            if isinstance(param, click.Option):
                yield f"{name} {param.opts[0]}", param


def declarations():
    """Yield the place and the help of every declaration in the package."""
    for path in ROOM.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Name)):
                continue
            if node.func.id in KINDS:
                helps = [each.value for each in node.keywords if each.arg == "help"]
                helps += node.args if node.func.id == "Flag" else []
                yield f"{path.name}:{node.lineno}", [ast.literal_eval(each) for each in helps]


def test_options_with_values_come_from_declarations():
    plain = click.types.FloatParamType, click.types.IntParamType, click.Choice
    for name, option in options():
        if isinstance(option.type, plain) or option.type in (SPAN, STAGES):
            assert isinstance(option, DeclaredOption), name


def test_the_command_line_and_scene_files_state_no_units_or_limits():
    for path in (*ROOM.glob("cli/*.py"), ROOM / "files" / "scene_tables.py"):
        tree = ast.parse(path.read_text())
        for node in ast.walk(tree):
            if isinstance(node, ast.keyword) and node.arg == "help":
                assert not UNIT.search(ast.unparse(node.value)), (path.name, ast.unparse(node))
        own = [
            target.target.id
            for target in ast.walk(tree)
            if isinstance(target, ast.AnnAssign)
            and re.search(r"\b(?:Number|Count|Choice|Names|Span|Other)\(", ast.unparse(target))
        ]
        assert set(own) <= OWN_KEYS, path.name


def test_every_declaration_is_complete_and_made_once():
    made = {}
    for place, helps in declarations():
        assert len(helps) == 1, place
        (text,) = helps
        assert re.fullmatch(r"[A-Z].*\.", text), place
        assert not UNIT.search(text), place
        assert text not in made, (place, made[text])
        made[text] = place
    assert len(made) > 60


def test_help_states_unit_and_default():
    shown = {name: option.help for name, option in options()}
    assert "(m)." in shown["heights --window-m"]
    assert shown["heights --tolerance-db"].endswith("(dB). [-85 to -10; default: -40]")
    assert shown["image --tolerance-db"].endswith("(dB). [-85 to -10; default: -50]")
    assert shown["known-points --unknown"].endswith("several. [default: time_offset, sound_speed]")
