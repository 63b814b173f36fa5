#!/usr/bin/env bash
# Guess: optimizations change how fast a valid graph runs, not whether it opens; a pool
# with dilations, which no int8 kernel has, stays float.
#
# In truth, onnxruntime fuses DequantizeLinear, AveragePool and QuantizeLinear into a
# QLinearAveragePool and copies all attributes to it, although that operator has no
# `dilations`; then it refuses its own node. So it does with the default, [1, 1], where
# an exporter writes that down. With all optimizations off such graphs run.
#
# onnxruntime 1.31.1 (CPU), onnx 1.23.2, numpy 2.4.6, Python 3.11; 2026-11-29. Output:
#   dilations not written: opens without optimizations: True; with them: True
#   dilations [1, 1]: opens without optimizations: True; with them: INVALID_GRAPH,
#   Unrecognized attribute: dilations for operator QLinearAveragePool
#   dilations [2, 2]: the same as [1, 1]
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
export ORT_DISABLE_TELEMETRY=1
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install -q --disable-pip-version-check onnxruntime==1.31.1 \
    onnx==1.23.2 numpy==2.4.6 protobuf==7.36.2 ml_dtypes==0.6.0
cd "$folder"
env/bin/python -I - <<'EOF'
import numpy as np
import onnx
import onnxruntime as ort
from onnx import TensorProto, helper, numpy_helper
from onnxruntime.capi.onnxruntime_pybind11_state import InvalidGraph

x = np.random.default_rng(1).integers(0, 256, (1, 2, 8, 8), dtype=np.uint8)
constants = {"s": np.float32(0.5), "z": np.uint8(128)}


def opens(attributes, level):
    graph = helper.make_graph(
        [helper.make_node("DequantizeLinear", ["x", "s", "z"], ["xf"]),
         helper.make_node("AveragePool", ["xf"], ["yf"], kernel_shape=[2, 2], **attributes),
         helper.make_node("QuantizeLinear", ["yf", "s", "z"], ["y"])],
        "pool",
        [helper.make_tensor_value_info("x", TensorProto.UINT8, x.shape)],
        [helper.make_tensor_value_info("y", TensorProto.UINT8, [1, 2, "rows", "columns"])],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 19)], ir_version=9)
    onnx.checker.check_model(model, full_check=True)
    options = ort.SessionOptions()
    options.graph_optimization_level = level
    try:
        session = ort.InferenceSession(model.SerializeToString(), options, ["CPUExecutionProvider"])
    except InvalidGraph as error:
        return "INVALID_GRAPH, " + str(error).partition(", Error ")[2]
    return session.run(None, {"x": x})[0].size > 0


level = ort.GraphOptimizationLevel
REFUSED = "INVALID_GRAPH, Unrecognized attribute: dilations for operator QLinearAveragePool"
as_stated = True
for title, attributes, expected in (("not written", {}, True),
                                    ("[1, 1]", {"dilations": [1, 1]}, REFUSED),
                                    ("[2, 2]", {"dilations": [2, 2]}, REFUSED)):
    without = opens(attributes, level.ORT_DISABLE_ALL)
    optimized = opens(attributes, level.ORT_ENABLE_ALL)
    print(f"dilations {title}: opens without optimizations: {without}; with them: {optimized}")
    as_stated = as_stated and without is True and optimized == expected
if not as_stated:
    raise SystemExit("onnxruntime no longer treats dilations of a quantized pool as stated")
EOF
