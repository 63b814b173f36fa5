#!/usr/bin/env bash
# Guess: a float bias beside an int8 weight is added in float, or clipped to int32.
#
# In truth, onnxruntime writes it as int32 in steps of input scale times weight scale, by
# Div, Round and Cast, and nothing looks whether it fits. ONNX leaves open what a Cast
# of a number beyond int32 gives; on x86-64 it is -2^31 for either sign. A channel with a
# tiny weight scale, as of a dead filter, then answers minus the limit where its bias is
# positive; the channels beside it are right.
#
# onnxruntime 1.31.1 (CPU, x86-64), onnx 1.23.2, numpy 2.4.6, Python 3.11; 2026-11-29.
# Steps of the bias are 2^-30, 2^-30 and 2^-14: int32 ends at 2. Output:
#   biases:               3.0 -3.0 0.5
#   without optimizations 3.0 -3.0 0.53125
#   with optimizations    -2.0 -2.0 0.53125; stored: -2147483648 -2147483648 8192
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

x = np.array([10, 20, 30, 40], np.uint8).reshape(1, 4, 1, 1)
# the sums of products are positive: no int32 overflows when the bias is added
weight = np.array([[7, -5, 3, -1], [-2, 4, -6, 8], [9, 11, -3, 5]], np.int8)
bias = np.array([3.0, -3.0, 0.5], np.float32)
constants = {"xs": np.float32(2**-7), "xz": np.uint8(0), "w": weight.reshape(3, 4, 1, 1),
             "ws": np.array([2**-23, 2**-23, 2**-7], np.float32), "b": bias,
             "ys": np.float32(2**-5), "yz": np.uint8(128)}
graph = helper.make_graph(
    [helper.make_node("DequantizeLinear", ["x", "xs", "xz"], ["xf"]),
     helper.make_node("DequantizeLinear", ["w", "ws"], ["wf"], axis=0),
     helper.make_node("Conv", ["xf", "wf", "b"], ["yf"]),
     helper.make_node("QuantizeLinear", ["yf", "ys", "yz"], ["yq"]),
     helper.make_node("DequantizeLinear", ["yq", "ys", "yz"], ["y"])],
    "layer",
    [helper.make_tensor_value_info("x", TensorProto.UINT8, x.shape)],
    [helper.make_tensor_value_info("y", TensorProto.FLOAT, [1, 3, 1, 1])],
    [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()])
model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
onnx.checker.check_model(model, full_check=True)


def answer(level):
    options = ort.SessionOptions()
    options.graph_optimization_level = level
    options.optimized_model_filepath = "written.onnx"
    options.log_severity_level = 3  # not that this file is for this machine
    session = ort.InferenceSession(model.SerializeToString(), options, ["CPUExecutionProvider"])
    return session.run(None, {"x": x})[0].ravel()


exact = answer(ort.GraphOptimizationLevel.ORT_DISABLE_ALL)
result = answer(ort.GraphOptimizationLevel.ORT_ENABLE_ALL)
stored = [numpy_helper.to_array(tensor).tolist() for tensor in
          onnx.load("written.onnx").graph.initializer if tensor.data_type == TensorProto.INT32]
print("biases:              ", *bias)
print("without optimizations", *exact)
print("with optimizations   ", *result, end="; stored: ")
print(*sum(stored, []))
if stored != [[-(2**31), -(2**31), 2**13]] or result.tolist() != [-2.0, -2.0, exact[2]] \
        or np.abs(exact[:2] - bias[:2]).max() > 2**-5:
    raise SystemExit("onnxruntime no longer writes a bias beyond int32 as stated")
EOF
