"""What tyro refuses, said as we say it: the flag, the value and what is allowed.

A sentence of tyro's that is not known here is shown as it stands.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import MISSING
from difflib import get_close_matches
from itertools import pairwise

from dgae_jax.cli.flags import Leaf, metavar

KINDS = {
    "INT": "a whole number",
    "FLOAT": "a number",
    "INT ...": "whole numbers with spaces between them",
}
"""What a value must be that could not be read."""

_FRAME = re.compile(r"[╭╮╰╯├┤│─+|\- ]*")  # tyro draws it in ASCII where the terminal has no more


def sentence(box: str, listed: Sequence[Leaf], argv: Sequence[str]) -> str:
    """One line about what is wrong with a command line, where tyro wrote `box` about it."""
    text = _inside(box)
    by_flag = {"--" + leaf.flag: leaf for leaf in listed}
    if found := re.match(r"Unrecognized options: (.*?)(, | Perhaps|$)", text):
        return _stray(found[1], by_flag, argv)
    if found := re.match(r"Missing value for argument '(\S+)'", text):
        return (
            f"{found[1]}: must be followed by a value"
            if found[1] in by_flag
            else f"{_upper(found[1])}: must be given"
        )
    if text.startswith("Missing from"):
        needed = next(
            leaf
            for leaf in listed
            if leaf.default is MISSING
            and (_upper(leaf.flag) if leaf.positional else leaf.flag) in text
        )
        return f"{_upper(needed.flag) if needed.positional else '--' + needed.flag}: must be given"
    if found := re.search(r"for argument '(\S+)'\. Expected one of \((.*?),?\)", text):
        allowed = ", ".join(name for name in re.findall(r"'(.*?)'", found[2]) if name != "None")
        return f"{found[1]} {' '.join(_values(found[1], argv))}: must be one of {allowed}"
    if (found := re.match(r"Error parsing (\S+):", text)) and (
        kind := KINDS.get(metavar(by_flag[found[1]].hint) or "")
    ):
        return f"{found[1]} {' '.join(_values(found[1], argv))}: must be {kind}"
    return text


def names(listed: Sequence[Leaf]) -> list[str]:
    """All flags."""
    both = [
        ("--" + leaf.flag, "--no-" + leaf.flag) if leaf.hint is bool else ("--" + leaf.flag,)
        for leaf in listed
        if not leaf.positional
    ]
    return ["--help", *(name for pair in both for name in pair)]


def unknown(argv: Sequence[str], listed: Sequence[Leaf]) -> str | None:
    """The first word that looks like a flag and is none."""
    known = names(listed)
    return next(
        (
            word
            for word in argv
            if word.startswith("--") and word != "--" and flag_of(word) not in known
        ),
        None,
    )


def not_a_flag(word: str, listed: Sequence[Leaf]) -> str:
    """That there is no such flag, and which may be meant."""
    known = names(listed)
    near = get_close_matches(flag_of(word), known, n=2, cutoff=0.75)
    near = near or [name for name in known if name.endswith("." + flag_of(word)[2:])]
    perhaps = f"; perhaps {' or '.join(near)}" if near else ""
    return f"{word}: is not a flag of this command{perhaps} (--help lists every flag)"


def flag_of(word: str) -> str:
    """The flag in a word of a command line, without its value."""
    return word.partition("=")[0].replace("_", "-")


def _upper(name: str) -> str:
    return name.replace("-", "_").upper()


def _stray(word: str, by_flag: dict[str, Leaf], argv: Sequence[str]) -> str:
    """A word too many."""
    before = next((flag_of(flag) for flag, after in pairwise(argv) if after == word), None)
    before = before or next((flag_of(each) for each in argv if each.endswith("=" + word)), "")
    leaf = by_flag.get(before.replace("--no-", "--"))
    if leaf and leaf.hint is bool:
        return f"{before} {word}: takes no value; it is --{leaf.flag} or --no-{leaf.flag}"
    return f"{word}: belongs to no flag (--help lists every flag)"


def _values(flag: str, argv: Sequence[str]) -> Iterator[str]:
    """What was written behind a flag, the last time."""
    for at in [at for at, word in enumerate(argv) if flag_of(word) == flag][-1:]:
        if "=" in argv[at]:
            yield argv[at].partition("=")[2]
        yield from (word for word in _until_a_flag(argv[at + 1 :]))


def _until_a_flag(words: Sequence[str]) -> Iterator[str]:
    for word in words:
        if word.startswith("--"):
            return
        yield word


def _inside(box: str) -> str:
    """The sentence inside tyro's framed message, without title, frame and pointer to the help text."""
    lines = [
        line.strip().strip("│|").strip()
        for line in box.splitlines()[1:]
        if not _FRAME.fullmatch(line.strip())
    ]
    body = " ".join(line for line in lines if line).partition("For full helptext")[0]
    return re.sub(r"\s+", " ", body).strip()
