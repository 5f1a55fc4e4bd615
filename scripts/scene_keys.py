"""Tables of keys of scene files in the documentation, made from their declarations.

`docs/scene-files.md` shows the declared keys of a table between two comments,
`<!-- keys: TABLE -->` and `<!-- end of keys -->`. `scripts/pages tables` fills in what stands
between them.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from pydantic import BaseModel
from pydantic_core import PydanticUndefined

from clsas.engine.data.declared import (
    Choice,
    Declared,
    Names,
    Positions,
    Span,
    declared,
    limits_in_words,
)
from clsas.files.scene_tables import SceneTables
from clsas.files.tables import models_in

PAGE = Path(__file__).resolve().parents[1] / "docs" / "scene-files.md"
SHOWN = re.compile(r"(<!-- keys: (\S+) -->\n).*?(<!-- end of keys -->)", re.DOTALL)


def filled(text: str) -> str:
    """Return the text of a page with the present rows of the tables that it shows."""
    return SHOWN.sub(lambda found: f"{found[1]}\n{rows(found[2])}\n{found[3]}", text)


def rows(name: str) -> str:
    """Return the declared keys of a table, such as "image.beam", as Markdown."""
    model: Any = SceneTables
    for part in name.split("."):
        model = next(models_in(model.model_fields[part].annotation))
    lines = ["| key | unit | default | allowed | meaning |", "|---|---|---|---|---|"]
    for key, what in declared(model).items():
        unit, meaning = getattr(what, "unit", ""), what.help.removesuffix(".")
        if meaning[1].islower():
            meaning = meaning[0].lower() + meaning[1:]
        cells = f"`{key}`", unit, _default(model, key, what), _allowed(what), meaning
        lines.append("| " + " | ".join(cells).replace("|  |", "| |").replace("|  |", "| |") + " |")
    return "\n".join(lines) + "\n"


def _default(model: type[BaseModel], key: str, what: Declared) -> str:
    value = model.model_fields[key].default
    if value is PydanticUndefined:
        return "required"
    return getattr(what, "default", "") if value is None else f"`{json.dumps(value)}`"


def _allowed(what: Declared) -> str:
    if isinstance(what, Choice | Names):
        return ", ".join(f"`{json.dumps(each)}`" for each in what.allowed)
    form = {Span: "`[low, high]`", Positions: "`[[x, y, z], ...]`"}.get(type(what), "")
    return ", ".join(part for part in (form, limits_in_words(what)) if part)
