"""Style of figures, matching the page."""

import io
from contextlib import AbstractContextManager
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.style import context

INK, MUTED, RULE = "#1d2127", "#6b7480", "#d9dde3"
ACCENT, BASELINE = "#2a6fb0", "#1d2127"
STYLE = Path(__file__).with_name("report.mplstyle")
PAGE_FONT = "Inter, 'Segoe UI', 'Helvetica Neue', Arial, sans-serif"
"""Text stays text: matplotlib measures one font, the page shows its own."""


def styled() -> AbstractContextManager[None]:
    """Return a context that ignores the user's matplotlib settings."""
    return context(STYLE, after_reset=True)


def svg(figure: Figure) -> str:
    """Write a figure as an SVG element, reproducibly."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :].replace("'DejaVu Sans'", PAGE_FONT)


def bare(axes: Axes) -> None:
    """Leave only a light grid along x."""
    axes.grid(visible=True, axis="x")
    axes.spines["left"].set_visible(False)
