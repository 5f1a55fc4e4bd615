"""Sphinx's settings: `scripts/docs` builds the site from the pages in this folder, offline."""

from __future__ import annotations

import re
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert

import clsas

project = "clsas"
author = "The clsas developers"
project_copyright = "The clsas developers, Apache-2.0"
version = release = clsas.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "numpydoc", "sphinx_click"]
exclude_patterns = ["figures"]
default_role = "literal"  # `names` in docstrings

myst_heading_anchors = 3  # links to headings, as on GitHub
myst_fence_as_directive = ["math"]  # ```math, as on GitHub

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # docstrings tell types and shapes
numpydoc_show_class_members = False  # autodoc shows them

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


def setup(app: Any) -> None:
    """Draw equations as MathML, which browsers show without a script from elsewhere."""
    app.connect("autodoc-process-docstring", as_plain_text, priority=100)  # before numpydoc

    def inline(writer: Any, node: nodes.Element) -> None:
        writer.body.append(convert(node.astext()))
        raise nodes.SkipNode

    def block(writer: Any, node: nodes.Element) -> None:
        equation = convert(node.astext(), display="block")
        writer.body.append(f'<div class="equation">{equation}</div>')
        raise nodes.SkipNode

    app.add_html_math_renderer("mathml", (inline, None), (block, None))
