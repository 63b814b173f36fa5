"""What the tests of ``hoist-linear`` share."""

from typing import Any

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import macs
from me2e_compress.passes.hoist_linear import HoistLinear
from tests.passes.small import apply, compute, fed, read


def integers(*values: int) -> Any:
    return np.array(values, np.int64)


def graph_of(signature: str, body: str, version: int = 17) -> str:
    return (
        f'<ir_version: 8, opset_import: ["" : {version}]>\ng {signature} {{ {body} }}'
    )


def products(model: ir.Model) -> int:
    return sum(macs(node) or 0 for node in model.graph)


def difference(model: ir.Model, text: str, weights: dict[str, Any]) -> float:
    """Return the largest gap to the text in float64, relative to the largest value."""
    double = {
        name: array.astype(np.float64) if array.dtype == np.float32 else array
        for name, array in weights.items()
    }
    feeds = fed(model)
    wide = {name: array.astype(np.float64) for name, array in feeds.items()}
    wanted = compute(read(text.replace("float[", "double["), **double), wide)
    worst = 0.0
    for want, got in zip(wanted, compute(model, feeds), strict=True):
        assert want.shape == got.shape
        worst = max(worst, float(np.abs(want - got).max() / np.abs(want).max()))
    return worst


def hoist(text: str, **weights: Any) -> ir.Model:
    """Apply the pass under its contract; outputs are those of float64 within 1e-5."""
    model = read(text, **weights)
    apply(HoistLinear(), model)
    assert difference(model, text, weights) < 1e-5
    return model
