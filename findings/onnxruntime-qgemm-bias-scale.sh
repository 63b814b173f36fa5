#!/usr/bin/env bash
# Guess: an int32 bias counts in the steps of its own DequantizeLinear; a layer where
# those are not input scale times weight scale stays float, or is computed right.
#
# In truth, that holds for a Conv, which onnxruntime then leaves in float, and not for a
# Gemm: that becomes a QGemm, which has no input for a scale of the bias and takes its
# integers in steps of input scale times weight scale. Here those are 1/64 of the file's,
# so the bias is 1/64 of what it was, and nothing is logged. (A Gemm becomes a QGemm only
# where the zero points of its input and weight are written down.)
#
# onnxruntime 1.31.1 (CPU), onnx 1.23.2, numpy 2.4.6, Python 3.11; 2026-11-29. Output:
#   Conv: without optimizations 1.5625 -1.5625 1.03125; with them 1.5625 -1.5625 1.03125
#   by DequantizeLinear DequantizeLinear DequantizeLinear Conv QuantizeLinear
#   DequantizeLinear
#   Gemm: without optimizations 1.5625 -1.5625 1.03125; with them 0.03125 -0.03125 0.25
#   by QGemm DequantizeLinear
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

x = np.array([[10, 20, 30, 40]], np.uint8)
weight = np.array([[7, -5, 3, -1], [-2, 4, -6, 2], [9, 11, -3, 20]], np.int8)
BIAS = np.array([100, -100, 50], np.int32)
STEP = np.float32(2**-6)  # of input, weight and bias


def answer(op_type, optimize):
    axes = (1, 1) if op_type == "Conv" else ()
    constants = {"s": STEP, "z": np.uint8(0), "wz": np.int8(0), "b": BIAS,
                 "w": weight.reshape(3, 4, 1, 1) if axes else weight,
                 "ys": np.float32(2**-5), "yz": np.uint8(128)}
    attributes = {} if axes else {"transB": 1}
    graph = helper.make_graph(
        [helper.make_node("DequantizeLinear", ["x", "s", "z"], ["xf"]),
         helper.make_node("DequantizeLinear", ["w", "s", "wz"], ["wf"]),
         helper.make_node("DequantizeLinear", ["b", "s"], ["bf"]),
         helper.make_node(op_type, ["xf", "wf", "bf"], ["yf"], **attributes),
         helper.make_node("QuantizeLinear", ["yf", "ys", "yz"], ["yq"]),
         helper.make_node("DequantizeLinear", ["yq", "ys", "yz"], ["y"])],
        "layer",
        [helper.make_tensor_value_info("x", TensorProto.UINT8, x.shape + axes)],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, (1, 3) + axes)],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    onnx.checker.check_model(model, full_check=True)
    options = ort.SessionOptions()
    level = ort.GraphOptimizationLevel
    options.graph_optimization_level = level.ORT_ENABLE_ALL if optimize else level.ORT_DISABLE_ALL
    options.optimized_model_filepath = "written.onnx"
    options.log_severity_level = 3  # not that this file is for this machine
    session = ort.InferenceSession(model.SerializeToString(), options, ["CPUExecutionProvider"])
    y = session.run(None, {"x": x.reshape(x.shape + axes)})[0].ravel()
    return y, [node.op_type for node in onnx.load("written.onnx").graph.node]


as_stated = []
for op_type in ("Conv", "Gemm"):
    exact, _ = answer(op_type, optimize=False)
    result, operators = answer(op_type, optimize=True)
    print(f"{op_type}: without optimizations", *exact, end="; with them ")
    print(*result, "by", *operators)
    # what the bias lost: all but 1/64 of it, rounded to steps of the output
    lost = BIAS * STEP * (1 - STEP)
    as_stated.append((np.abs(exact - result).max() < 2**-5,
                      np.abs(exact - result - lost).max() <= 2**-5, "QGemm" in operators))
if as_stated != [(True, False, False), (False, True, True)]:
    raise SystemExit("onnxruntime no longer reads the scale of a bias as stated")
EOF
