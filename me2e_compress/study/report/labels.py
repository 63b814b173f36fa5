"""Names beside the points of a figure, none on top of another."""

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from me2e_compress.study.report.style import INK, RULE

LINE_PT = 10.5
"""Height of a line of labels, points."""
CHARACTER_PT = 4.9
"""Mean width of a character of this size, points: an estimate is enough here."""
GAP_PT = 7.0
POINTS_AN_INCH = 72.0


def place(
    figure: Figure, axes: Axes, names: Sequence[tuple[str, float, float]]
) -> None:
    """Write names to the right of their points, moved up or down where they would meet.

    Args:
        figure: Which the axes are of.
        axes: Its limits must be final.
        names: Name, x and y of each point, in the units of the axes.
    """
    scale = POINTS_AN_INCH / figure.dpi
    ends = list[tuple[float, float, float]]()
    spots = [
        (name, x, y, axes.transData.transform((x, y)) * scale) for name, x, y in names
    ]
    for name, x, y, (left, up) in sorted(spots, key=lambda spot: -spot[3][1]):
        start = left + GAP_PT
        end = start + CHARACTER_PT * len(name)
        height = up
        for other_start, other_end, other_height in ends:
            meets = start < other_end and other_start < end
            if meets and other_height - height < LINE_PT:
                height = other_height - LINE_PT
        ends.append((start, end, height))
        moved = abs(height - up) > 1.0
        axes.annotate(
            name,
            (x, y),
            xytext=(GAP_PT, height - up),
            textcoords="offset points",
            va="center",
            fontsize=8.5,
            color=INK,
            arrowprops={"arrowstyle": "-", "color": RULE} if moved else None,
            annotation_clip=False,
            bbox={"facecolor": "white", "alpha": 0.8, "linewidth": 0, "pad": 0.5},
        )
