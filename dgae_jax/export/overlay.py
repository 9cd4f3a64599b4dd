"""The strip below a robot: the return that its critic predicts, and the return that followed."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from dgae_jax.export.figures import COLORS
from dgae_jax.maths.risk import weights_of

HEIGHT = 132
"""Of the overlay [pixels]."""

DPI = 100

RUG = 0.35
"""Length of the longest line of the rug; the highest density of most states is 1."""


class Episode(NamedTuple):
    """The states of an episode, each before its action, with predictions and outcomes."""

    title: str
    metric: str
    """The risk measure."""
    dt: float
    """Between two states [s]."""
    qpos: Float[np.ndarray, "T Q"]
    total: Float[np.ndarray, " T"]
    """Undiscounted return so far."""
    quantiles: Float[np.ndarray, "T K"]
    """Of the critic, sorted; a scalar critic has one."""
    discounted: Float[np.ndarray, " T"]
    """The discounted return that followed, in the critic's units."""


class Overlay:
    """Draw the overlay of one episode; only what moves is drawn again."""

    def __init__(self, episode: Episode, width: int):
        """Draw what stands still, `width` pixels wide."""
        self._episode = episode
        self._figure = Figure(figsize=(width / DPI, HEIGHT / DPI), dpi=DPI, facecolor="white")
        self._canvas = FigureCanvasAgg(self._figure)
        size = float(np.clip(8 * width / 480, 5.5, 9))
        axes = _axes(self._figure, size, episode)
        most = int(0.5 * width / (0.85 * size))
        title = episode.title if len(episode.title) <= most else "…" + episode.title[1 - most :]
        self._figure.text(0.02, 0.97, title, size=size + 1, weight="bold", va="top")
        count = episode.quantiles.shape[-1]
        weights = weights_of(episode.metric, count)
        self._weights = np.ones(count) if weights is None else weights / weights.max()
        self._is_distribution = count > 1
        moving = self._add_distribution(axes) if self._is_distribution else []
        name = f"its {episode.metric}" if self._is_distribution else "critic's value"
        style = {"color": COLORS["black"], "linestyle": (0, (2, 1))}
        self._value = axes.axvline(linewidth=1.6, label=name, **style)
        style = {"color": COLORS["vermilion"], "label": "return that followed"}
        self._discounted = axes.axvline(linewidth=1.6, **style)
        self._numbers = self._figure.text(0.98, 0.97, "", size=size + 1, va="top", ha="right")
        place: Any = {"loc": "upper left", "bbox_to_anchor": (0.01, 0.86), "columnspacing": 1.2}
        self._figure.legend(ncols=3, frameon=False, fontsize=size, handlelength=1.5, **place)
        self._moving = [*moving, self._value, self._discounted, self._numbers]
        for artist in self._moving:
            artist.set_animated(True)
        self._canvas.draw()
        self._background: Any = self._canvas.copy_from_bbox(self._figure.bbox)

    def render(self, t: int) -> UInt8[np.ndarray, "h W 3"]:
        """Draw the overlay at the t-th state."""
        episode, z = self._episode, self._episode.quantiles[t]
        if self._is_distribution:
            self._density.set_data(self._x, 0, density(z, self._x) / self._highest)
            self._rug.set_segments(
                [[(q, 0), (q, -RUG * w)] for q, w in zip(z, self._weights, strict=True)]
            )
        self._value.set_xdata([np.average(z, weights=self._weights)] * 2)
        self._discounted.set_xdata([episode.discounted[t]] * 2)
        self._numbers.set_text(f"{t * episode.dt:.2f} s   return {episode.total[t]:,.0f}")
        self._canvas.restore_region(self._background)
        for artist in self._moving:
            self._figure.draw_artist(artist)
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()

    def _add_distribution(self, axes: Any) -> list[Any]:
        """Add density and rug; each line of the rug is as long as its quantile's weight."""
        quantiles = self._episode.quantiles
        low, high = axes.get_xlim()
        self._x = np.linspace(low, high, 200)
        peaks = [density(z, self._x).max() for z in quantiles[::10]]
        self._highest = np.quantile(peaks, 0.9)
        style = {"color": COLORS["sky"], "alpha": 0.6, "lw": 0, "label": "critic's distribution"}
        self._density = axes.fill_between(self._x, 0, 0, **style)
        self._rug = axes.vlines([], 0, 0, colors=COLORS["blue"], linewidths=0.7)
        return [self._density, self._rug]


def density(
    quantiles: Float[np.ndarray, " K"], x: Float[np.ndarray, " P"]
) -> Float[np.ndarray, " P"]:
    """Estimate the density at points `x` by normal kernels of Silverman's bandwidth.

    The bandwidth is at least two steps between points; all quantiles may be equal.
    """
    bandwidth = max(1.06 * quantiles.std() * len(quantiles) ** -0.2, 2 * (x[1] - x[0]))
    kernels = np.exp(-0.5 * ((x[:, None] - quantiles) / bandwidth) ** 2)
    return kernels.mean(-1) / (bandwidth * np.sqrt(2 * np.pi))


def _axes(figure: Figure, size: float, episode: Episode) -> Any:
    """Add axes for all returns but the most extreme quantiles."""
    low, high = np.quantile(episode.quantiles, [0.002, 0.998])
    low, high = min(low, episode.discounted.min()), max(high, episode.discounted.max())
    margin = 0.04 * (high - low) + 1e-3
    axes = figure.add_axes((0.03, 0.3, 0.94, 0.36))
    axes.set(xlim=(low - margin, high + margin), ylim=(-RUG, 1.15), yticks=[])
    axes.axhline(0, color="0.4", linewidth=0.6)
    axes.spines[["left", "top", "right"]].set_visible(False)
    axes.tick_params(labelsize=size - 0.5, length=2, pad=1.5)
    axes.set_xlabel("discounted return from here on, in the critic's units", size=size, labelpad=1)
    return axes
