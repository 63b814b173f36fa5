#!/usr/bin/env bash
# Guess: an average of uint8 numbers is the float pool's average, rounded.
#
# In truth, with ceil_mode=1 and count_include_pad=1 the last windows reach beyond the
# padding, and onnxruntime's two pools part. The float one divides by the places inside
# image and padding, as onnx's reference evaluator does; the QLinearAveragePool that it
# fuses of DequantizeLinear, AveragePool and QuantizeLinear divides by the whole kernel.
# All other windows are equal, and so is everything with count_include_pad=0.
#
# onnxruntime 1.31.1 (CPU), onnx 1.23.2, numpy 2.4.6, Python 3.11; 2026-11-29. The
# image is 8 x 8, the kernel 3 x 3 with strides of 2; the last row of windows is shown:
#   count_include_pad=1: float 141 117 116 184, uint8 94 78 78 82; up to 102 steps apart
#   count_include_pad=0: float 141 117 116 184, uint8 141 117 116 184; up to 0 steps apart
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

x = np.random.default_rng(1).integers(0, 256, (1, 2, 8, 8), dtype=np.uint8)
constants = {"s": np.float32(1), "z": np.uint8(0)}


def answer(count, level):
    graph = helper.make_graph(
        [helper.make_node("DequantizeLinear", ["x", "s", "z"], ["xf"]),
         helper.make_node("AveragePool", ["xf"], ["yf"], kernel_shape=[3, 3], strides=[2, 2],
                          ceil_mode=1, count_include_pad=count),
         helper.make_node("QuantizeLinear", ["yf", "s", "z"], ["y"])],
        "pool",
        [helper.make_tensor_value_info("x", TensorProto.UINT8, x.shape)],
        [helper.make_tensor_value_info("y", TensorProto.UINT8, [1, 2, 4, 4])],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    onnx.checker.check_model(model, full_check=True)
    options = ort.SessionOptions()
    options.graph_optimization_level = level
    session = ort.InferenceSession(model.SerializeToString(), options, ["CPUExecutionProvider"])
    return session.run(None, {"x": x})[0].astype(np.int64)


def averages(divisor):
    """Divide the sums of windows by a number, or by their places in the image."""
    result = np.empty((1, 2, 4, 4))
    for row, column in np.ndindex(4, 4):
        window = x[:, :, 2 * row : 2 * row + 3, 2 * column : 2 * column + 3].astype(float)
        places = divisor or window[0, 0].size
        result[:, :, row, column] = window.sum((2, 3)) / places
    return result


level = ort.GraphOptimizationLevel
as_stated = True
for count, divisor in ((1, 9), (0, None)):
    exact, result = answer(count, level.ORT_DISABLE_ALL), answer(count, level.ORT_ENABLE_ALL)
    print(f"count_include_pad={count}: float", *exact[0, 0, -1], end=", uint8 ")
    print(*result[0, 0, -1], end=f"; up to {np.abs(exact - result).max()} steps apart\n")
    # halves are rounded either way
    as_stated = as_stated and np.abs(exact - averages(None)).max() <= 0.5001 \
        and np.abs(result - averages(divisor)).max() <= 0.5001
if not as_stated:
    raise SystemExit("onnxruntime no longer averages windows beyond the padding as stated")
EOF
