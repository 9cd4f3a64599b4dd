"""Show a notebook of `notebooks/` as a page of the documentation, with its outputs."""

import base64
import html
import json
import re
from pathlib import Path
from typing import Any

import markdown
from pygments import highlight
from pygments.formatters import HtmlFormatter
from pygments.lexers import PythonLexer

FOLDER = Path(__file__).parent.parent.parent / "notebooks"
PYTHON, HTML = PythonLexer(), HtmlFormatter(cssclass="highlight", wrapcode=True)


def block(source: str, *_: Any, **__: Any) -> str:
    """Return the HTML of a ```notebook block, which names a file; pymdownx.superfences calls it."""
    cells = json.loads((FOLDER / f"{source.strip()}.ipynb").read_text())["cells"]
    return "\n".join(_cell(cell) for cell in cells)


def _cell(cell: dict[str, Any]) -> str:
    text = "".join(cell["source"])
    if cell["cell_type"] == "markdown":
        return markdown.markdown(_linked(text), extensions=["tables", "fenced_code", "sane_lists"])
    return highlight(text, PYTHON, HTML) + "".join(_output(each) for each in cell["outputs"])


def _output(output: dict[str, Any]) -> str:
    data = output.get("data", {"text/plain": output.get("text", "")})
    if "image/png" in data:
        return f'<img alt="figure" src="data:image/png;base64,{"".join(data["image/png"])}">'
    if "image/svg+xml" in data:
        svg = base64.b64encode("".join(data["image/svg+xml"]).encode()).decode()
        return f'<img alt="figure" src="data:image/svg+xml;base64,{svg}">'
    if "text/markdown" in data:
        return markdown.markdown("".join(data["text/markdown"]), extensions=["tables"])
    if "text/html" in data:
        return "".join(data["text/html"])
    return f"<pre><code>{html.escape(''.join(data['text/plain']))}</code></pre>"


def _linked(text: str) -> str:
    """Return the text with links to notebooks and documents as links within the site."""
    text = re.sub(r"\]\(\.\./docs/", "](../", text)
    return re.sub(r"\]\((?!https?:)([\w./-]+)\.(?:ipynb|md)", r"](\1.html", text)
