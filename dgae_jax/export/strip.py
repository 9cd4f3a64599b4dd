"""The strip under a robot: what its critic expects from here on, and what came."""

from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from dgae_jax.export.episodes import Episode
from dgae_jax.export.pictures import COLOURS
from dgae_jax.maths.risk import weights_of

HEIGHT = 132
"""Of the strip [pixels]."""

DPI = 100

POINTS = 200
"""At which a density is drawn."""

RUG = 0.35
"""Length of the longest line of the rug; the highest density of most states is 1."""

_DASHED = (0, (2, 1))


class Strip:
    """Draws the strip of one episode; all but what moves is drawn once."""

    def __init__(self, episode: Episode, width: int):
        """`width` in pixels."""
        self._episode = episode
        self._figure = Figure(figsize=(width / DPI, HEIGHT / DPI), dpi=DPI, facecolor="white")
        self._canvas = FigureCanvasAgg(self._figure)
        size = float(np.clip(8 * width / 480, 5.5, 9))
        self._axes = _axes(self._figure, size, _range(episode))
        self._several = episode.quantiles.shape[-1] > 1
        _legend(self._figure, size, episode)
        room = int(0.5 * width / (0.85 * size))
        self._figure.text(
            0.02, 0.97, shortened(episode.actor.title, room), size=size + 1, weight="bold", va="top"
        )
        self._numbers = self._figure.text(
            0.98, 0.97, "", size=size + 1, va="top", ha="right", animated=True
        )
        self._lines = [
            self._vertical(COLOURS["black"], _DASHED),
            self._vertical(COLOURS["vermilion"], "-"),
        ]
        if self._several:
            self._add_distribution(episode)
        self._canvas.draw()
        self._background: Any = self._canvas.copy_from_bbox(self._figure.bbox)

    def picture(self, t: int) -> UInt8[np.ndarray, "h W 3"]:
        """The strip at the t-th state."""
        episode = self._episode
        self._canvas.restore_region(self._background)
        if self._several:
            z = episode.quantiles[t]
            self._fill.set_data(self._x, 0, density(z, self._x) / self._highest)
            self._rug.set_segments(
                [[(at, 0), (at, -RUG * w)] for at, w in zip(z, self._weights, strict=True)]
            )
            self._axes.draw_artist(self._fill)
            self._axes.draw_artist(self._rug)
        for line, at in zip(self._lines, (episode.value[t], episode.came[t]), strict=True):
            line.set_xdata([at, at])
            self._axes.draw_artist(line)
        end = "   fell" if episode.fell and t == len(episode.total) - 1 else ""
        self._numbers.set_text(f"{t * episode.dt:.2f} s   return {episode.total[t]:,.0f}{end}")
        self._figure.draw_artist(self._numbers)
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()

    def _vertical(self, colour: str, style: Any) -> Line2D:
        (line,) = self._axes.plot(
            [], [], color=colour, linestyle=style, linewidth=1.6, animated=True
        )
        line.set_ydata([-RUG, 1.1])
        line.set_xdata([0, 0])
        return line

    def _add_distribution(self, episode: Episode) -> None:
        """Density and rug; a line of the rug is as long as the preference gives its quantile weight."""
        count = episode.quantiles.shape[-1]
        weights = weights_of(episode.actor.config.metric, count)
        self._weights = np.ones(count) if weights is None else weights / weights.max()
        low, high = self._axes.get_xlim()
        self._x = np.linspace(low, high, POINTS)
        self._highest = np.quantile(
            [density(z, self._x).max() for z in episode.quantiles[::10]], 0.9
        )
        self._fill = self._axes.fill_between(
            self._x, 0, 0 * self._x, color=COLOURS["sky"], alpha=0.6, linewidth=0, animated=True
        )
        self._rug = LineCollection([], colors=COLOURS["blue"], linewidths=0.7, animated=True)
        self._axes.add_collection(self._rug, autolim=False)


def density(
    quantiles: Float[np.ndarray, " K"], x: Float[np.ndarray, " P"]
) -> Float[np.ndarray, " P"]:
    """That of the quantiles by normal kernels of Silverman's width, at least two steps between points wide."""
    width = max(1.06 * quantiles.std() * len(quantiles) ** -0.2, 2 * (x[1] - x[0]))
    return np.exp(-0.5 * ((x[:, None] - quantiles) / width) ** 2).mean(-1) / (
        width * np.sqrt(2 * np.pi)
    )


def shortened(text: str, room: int) -> str:
    """A name in at most `room` characters, its middle left out."""
    half = max(room - 1, 2) // 2
    return text if len(text) <= room else f"{text[:half]}…{text[-half:]}"


def _range(episode: Episode) -> tuple[float, float]:
    """From the lowest to the highest return that is drawn, but for the utmost quantiles."""
    ends = [*np.quantile(episode.quantiles, [0.002, 0.998]), episode.came.min(), episode.came.max()]
    margin = 0.04 * (max(ends) - min(ends)) + 1e-3
    return min(ends) - margin, max(ends) + margin


def _axes(figure: Figure, size: float, limits: tuple[float, float]) -> Any:
    axes = figure.add_axes((0.03, 0.3, 0.94, 0.36))
    axes.set(xlim=limits, ylim=(-RUG, 1.15), yticks=[])
    axes.axhline(0, color="0.4", linewidth=0.6)
    axes.spines[["left", "top", "right"]].set_visible(False)
    axes.tick_params(labelsize=size - 0.5, length=2, pad=1.5)
    axes.set_xlabel("discounted return from here on, in the critic's units", size=size, labelpad=1)
    return axes


def _legend(figure: Figure, size: float, episode: Episode) -> None:
    several = episode.quantiles.shape[-1] > 1
    distribution = (
        [Patch(color=COLOURS["sky"], alpha=0.6, label="critic's distribution")] if several else []
    )
    name = f"its {episode.actor.config.metric}" if several else "critic's value"
    value = Line2D([], [], color=COLOURS["black"], linestyle=_DASHED, linewidth=1.6, label=name)
    came = Line2D([], [], color=COLOURS["vermilion"], linewidth=1.6, label="return that came")
    figure.legend(
        handles=[*distribution, value, came],
        loc="upper left",
        bbox_to_anchor=(0.01, 0.86),
        ncols=3,
        frameon=False,
        fontsize=size,
        borderpad=0.1,
        handlelength=1.5,
        columnspacing=1.2,
    )
