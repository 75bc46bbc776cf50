"""Figures of benchmarks: lines in panels that share a legend, as SVG without background, legible on light and dark."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from fmtorch.core.files import replacing

INK = "#808080"  # legible on white and on black
COLOURS = ("#D55E00", "#E69F00", "#009E73", "#56B4E9", "#2F8FD0", "#CC79A7", "#9A9A9A", "#B8A800")
DASHES = ("-", "-", "--", "--", "-.", "-.", ":", ":")
STYLE: Any = {
    "svg.fonttype": "none", "svg.hashsalt": "fmtorch", "font.size": 9, "font.family": "sans-serif", "text.color": INK,
    "axes.edgecolor": INK, "axes.labelcolor": INK, "xtick.color": INK, "ytick.color": INK,
}  # fmt: skip


class Line(NamedTuple):
    """A line through points. marked: the number of one that gets a dot."""

    x: list[float]
    y: list[float]
    marked: int | None = None


def draw(
    path: Path,
    panels: Mapping[str, Mapping[str, Line]],
    xlabel: str,
    ylabel: str,
    *,
    xscale: str = "linear",
    shares: bool = False,
    ticks: Sequence[float] | None = None,
) -> None:
    """Write an SVG: a panel for each group of lines, one legend below.

    shares: both axes go from 0 to 100 % and are logarithmic above a tenth of a percent. ticks: of x.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    names = list(dict.fromkeys(name for lines in panels.values() for name in lines))
    with mpl.rc_context(STYLE), replacing(path) as temporary:
        figure = Figure(figsize=(3.1 * len(panels) + 0.3, 3.0 + 0.16 * len(names)), layout="constrained")
        axes: Any = figure.subplots(1, len(panels), squeeze=False, sharey=shares)[0]
        for panel, (title, lines) in zip(axes, panels.items(), strict=True):
            for name, line in lines.items():
                i = names.index(name)
                style = {"color": COLOURS[i % len(COLOURS)], "zorder": 3 - i / 100}
                panel.plot(line.x, line.y, DASHES[i % len(DASHES)], linewidth=1.4 + (i == 0), label=name, **style)
                if line.marked is not None:
                    panel.plot(line.x[line.marked], line.y[line.marked], "o", markersize=5, clip_on=False, **style)
            panel.set_title(title, loc="left", fontsize=9)
            panel.set(xlabel=xlabel, xscale=xscale, facecolor="none")
            if shares:
                _share_axes(panel)
            elif ticks is not None:
                panel.set_xticks(ticks, [f"{x:g}" for x in ticks])
            panel.minorticks_off()
            panel.grid(color=INK, alpha=0.25, linewidth=0.5)
            panel.spines[["top", "right"]].set_visible(False)
        axes[0].set_ylabel(ylabel)
        handles = {
            label: handle for panel in axes for handle, label in zip(*panel.get_legend_handles_labels(), strict=True)
        }
        figure.legend(
            [handles[name] for name in names], names, loc="outside lower center", ncols=2, frameon=False, fontsize=8
        )
        figure.savefig(temporary, format="svg", transparent=True, metadata={"Date": None})


def _share_axes(panel: Any) -> None:
    """Per cent, linear up to a tenth and logarithmic above."""
    from matplotlib.ticker import FixedLocator

    panel.set(xlim=(0, 100), ylim=(0, 100))
    for axis, scale in ((panel.xaxis, panel.set_xscale), (panel.yaxis, panel.set_yscale)):
        scale("symlog", linthresh=0.1, linscale=0.5)
        axis.set_major_locator(FixedLocator((0, 0.1, 1, 10, 100)))
        axis.set_major_formatter("{x:g}")
