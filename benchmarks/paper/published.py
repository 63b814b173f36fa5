"""The paper's own figures, never mixed with values computed here.

All are from arXiv 2601.07393; tables are named as there.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class PublishedDrive:
    """A row of tables 2, 3, 5 or 6; None where the table has no such column.

    ds, de (percent) and dc are driving score, efficiency and comfort; joules are per
    frame, watts the power.
    """

    fps: float
    ds: float
    de: float
    dc: float
    joules: float | None = None
    eer: float | None = None
    watts: float | None = None


RATES = (
    PublishedDrive(1, 32.85, 139.81, 0.42),
    PublishedDrive(1.25, 32.04, 141.38, 0.40),
    PublishedDrive(1.67, 34.17, 126.89, 0.42),
    PublishedDrive(2, 33.50, 136.69, 0.36),
    PublishedDrive(3, 35.59, 135.45, 0.42),
    PublishedDrive(5, 33.74, 133.40, 0.42),
    PublishedDrive(8, 36.70, 135.57, 0.38),
    PublishedDrive(10, 37.55, 137.44, 0.38),
    PublishedDrive(14, 37.15, 134.28, 0.35),
    PublishedDrive(18, 38.01, 137.55, 0.36),
    PublishedDrive(20, 39.53, 132.03, 0.28),
    PublishedDrive(24, 40.63, 138.21, 0.33),
    PublishedDrive(28, 39.68, 136.24, 0.31),
    PublishedDrive(30, 40.15, 135.90, 0.31),
)
"""Table 2: UniAD at fixed rates."""

RATES_RT = {
    "UniAD": PublishedDrive(2.31, 30.69, 142.92, 0.42),
    "VAD": PublishedDrive(9.52, 31.92, 166.26, 0.54),
    "TCP": PublishedDrive(20, 42.63, 60.34, 0.47),
}
"""Table 2: stacks at their own latency."""

MODULES_AWAY = {
    "float": PublishedDrive(2.31, 30.69, 142.92, 0.43, 191.29, 23.31),
    "minus-occ": PublishedDrive(2.59, 35.89, 157.36, 0.40, 168.56, 26.01),
    "minus-map": PublishedDrive(2.72, 32.24, 150.43, 0.42, 175.22, 24.03),
    "minus-motion": PublishedDrive(2.43, 28.81, 147.09, 0.61, 177.54, 22.43),
    "minus-map-motion": PublishedDrive(2.89, 26.87, 146.75, 0.54, 161.47, 21.58),
    "minus-occ-motion": PublishedDrive(2.54, 17.24, 134.10, 0.64, 154.82, 12.21),
    "minus-occ-map": PublishedDrive(3.27, 34.34, 158.87, 0.41, 152.49, 24.72),
    "minus-occ-map-motion": PublishedDrive(3.58, 16.80, 136.92, 0.64, 138.74, 9.85),
}
"""Table 3: UniAD and its schemes 1 to 7; "seg" is the map here."""

MODULES_AWAY_OF_VAD = {
    "float": PublishedDrive(9.52, 31.92, 166.26, 0.54, 31.88, 26.11),
    "map": PublishedDrive(10.56, 21.53, 148.96, 0.45, 31.22, 18.84),
    "motion": PublishedDrive(10.16, 19.65, 149.37, 0.43, 30.76, 14.65),
    "map-motion": PublishedDrive(10.88, 17.63, 147.12, 0.39, 29.17, 12.63),
}
"""Table 3: VAD and its schemes 8 to 10."""

INT8 = {
    "exact": PublishedDrive(22, 38.92, 161.64, 0.29, 27.89, 28.13),
    "prediction": PublishedDrive(25, 29.53, 143.91, 0.32, 23.36, 22.25),
    "feature-ext": PublishedDrive(28.3, 36.59, 152.35, 0.39, 20.71, 28.52),
    "full": PublishedDrive(31, 29.57, 149.74, 0.35, 18.64, 22.65),
}
"""Table 5: UniAD in TensorRT; "exact" is its Hardware_op."""

LIMITED = (
    PublishedDrive(22, 38.92, 161.64, 0.29, watts=613.58),
    PublishedDrive(10, 36.13, 141.82, 0.32, watts=246.21),
    PublishedDrive(4, 29.95, 140.35, 0.38, watts=138.56),
)
"""Table 6: UniAD-Hardware_op, its rate limited."""


@dataclass(frozen=True)
class PublishedInt8:
    """A row of table 4; counts are None for the float file."""

    tensors: int | None
    operators: int | None
    compute_intensive: int | None
    megabytes: float


INT8_COUNTS = {
    ("UniAD", "exact"): PublishedInt8(None, None, None, 364.37),
    ("UniAD", "prediction"): PublishedInt8(185, 189, 88, 325.40),
    ("UniAD", "feature-ext"): PublishedInt8(365, 281, 138, 257.17),
    ("UniAD", "full"): PublishedInt8(543, 460, 220, 241.59),
    ("VAD", "exact"): PublishedInt8(None, None, None, 140.50),
    ("VAD", "prediction"): PublishedInt8(122, 83, 21, 104.57),
    ("VAD", "feature-ext"): PublishedInt8(72, 72, 56, 119.25),
    ("VAD", "full"): PublishedInt8(194, 155, 77, 83.32),
}
"""Table 4: counts of int8 parts."""
