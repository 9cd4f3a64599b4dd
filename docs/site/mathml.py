"""Formulas of the documentation: a block of LaTeX becomes MathML while the site is built, so that a page needs no script for it."""

from typing import Any

from latex2mathml.converter import convert


def block(source: str, *_: Any, **__: Any) -> str:
    """The HTML of a ```math block, which GitHub shows as a formula too; called by pymdownx.superfences."""
    return f'<div class="formula">{convert(source, display="block")}</div>'
