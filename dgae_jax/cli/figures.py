"""Draw the figures of the paper that need no training: dgae figures --out figures

Flags are checked before the rest is imported: JAX and MuJoCo take seconds to load.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

from dgae_jax.cli.arguments import fail, parse, stopped
from dgae_jax.configs.config import ConfigError, invalid
from dgae_jax.export import gl
from dgae_jax.run import terminal

PURPOSE = "Draw the figures of the paper that need no training."

EXAMPLES = (
    "dgae figures",
    "dgae figures --only transport",
    "dgae figures --only robots --out docs/images",
)


class Drawing(NamedTuple):
    """A figure: a function of `export.figures`."""

    kinds: tuple[str, ...]
    """Endings of the files that it becomes."""
    opengl: bool
    """Whether MuJoCo draws in it."""


FIGURES = {
    "robots": Drawing(("png",), opengl=True),
    "transport": Drawing(("png", "svg"), opengl=False),
}


@dataclass(frozen=True)
class Arguments:
    """What to draw, and where to write it."""

    out: Path = Path("figures")
    """Directory to write, made if it is not there [path]."""
    only: Literal["robots", "transport"] | None = None
    """robots (Fig. 1: the four robots) or transport (Fig. 2: optimal transport and the directional metric); by default both."""


def main() -> int:
    """Draw the figures; 0 done, 2 bad input or no OpenGL, 130 stopped by SIGINT."""
    terminal.prepare()
    try:
        arguments = parse(Arguments, PURPOSE, examples=EXAMPLES)
        chosen = {name: FIGURES[name] for name in ([arguments.only] if arguments.only else FIGURES)}
        if any(drawing.opengl for drawing in chosen.values()):
            gl.choose()
        _draw(chosen, arguments.out)
        return 0
    except ConfigError as mistake:
        fail(mistake)
    except KeyboardInterrupt:
        return stopped("stopped by SIGINT")


def _draw(chosen: dict[str, Drawing], out: Path) -> None:
    from dgae_jax.export import figures

    try:
        out.mkdir(parents=True, exist_ok=True)
        for name, drawing in chosen.items():
            figure = getattr(figures, name)()
            for kind in drawing.kinds:
                figures.save(figure, out / f"{name}.{kind}")
                terminal.say(f"written to {out / name}.{kind}")
    except OSError as reason:
        raise invalid(
            "out", out, f"a directory that can be written ({reason.strerror})"
        ) from reason


if __name__ == "__main__":
    sys.exit(main())
