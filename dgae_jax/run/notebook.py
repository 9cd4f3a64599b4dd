"""How a run is going, in a notebook: one output of the cell, replaced as the run goes on, whose last state is saved with it."""

import base64
import gc
import io
import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from dgae_jax.run import terminal

if TYPE_CHECKING:
    from matplotlib.figure import Figure

EVERY = 4.0
"""Least seconds between two pictures; drawing never takes more than a tenth of the time either."""

WIDTH = 640
"""Of the picture on the screen [CSS pixels]; it has more pixels than that, for fine screens."""


def is_there() -> bool:
    """Whether this process is the kernel of a notebook, and someone wants to see anything. IPython is not imported for it."""
    ipython: Any = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython else None
    return getattr(shell, "kernel", None) is not None and not terminal.is_silent()


class Page:
    """Words until there is something to draw, then the picture with the words in it."""

    def __init__(self, draw: "Callable[[], Figure | None]"):
        """`draw` makes the picture as it is now, None while there is nothing to see."""
        self.draw, self.shown, self.due = draw, None, 0.0

    def show(self, words: str, at_once: bool = False) -> None:
        """Replace what is shown, unless it was a moment ago."""
        began = time.monotonic()
        if began < self.due and not at_once:
            return
        figure = self.draw()
        self._put({"text/plain": words}, {}) if figure is None else self._put(
            *_picture(figure, words)
        )
        ended = time.monotonic()
        self.due = ended + max(EVERY, 9 * (ended - began))

    def _put(self, data: dict[str, Any], metadata: dict[str, Any]) -> None:
        from IPython.display import display

        if self.shown is None:
            self.shown = display(data, raw=True, metadata=metadata, display_id=True)
        else:
            self.shown.update(data, raw=True, metadata=metadata)


def _picture(figure: "Figure", words: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """A PNG and how wide it is shown."""
    axes = figure.axes[0]
    title = axes.get_title()
    if words:
        axes.set_title(f"{title}\n{words}", fontsize=9)
    image = io.BytesIO()
    figure.savefig(image, format="png")
    gc.collect()  # see record._plot
    png = base64.b64encode(image.getvalue()).decode()
    return {"image/png": png, "text/plain": f"{title} {words}".strip()}, {
        "image/png": {"width": WIDTH}
    }
