"""How far the outputs of two graphs are apart, and how far they may be."""

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from me2e_compress.manager.verification_inputs import Outputs

TOLERANCES = {"float64": 1e-9, "float32": 1e-4, "float16": 1e-2, "bfloat16": 5e-2}
"""Allowed max|a-b|/max|a| by output dtype: what reordered sums of that dtype cost in
networks of a few hundred layers (float32: 1e-6 to 1e-5 measured on VAD-tiny); every
other dtype must be equal."""


def errors(a: Iterable[Outputs], b: Iterable[Outputs]) -> dict[str, float]:
    """Measure max|a-b|/max|a| of every output over all frames, in float64.

    NaN and infinities count as equal where both graphs give the same one; anything
    else that is not a number makes the error infinite.
    """
    worst: dict[str, float] = {}
    for left, right in zip(a, b, strict=True):
        for name, value in left.items():
            worst[name] = max(worst.get(name, 0.0), relative(value, right[name]))
    return worst


def relative(a: npt.NDArray[np.generic], b: npt.NDArray[np.generic]) -> float:
    """Give max|a-b|/max|a|; infinite where shapes or kinds differ."""
    if a.shape != b.shape or a.dtype != b.dtype:
        return float("inf")
    if a.size == 0:
        return 0.0
    if a.dtype.kind not in "fcV" and a.dtype.name not in TOLERANCES:
        return 0.0 if np.array_equal(a, b) else float("inf")
    wide = np.complex128 if a.dtype.kind == "c" else np.float64
    x, y = a.astype(wide), b.astype(wide)
    finite = np.isfinite(x)
    if not np.array_equal(finite, np.isfinite(y)):
        return float("inf")
    if not np.array_equal(x[~finite], y[~finite], equal_nan=True):
        return float("inf")
    if not finite.any():
        return 0.0
    gap, scale = np.abs(x[finite] - y[finite]).max(), np.abs(x[finite]).max()
    if gap == 0.0:
        return 0.0
    return float(gap / scale) if scale > 0 else float("inf")


def tolerances(outputs: Outputs) -> dict[str, float]:
    """Look up what each output may differ by."""
    return {name: TOLERANCES.get(v.dtype.name, 0.0) for name, v in outputs.items()}
