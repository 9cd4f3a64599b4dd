"""Formulas of the documentation: a block of LaTeX becomes MathML while the site is built, so that a page needs no script for it."""

import re
from typing import Any

from latex2mathml.converter import convert
from pymdownx.superfences import SuperFencesException


def block(source: str, *_: Any, **__: Any) -> str:
    """The HTML of a ```math block, which GitHub shows as a formula too; called by pymdownx.superfences.

    Raises SuperFencesException, which ends the build, for a command or an environment that the converter does not know and would
    print as it stands.
    """
    formula = convert(source, display="block")
    unknown = re.findall(r"\\\w+|>&<", formula)
    if unknown:
        raise SuperFencesException(
            f"a formula with {', '.join(unknown)}, which latex2mathml does not know:\n{source}"
        )
    return f'<div class="formula">{formula}</div>'
