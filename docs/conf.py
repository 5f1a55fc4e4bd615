"""Sphinx's settings: `scripts/docs` builds the site from the pages in this folder, offline."""

from __future__ import annotations

import collections
import re
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert

import clsas

project = "clsas"
author = "The clsas developers"
project_copyright = "The clsas developers, Apache-2.0"
version = release = clsas.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "numpydoc",
    "sphinx_click",
    "sphinx_copybutton",
]
exclude_patterns = ["figures", "templates"]
templates_path = ["templates"]
default_role = "literal"  # `names` in docstrings

myst_heading_anchors = 3  # links to headings, as on GitHub
myst_fence_as_directive = ["math"]  # ```math, as on GitHub

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # docstrings state types and shapes
add_module_names = False  # what users import is `clsas.NAME`; modules are private
numpydoc_show_class_members = False  # autodoc shows them
numpydoc_xref_param_type = True  # links types of parameters that are public classes
numpydoc_xref_ignore = "all"  # other types stay text: the site links to no other site's objects

autosummary_generate = True  # one page per public name, in docs/reference/generated
autosummary_ignore_module_all = False
# Some file systems ignore case, and `clsas.Plan` and `clsas.plan` both have a page.
_BY_NAME = collections.Counter(name.lower() for name in clsas.__all__)
autosummary_filename_map = {
    f"clsas.{name}": f"clsas.{name}_class"
    for name in clsas.__all__
    if _BY_NAME[name.lower()] > 1 and not name.islower()
}
# Classes of returned objects, which nobody imports: their pages do not show the private module.
autosummary_filename_map |= {
    f"clsas.{path}": f"clsas.{path.rpartition('.')[2]}"
    for path in (
        "engine.factorized.plan.ExactImage",
        "engine.factorized.plan.Factorization",
        "engine.factorized.plan.Prediction",
        "measures.quality.Cut",
        "measures.quality.PointResponse",
        "mosaics.document.Record",
        "engine.device.device.DeviceInfo",
    )
}

copybutton_exclude = ".linenos, .gp, .go"  # copies code, without prompts and output

smartquotes = False  # options are --so
html_theme = "furo"
html_title = f"clsas {version}"
html_static_path = ["static"]
html_css_files = ["clsas.css"]
html_copy_source = False
html_show_sphinx = False
html_math_renderer = "mathml"


def as_plain_text(*event: Any) -> None:
    """Keep |x| and a * b of docstrings, which are plain text, from being read as markup."""
    lines: list[str] = event[-1]
    lines[:] = [re.sub(r"(`[^`]*`)|([|*])", lambda m: m[1] or f"\\{m[2]}", line) for line in lines]


def with_links(*event: Any) -> None:
    """Link public classes, and names that begin with `clsas.`, in the text of docstrings."""

    def linked(match: re.Match[str]) -> str:
        prefix, name, rest = match.groups(default="")
        if name not in clsas.__all__ or (name.islower() and not prefix):
            return match[0]
        return f":py:obj:`{prefix}{name}{rest} <clsas.{name}{rest}>`"

    lines: list[str] = event[-1]
    pattern = re.compile(r"(?<![\w`:])`(clsas\.)?(\w+)((?:\.\w+)*)`(?!`)")
    lines[:] = [pattern.sub(linked, line) for line in lines]


def only_own_types(app: Any) -> None:
    """Replace numpydoc's links to Python's and NumPy's types by those to public classes."""
    app.config.numpydoc_xref_aliases_complete = {
        name: f"clsas.{name}" for name in clsas.__all__ if not name.islower()
    }


def without_private_arguments(*event: Any) -> tuple[str, str] | None:
    """Leave arguments that begin with an underscore out of signatures."""
    signature, returned = event[-2:]
    return signature and (re.sub(r", _\w+(=[^,)]*)?", "", signature), returned)


def setup(app: Any) -> None:
    """Connect the functions above, and draw equations as MathML, which needs no script."""
    app.connect("autodoc-process-docstring", as_plain_text, priority=100)  # before numpydoc
    app.connect("autodoc-process-docstring", with_links, priority=900)  # after numpydoc
    app.connect("builder-inited", only_own_types)
    app.connect("autodoc-process-signature", without_private_arguments)

    def inline(writer: Any, node: nodes.Element) -> None:
        writer.body.append(convert(node.astext()))
        raise nodes.SkipNode

    def block(writer: Any, node: nodes.Element) -> None:
        equation = convert(node.astext(), display="block")
        writer.body.append(f'<div class="equation">{equation}</div>')
        raise nodes.SkipNode

    app.add_html_math_renderer("mathml", (inline, None), (block, None))
