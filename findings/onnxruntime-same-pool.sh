#!/usr/bin/env bash
# Guess: a pool that takes every second pixel (kernel 1, stride 2, auto_pad SAME_UPPER)
# runs on images of any size, as a Conv of that form does.
#
# In truth, where the last stride reaches beyond the image, SAME makes the padding less
# than zero. onnxruntime infers the shape, opens the graph and then raises at the first
# run, for AveragePool (opset 17) and MaxPool. So whether a file runs hangs on the size
# of the image. A Conv of the same kernel and stride runs on both sizes.
#
# onnxruntime 1.31.1 (CPU), onnx 1.23.2, numpy 2.4.6, Python 3.11; 2026-11-29. The
# same with and without optimizations. Output:
#   AveragePool of 7 x 7: runs; of 8 x 8: opens, then "padding values must be non-negative"
#   MaxPool of 7 x 7: runs; of 8 x 8: opens, then "padding values must be non-negative"
#   Conv of 7 x 7: runs; of 8 x 8: runs
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
from onnxruntime.capi.onnxruntime_pybind11_state import RuntimeException

rng = np.random.default_rng(1)
REFUSED = 'opens, then "padding values must be non-negative"'


def outcome(op_type, size, level):
    x = rng.random((1, 1, size, size), dtype=np.float32)
    one = [numpy_helper.from_array(np.ones((1, 1, 1, 1), np.float32), "one")]
    weights = one if op_type == "Conv" else []
    node = helper.make_node(op_type, ["x", *(w.name for w in weights)], ["y"],
                            kernel_shape=[1, 1], strides=[2, 2], auto_pad="SAME_UPPER")
    graph = helper.make_graph(
        [node], "every second pixel",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, x.shape)],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, [1, 1, 4, 4])], weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    onnx.checker.check_model(model, full_check=True)
    options = ort.SessionOptions()
    options.graph_optimization_level = level
    options.log_severity_level = 4  # the error is caught below
    session = ort.InferenceSession(model.SerializeToString(), options, ["CPUExecutionProvider"])
    try:
        y = session.run(None, {"x": x})[0]
    except RuntimeException as error:
        return f'opens, then "{str(error).partition("Message: ")[2].strip()}"'
    return "runs" if np.array_equal(y, x[:, :, ::2, ::2]) else "runs, and answers otherwise"


level = ort.GraphOptimizationLevel
as_stated = True
for op_type in ("AveragePool", "MaxPool", "Conv"):
    odd, even = ({outcome(op_type, size, choice) for choice in
                  (level.ORT_DISABLE_ALL, level.ORT_ENABLE_ALL)} for size in (7, 8))
    print(f"{op_type} of 7 x 7: {' / '.join(odd)}; of 8 x 8: {' / '.join(even)}")
    expected = "runs" if op_type == "Conv" else REFUSED
    as_stated = as_stated and odd == {"runs"} and even == {expected}
if not as_stated:
    raise SystemExit("onnxruntime no longer treats a padding below zero as stated")
EOF
