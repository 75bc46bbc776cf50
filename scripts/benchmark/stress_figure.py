"""Figures of the stress test, from its rows."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from fmtorch.evaluation.statistics import PERCENT, areas
from fmtorch.runs import replacing
from scripts.benchmark.stress_rows import GROUPS, Row, figures, group, label, levels, methods

AXES = {"inlier ratio": "inlier ratio", "noise": "added noise [px]", "match count": "matches"}
LOGARITHMIC = ("inlier ratio", "match count")
INK = "#808080"  # legible on white and on black
COLOURS = ("#D55E00", "#E69F00", "#009E73", "#56B4E9", "#2F8FD0", "#CC79A7", "#9A9A9A", "#B8A800")
DASHES = ("-", "-", "--", "--", "-.", "-.", ":", ":")


def draw(rows: Sequence[Row], sweep: str, path: Path) -> None:
    """AUC@0.05 against the level, a panel for each group; an SVG without background, for light and dark pages."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    names = [name for name in GROUPS if any(group(row["family"]) == name for row in rows)]
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": sweep, "font.size": 9, "font.family": "sans-serif"}):
        figure = Figure(figsize=(3.1 * len(names) + 0.3, 3.4), layout="constrained")
        panels: Any = figure.subplots(1, len(names), squeeze=False, sharey=True)[0]
        for panel, name in zip(panels, names, strict=True):
            own = [row for row in rows if group(row["family"]) == name]
            for i, method in enumerate(methods(own)):
                points = [(x, figures(own, method, x)[0]) for x in levels(own)]
                drawn = [(float(x), PERCENT * float(areas(nsgd).mean())) for x, nsgd in points if nsgd.size]
                panel.plot(
                    *zip(*drawn, strict=True), DASHES[i % len(DASHES)], color=COLOURS[i % len(COLOURS)],
                    linewidth=2.4 if i == 0 else 1.4, label=label(method), zorder=3 - i / 100,
                )  # fmt: skip
            panel.set_title(name, loc="left", fontsize=9, color=INK)
            panel.set(xlabel=AXES[sweep], xscale="log" if sweep in LOGARITHMIC else "linear")
            ticks = [float(x) for x in levels(own)]
            panel.set_xticks(ticks, [f"{x:g}" for x in ticks])
            panel.minorticks_off()
            panel.tick_params(colors=INK, length=2)
            panel.xaxis.label.set_color(INK)
            panel.grid(color=INK, alpha=0.25, linewidth=0.5)
            for spine in panel.spines.values():
                spine.set_visible(False)
        panels[0].set_ylabel("AUC@0.05 [%]", color=INK)
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, labelcolor=INK, fontsize=8)
        with replacing(path) as temporary:
            figure.savefig(temporary, format="svg", transparent=True, metadata={"Date": None})
