"""Draw where the time goes: modules stacked over inferences, and the long tail."""

import io
from pathlib import Path
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.style import context
from matplotlib.ticker import PercentFormatter

from me2e_compress.errors import EvaluationError
from me2e_compress.metrics.measure import percentile, too_few
from me2e_compress.registry import drafts
from me2e_compress.registry.drafts import MARK
from me2e_compress.runtime.atomic import write_bytes
from me2e_compress.runtime.latency_trace import LatencyTrace, Microseconds

Totals: TypeAlias = npt.NDArray[np.int64]
"""Microseconds of whole inferences."""

_MARKED = {50: ":", 99: "--"}
"""Percentiles in the tail, and how their lines are drawn."""
_STYLE = {
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#d9dde3",
    "axes.titlelocation": "left",
    "axes.titlesize": 9.5,
    "svg.hashsalt": "me2e-compress",
}
_INK, _MUTED = "#1d2127", "#6b7480"
_MOST_COLOURS = 10
"""Colours of the map ``tab10``: further modules are drawn as one."""


def draw_modules(trace: LatencyTrace, name: str, path: Path) -> None:
    """Draw a trace by module as PNG, SVG or PDF.

    Left, one bar per inference stacks the modules, the largest at the bottom. Right,
    the share of inferences that take longer than a time, on a logarithmic axis: a long
    tail reaches far to the right. Both show inferences under the profiler, which is
    said above them beside the mean without it.
    """
    with context(_STYLE, after_reset=True):
        figure, drawn = modules_figure(trace, name), io.BytesIO()
        kind = path.suffix.removeprefix(".")
        about = {"Software" if kind == "png" else "Creator": MARK}
        undated = {"Date": None} if kind == "svg" else {}
        figure.savefig(drawn, format=kind, dpi=160, metadata=about | undated)
    with drafts.written(path, EvaluationError):
        write_bytes(path, drawn.getvalue())


def modules_figure(trace: LatencyTrace, name: str) -> Figure:
    """Return the figure that :func:`draw_modules` writes."""
    figure = Figure(figsize=(9.6, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(2.3, 1))
    # the largest parts in their order, and the others as one
    shown, most = dict(trace.modules_us), _MOST_COLOURS - 1
    if len(shown) > _MOST_COLOURS:
        small = {name: shown.pop(name) for name in list(shown)[most:]}
        others = tuple(map(sum, zip(*small.values(), strict=True)))
        shown[f"{len(small)} others"] = others
    total = np.sum([np.array(each) for each in shown.values()], axis=0)
    # the profiler, which timed the modules, costs an inference time
    taken_us = total, trace.samples_us
    under, without = (f"{np.mean(each) / 1e3:.3g}" for each in taken_us)
    title = (
        f"{name}: {trace.machine}\ntimed by onnxruntime's profiler, which takes time"
        f" itself: {under} ms on average, {without} ms without it"
    )
    figure.suptitle(title, x=0.01, ha="left", fontsize=10)
    _stack(left, shown, total)
    _tail(right, total)
    return figure


def _stack(axes: Axes, parts: Microseconds, total: Totals) -> None:
    colours = colormaps["tab10"].colors  # type: ignore[attr-defined]
    at = np.arange(1, len(total) + 1)
    floor = np.zeros(len(total))
    # each module's bars stand on those before
    for (name, samples), colour in zip(parts.items(), colours, strict=False):
        height = np.array(samples) / 1e3
        share = sum(samples) / max(1, int(total.sum()))
        label = f"{name}  {share:.0%}"
        axes.bar(at, height, 1.0, floor, color=colour, label=label, linewidth=0)
        floor += height
    axes.set_xlim(0.5, len(total) + 0.5)
    axes.set_xlabel("inference", color=_MUTED)
    axes.set_title("milliseconds by module", color=_MUTED)
    axes.legend(
        loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False, reverse=True
    )


def _tail(axes: Axes, total: Totals) -> None:
    # of n inferences, n - k take as long as the k-th (from 0) or longer
    slower = 1 - np.arange(len(total)) / len(total)
    axes.step(np.sort(total) / 1e3, slower, where="pre", color=_INK, linewidth=1.4)
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    # mark those percentiles that the samples suffice for
    samples = total.tolist()
    for percent, drawn in _MARKED.items():
        if not too_few(percent, len(samples)):
            place = percentile(samples, percent) / 1e3
            words = f"p{percent} {place:.3g} ms"
            axes.axvline(
                place, color=_MUTED, linewidth=0.8, linestyle=drawn, label=words
            )
    if axes.get_legend_handles_labels()[0]:  # above the axes, where no curve is
        axes.legend(
            loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=len(_MARKED),
            frameon=False, labelcolor=_MUTED, borderaxespad=0.0, handlelength=1.6,
            columnspacing=1.0,
        )  # fmt: skip
    axes.set_xlabel("milliseconds", color=_MUTED)
    axes.set_title("how many take longer", color=_MUTED, pad=22)
