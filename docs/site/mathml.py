"""Formulas of the documentation as MathML, which needs no script."""

import re
from typing import Any

from latex2mathml.converter import convert
from pymdownx.superfences import SuperFencesException


def block(source: str, *_: Any, **__: Any) -> str:
    """Return the HTML of a ```math block; pymdownx.superfences calls it.

    Raises:
        SuperFencesException: the converter does not know a command; it ends the build.
    """
    formula = convert(source, display="block")
    unknown = re.findall(r"\\\w+|>&<", formula)
    if unknown:
        raise SuperFencesException(
            f"a formula with {', '.join(unknown)}, which latex2mathml does not know:\n{source}"
        )
    return f'<div class="formula">{formula}</div>'
