"""The style of every figure: one palette, readable in greyscale, and reproducible files."""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from sbt.campaigns.wording import written_unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "CRITICAL",
    "FAILED",
    "MODEL",
    "REGION",
    "UNCRITICAL",
    "figure_style",
    "label",
    "new_figure",
    "to_svg",
]

UNCRITICAL = "#5b9bd5"
CRITICAL = "#8c1515"
FAILED = "#333333"
HELD_OUT = "#9aa7b5"
MODEL = "#1f4e79"
REGION = "#f6d5c9"
"""light enough to print under black text: the critical side of a figure"""

_STYLE: dict[Any, Any] = {
    "font.size": 9.5,
    "axes.titlesize": 9.5,
    "axes.labelsize": 9.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#555555",
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.linewidth": 0.8,
    "grid.color": "#e6e6e6",
    "grid.linewidth": 0.7,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "xtick.color": "#444444",
    "ytick.color": "#444444",
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "legend.handletextpad": 0.4,
    "legend.columnspacing": 1.2,
    "legend.borderaxespad": 0.2,
    "lines.linewidth": 1.6,
    "hatch.linewidth": 0.5,
    "svg.fonttype": "none",  # text stays text: it is searched, read aloud, and small
    "svg.hashsalt": "sumo-sbt",
}


@contextmanager
def figure_style() -> Iterator[None]:
    """Draw and save under the package's style, without the user's matplotlibrc."""
    import matplotlib as mpl

    with mpl.rc_context(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        mpl.rcdefaults()
        mpl.rcParams.update(_STYLE)
        yield


def new_figure(width: float = 5.4, height: float = 4.0) -> Figure:
    """Return a figure of this size in inches that lays itself out and belongs to no window."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def label(name: str, unit: str = "") -> str:
    """Return an axis label; a dollar sign stays a dollar sign.

    >>> label("a_co", "m/s^2")
    'a_co (m/s²)'
    """
    return (f"{name} ({written_unit(unit)})" if unit else name).replace("$", r"\$")


def to_svg(figure: Figure, name: str) -> str:
    """Return the figure as SVG: no date, no metadata, ids that no other figure has.

    Args:
        figure: made and drawn within `figure_style`.
        name: distinct among the figures of a page; an identifier.
    """
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", dpi=170, metadata={"Date": None, "Creator": None})
    text = re.sub(r"\s*<metadata>.*?</metadata>", "", buffer.getvalue(), flags=re.DOTALL)
    text = text.replace("*{stroke-linejoin", f"#{name} *{{stroke-linejoin")  # not a rule for the whole page
    text = re.sub(r'( id="|href="#|url\(#)', rf"\g<1>{name}-", text)
    return text.replace("<svg ", f'<svg id="{name}" ', 1)
