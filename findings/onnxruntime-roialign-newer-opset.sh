#!/usr/bin/env bash
# Guess: an operator that onnxruntime runs at opset 16 it runs at every newer opset that
# it reads; a version bump that only admits more types (bfloat16) changes nothing.
#
# In truth, RoiAlign and GlobalLpPool have CPU kernels up to opset 21 and none after. A
# valid graph of opset 22 or newer is refused on opening, not implemented, although the
# runtime reads opset 28 and the operators' numbers did not change. Their neighbour
# GlobalAveragePool, which got bfloat16 in the same opset, runs in all of them. So a file
# exported in a newer opset may have to be written in an older one to run.
#
# onnxruntime 1.32.0 (CPU), onnx 1.23.2, numpy 2.4.6, Python 3.11; 2026-11-30. Output:
#   RoiAlign: opset 16 runs, 21 runs, 22 NOT_IMPLEMENTED, 26 NOT_IMPLEMENTED
#   GlobalLpPool: opset 16 runs, 21 runs, 22 NOT_IMPLEMENTED, 26 NOT_IMPLEMENTED
#   GlobalAveragePool: opset 16 runs, 21 runs, 22 runs, 26 runs
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
export ORT_DISABLE_TELEMETRY=1
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install -q --disable-pip-version-check onnxruntime==1.32.0 \
    onnx==1.23.2 numpy==2.4.6 protobuf==7.36.2 ml_dtypes==0.6.0
cd "$folder"
env/bin/python -I - <<'EOF'
import numpy as np
import onnx
import onnxruntime as ort
from onnx import TensorProto, helper, numpy_helper

x = np.random.default_rng(0).normal(size=(1, 2, 8, 8)).astype(np.float32)
boxes = [numpy_helper.from_array(np.array([[0, 0, 4, 4]], np.float32), "boxes"),
         numpy_helper.from_array(np.array([0], np.int64), "batch")]
NODES = {
    "RoiAlign": (["x", "boxes", "batch"], {"output_height": 2, "output_width": 2}, boxes),
    "GlobalLpPool": (["x"], {}, []),
    "GlobalAveragePool": (["x"], {}, []),
}


def answer(op, opset):
    inputs, attributes, stored = NODES[op]
    graph = helper.make_graph(
        [helper.make_node(op, inputs, ["y"], **attributes)], "one",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, x.shape)],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, [None] * 4)], stored)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=10)
    onnx.checker.check_model(model, full_check=True)
    options = ort.SessionOptions()
    options.log_severity_level = 4
    try:
        session = ort.InferenceSession(model.SerializeToString(), options, ["CPUExecutionProvider"])
    except Exception as error:
        return "NOT_IMPLEMENTED" if "NOT_IMPLEMENTED" in str(error) else str(error)
    session.run(None, {"x": x})
    return "runs"


seen = {op: [answer(op, opset) for opset in (16, 21, 22, 26)] for op in NODES}
for op, answers in seen.items():
    print(f"{op}: opset " + ", ".join(f"{n} {a}" for n, a in zip((16, 21, 22, 26), answers)))
refused = ["runs", "runs", "NOT_IMPLEMENTED", "NOT_IMPLEMENTED"]
assert seen == {"RoiAlign": refused, "GlobalLpPool": refused, "GlobalAveragePool": ["runs"] * 4}, seen
EOF
