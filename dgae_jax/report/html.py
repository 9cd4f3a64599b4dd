"""Pieces of HTML. Whatever comes from outside is escaped here, once, on its way in."""

import base64
import re
from collections.abc import Iterable
from html import escape

from dgae_jax.report.tables import Table

KEY = ' class="key"'
"""Of cells that say what a row is about."""


def heading(level: int, text: str, anchor: str) -> str:
    """A heading that links can lead to."""
    return f'<h{level} id="{escape(anchor)}">{escape(text)}</h{level}>'


def paragraph(text: str, kind: str = "") -> str:
    """A paragraph of plain text."""
    return f'<p class="{escape(kind)}">{escape(text)}</p>' if kind else f"<p>{escape(text)}</p>"


def table(content: Table, marked: Iterable[tuple[int, int]] = ()) -> str:
    """A table that scrolls inside its box; `marked` are (row, column) to highlight."""
    marked = set(marked)
    head = "".join(
        f'<th scope="col"{KEY if x < content.keys else ""}>{escape(cell)}</th>'
        for x, cell in enumerate(content.header)
    )
    above = ["", *(row[0] for row in content.rows)]
    body = "".join(
        ('<tr class="next">' if row[0] != above[y] and content.keys > 1 else "<tr>")
        + "".join(
            _cell(text, column < content.keys, (y, column) in marked)
            for column, text in enumerate(row)
        )
        + "</tr>"
        for y, row in enumerate(content.rows)
    )
    label = escape(", ".join(content.header))
    return (
        f'<div class="box" tabindex="0" role="region" aria-label="{label}"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )


def _cell(text: str, key: bool, marked: bool) -> str:
    inside = f"<mark>{escape(text)}</mark>" if marked else escape(text)
    return f'<th scope="row"{KEY}>{inside}</th>' if key else f"<td>{inside}</td>"


def picture(svg: bytes, alt: str) -> str:
    """A figure as an image of its own, so that nothing in it meets the page's names; `alt` says what it shows."""
    return f'<img src="data:image/svg+xml;base64,{base64.b64encode(svg).decode()}" alt="{escape(alt)}">'


def gallery(pieces: Iterable[str], caption: str) -> str:
    """Images side by side where there is room."""
    return f'<figure><div class="grid">{"".join(pieces)}</div><figcaption>{escape(caption)}</figcaption></figure>'


def video(mp4: bytes, label: str) -> str:
    """A film that plays when asked to."""
    source = f"data:video/mp4;base64,{base64.b64encode(mp4).decode()}"
    return f'<video controls playsinline preload="metadata" aria-label="{escape(label)}" src="{source}"></video>'


def details(summary: str, *inside: str) -> str:
    """What is read on demand."""
    return f"<details><summary>{escape(summary)}</summary>{''.join(inside)}</details>"


def listing(items: Iterable[str], ordered: bool = False) -> str:
    """A list of plain text in which `code` is set as code and links are left as their words."""
    kind = "ol" if ordered else "ul"
    return f"<{kind}>{''.join(f'<li>{_inline(item)}</li>' for item in items)}</{kind}>"


def _inline(markdown: str) -> str:
    text = escape(re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", markdown))
    text = re.sub(r"`([^`]*)`", r"<code>\1</code>", text)
    return re.sub(r"\*\*(.+?)\*\*", r"<strong>\1</strong>", text)


def navigation(links: Iterable[tuple[str, str]]) -> str:
    """Links to headings: words and anchor of each."""
    items = "".join(
        f'<li><a href="#{escape(anchor)}">{escape(words)}</a></li>' for words, anchor in links
    )
    return f'<nav aria-label="Contents"><ul>{items}</ul></nav>'


def code(lines: Iterable[str]) -> str:
    """Lines as they are typed."""
    return f'<pre class="box" tabindex="0">{escape(chr(10).join(lines))}</pre>'


def document(title: str, style: str, body: str) -> str:
    """The whole page."""
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n<meta name="color-scheme" content="light dark">\n'
        f"<title>{escape(title)}</title>\n<style>\n{style}</style>\n</head>\n<body>\n<main>\n{body}\n</main>\n</body>\n</html>\n"
    )
