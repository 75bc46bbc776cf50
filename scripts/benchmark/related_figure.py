"""The ROC curves of `scripts/benchmark related` as a picture, legible on a light and on a dark page."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator
from numpy.typing import NDArray

from fmtorch.core.files import replacing
from fmtorch.core.types import RELATED
from scripts.benchmark.related_table import Row, inliers, significance, split

GREY = "#808080"  # of text and axes, on either page
COLOURS = ("#1f88d2", "#e07b00", "#2f9e44", "#d9480f", "#9c5fd0", "#a68a00")
STYLE: Any = {
    "svg.hashsalt": "fmtorch", "svg.fonttype": "none", "font.size": 8, "text.color": GREY, "axes.edgecolor": GREY,
    "axes.labelcolor": GREY, "xtick.color": GREY, "ytick.color": GREY,
}  # fmt: skip
TICKS = (0, 0.1, 1, 10, 100)  # %; linear up to the second of them
BY: dict[str, Callable[[Row], float]] = {"by significance": significance, "by the number of inliers": inliers}


def roc(rows: Sequence[Row], figure: Callable[[Row], float]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Shares of unrelated pairs accepted and of right ones rejected at every level of a figure, from the lowest on."""
    unrelated, right = (np.array([figure(row) for row in part], dtype=np.float64) for part in split(rows))
    levels = np.append(np.unique(np.concatenate([unrelated, right])), np.inf)
    return (unrelated >= levels[:, None]).mean(1), (right < levels[:, None]).mean(1)


def draw(rows: dict[str, list[Row]], path: Path) -> None:
    """Write an SVG: a panel for each way to judge pairs, a curve for each pipeline, a dot at the level of `related`."""
    rows = {name: own for name, own in rows.items() if all(split(own))}  # others have no curve
    with rc_context(STYLE), replacing(path) as temporary:
        figure = Figure(figsize=(7.0, 3.0), layout="constrained")
        for ax, (title, by) in zip(figure.subplots(1, len(BY), sharey=True), BY.items(), strict=True):
            for colour, (name, own) in zip(COLOURS * len(rows), rows.items(), strict=False):
                accepted, rejected = roc(own, by)
                perfect = bool(((accepted == 0) & (rejected == 0)).any())
                label = f"{name} (along the axes)" if perfect else name
                ax.plot(100 * accepted, 100 * rejected, color=colour, lw=1.2, label=label)
                if by is significance:
                    unrelated, right = split(own)
                    dot = [np.mean([by(r) >= RELATED for r in unrelated]), np.mean([by(r) < RELATED for r in right])]
                    ax.plot(*(100 * share for share in dot), ".", color=colour, ms=8, clip_on=False)
            ax.set(title=title, xlabel="unrelated pairs accepted, %", xlim=(0, 100), ylim=(0, 100), facecolor="none")
            for axis, scale in ((ax.xaxis, ax.set_xscale), (ax.yaxis, ax.set_yscale)):
                scale("symlog", linthresh=TICKS[1], linscale=0.5)
                axis.set_major_locator(FixedLocator(TICKS))
                axis.set_minor_locator(NullLocator())
                axis.set_major_formatter("{x:g}")
            ax.grid(color=GREY, alpha=0.25, lw=0.5)
            ax.spines[["top", "right"]].set_visible(False)
            if by is significance:
                ax.set_ylabel("right pairs rejected, %")
                if rows:
                    ax.legend(frameon=False, fontsize=7)
        figure.savefig(temporary, format="svg", transparent=True, metadata={"Date": None})
