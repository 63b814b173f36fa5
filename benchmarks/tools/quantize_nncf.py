"""Quantize a model with NNCF for OpenVINO, in an interpreter that has both.

    python -m benchmarks.tools.quantize_nncf MODEL.onnx FRAMES/ OUT.xml [--frames 8]
        [--by-hand]

By default it is ``nncf.quantize`` of the model and the frames alone. ``--by-hand`` is
what a user comes to: asymmetric activations (preset mixed), and products named one by
one and left out: those of two activations, as in attention, and those over four numbers
or fewer, which are coordinates. The model type transformer, which smooths activations
into weights, is not: with it NNCF 3.4 moves the plan of the driver that ships by 998 m.
Prints one line of JSON: seconds of CPU, the largest resident set in MB, and how many
products were left out.
"""

import argparse
import importlib
import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.tools.run_one import peak_mb

PASSED_THROUGH = ("Convert", "Reshape", "Transpose", "Squeeze", "Unsqueeze")
"""What stands between weights and their product."""

POINT = 4
"""Numbers of a point in homogeneous coordinates."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--by-hand", action="store_true")
    given = parser.parse_args()
    nncf, openvino = (importlib.import_module(name) for name in ("nncf", "openvino"))
    model = openvino.Core().read_model(given.model)
    files = sorted(given.folder.glob("*.npz"))[: given.frames]
    dataset = nncf.Dataset(files, lambda path: inputs(model, path))
    options: dict[str, Any] = {}
    left_out = delicate_products(model) if given.by_hand else []
    if given.by_hand:
        options = {
            "preset": nncf.QuantizationPreset.MIXED,
            "ignored_scope": nncf.IgnoredScope(names=left_out),
        }
    openvino.save_model(
        nncf.quantize(model, dataset, subset_size=len(files), **options),
        given.output,
        compress_to_fp16=False,
    )
    said = {"cpu_s": time.process_time(), "peak_mb": peak_mb()}
    print(json.dumps({**said, "left_out": len(left_out)}))


def inputs(model: Any, path: Path) -> list[Any]:
    """Return a frame in the order of the ports; what it lacks, a state, is zero."""
    arrays = []
    with np.load(path) as frame:
        for port in model.inputs:
            name = next((each for each in sorted(port.names) if each in frame), None)
            zeros = np.zeros(list(port.shape), port.element_type.to_dtype())
            arrays.append(zeros if name is None else frame[name])
    return arrays


def delicate_products(model: Any) -> list[str]:
    """Name the products neither of whose sides is a weight, and those of points."""
    names = []
    for node in model.get_ordered_ops():
        if node.get_type_name() == "MatMul":
            inner = -2 if node.get_attributes()["transpose_a"] else -1
            length = node.input_value(0).get_partial_shape()[inner]
            points = length.is_static and length.get_length() <= POINT
            if points or not any(is_weight(node.input_value(i)) for i in (0, 1)):
                names.append(node.get_friendly_name())
    return names


def is_weight(value: Any) -> bool:
    """Return whether a value is a constant, behind what casts or rearranges it."""
    node = value.get_node()
    while node.get_type_name() in PASSED_THROUGH:
        node = node.input_value(0).get_node()
    return bool(node.get_type_name() == "Constant")


if __name__ == "__main__":
    main()
