"""Pictures of results."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import torch
from numpy.typing import NDArray

from fmtorch import metrics
from fmtorch.evaluation.curves import NSGD, Axis, axis_of, by_family
from fmtorch.evaluation.summary import ALL
from fmtorch.runs import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Okabe and Ito's palette, which people with any colour vision can tell apart; dashes repeat it.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
DASHES = ("-", "--", ":", "-.")
_INK, _PALE = "#333333", "#D9D9D9"


def plot_recall_curves(runs: Mapping[str, pa.Table], path: Path) -> None:
    """Draw recall against the NSGD threshold, from 0 to 0.2, as PNG or SVG; legends give the recall at 0.05.

    Of homographies it is recall against the corner error, from 0 to 10 px, with the recall at 3 px.

    runs: tables of `PAIR_SCHEMA` by name. One run gives one panel with a curve for each family and for all; several
    runs give a panel for each family with a curve for each run.
    """
    from matplotlib.figure import Figure  # no pyplot: no global state and no window

    panels, axis = _panels(runs), axis_of(runs)
    rows = max(1, math.ceil(len(panels) / 2))
    columns = max(1, math.ceil(len(panels) / rows))
    width, height = (7.4, 4.4) if len(panels) <= 1 else (6.2 * columns, 3.7 * rows)
    figure = Figure(figsize=(width, height), dpi=150, layout="constrained")
    grid: Any = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    titles = list(panels)
    for i, ax in enumerate(grid.flat):
        if i >= len(titles):
            ax.set_visible(False)
            continue
        _draw(ax, titles[i], panels[titles[i]], axis)
        if i % columns == 0:
            ax.set_ylabel("recall [%]", color=_INK)
        if i + columns >= len(titles):  # nothing below
            ax.set_xlabel(axis.label, color=_INK)
            ax.tick_params(labelbottom=True)
    with replacing(path) as temporary:
        figure.savefig(temporary, format=path.suffix[1:])


def _panels(runs: Mapping[str, pa.Table]) -> dict[str, dict[str, NDArray[np.float64]]]:
    """Panel title -> curve name -> errors of its pairs."""
    families = by_family(runs)
    if len(runs) > 1:
        return families
    (name,) = runs
    curves = {family: of_runs[name] for family, of_runs in families.items()}
    return {name: {**curves, ALL: np.concatenate(list(curves.values()))} if len(curves) > 1 else curves}


def _draw(ax: Axes, title: str, curves: Mapping[str, NDArray[np.float64]], axis: Axis = NSGD) -> None:
    thresholds = torch.linspace(0, axis.maximum, 401, dtype=torch.float64)
    ax.axvline(axis.mark, color="#999999", linewidth=0.9, linestyle=(0, (4, 3)), zorder=1)
    styles = itertools.cycle(itertools.product(DASHES, COLOURS))
    for (name, errors), (dash, colour) in zip(curves.items(), styles, strict=False):
        share = metrics.recall_curve(torch.from_numpy(errors), thresholds).numpy()
        overall = name == ALL
        ax.plot(
            thresholds.numpy(), 100 * share, label=f"{100 * axis.below(errors, axis.mark):.1f}  {name}",
            color="#000000" if overall else colour, linestyle=dash, linewidth=2.4 if overall else 1.7, zorder=3,
        )  # fmt: skip
    ax.set(xlim=(0, axis.maximum), ylim=(0, 101), yticks=range(0, 101, 20))
    ax.set_xticks(axis.ticks, [f"{tick:g}" for tick in axis.ticks])
    ax.set_title(title, loc="left", fontsize=11, fontweight="bold", color=_INK)
    ax.grid(color=_PALE, linewidth=0.6)
    ax.set_axisbelow(True)
    ax.tick_params(colors=_INK, length=0, labelsize=9)
    for side in ("top", "right", "left"):
        ax.spines[side].set_visible(False)
    ax.spines["bottom"].set_color("#999999")
    if curves:
        legend = ax.legend(  # beside the curves, none of which it hides
            title=f"recall [%] at {axis.mark:g}", fontsize=8, title_fontsize=8, loc="upper left", alignment="left",
            bbox_to_anchor=(1.0, 1.0), borderaxespad=0.2, labelcolor=_INK, frameon=False, handlelength=2.0,
        )  # fmt: skip
        legend.get_title().set_color(_INK)
