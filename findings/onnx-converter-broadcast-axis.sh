#!/usr/bin/env bash
# Guess: onnx.version_converter writes an Add of opset 6 with broadcast=1 and axis=1 as an
# Unsqueeze that puts ones behind the smaller operand, [3] to [3, 1, 1], and an Add that
# answers the same: y[n, c, h, w] = x[n, c, h, w] + b[c].
#
# In truth, the ones are counted from axis on through the rank of the larger operand, so
# there is one too many for every axis in front: [3] becomes [3, 1, 1, 1]. Where x has a
# batch of 1 that broadcasts, too: nothing is reported, and the converted graph lays b
# along the batch and answers three times the size. With a batch of 2, or b of two axes,
# the converter raises. Only axis=0 comes out right.
#
# onnx 1.23.2, onnxruntime 1.31.1 (CPU), numpy 2.4.6, Python 3.11; 2026-11-30.
# Output (x, b, axis: axes that are inserted, and the shape of the answer):
#   [1, 3, 4, 5], [3], 1: [1, 2, 3], [3, 3, 4, 5]
#   [2, 3, 4, 5], [3], 1: not converted
#   [1, 3, 4, 5], [3, 4], 1: not converted
#   [3, 4, 5], [3], 0: [1, 2], [3, 4, 5]
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
from onnx import TensorProto, helper, version_converter

EXPECTED = {
    ((1, 3, 4, 5), (3,), 1): "other shape",
    ((2, 3, 4, 5), (3,), 1): "not converted",
    ((1, 3, 4, 5), (3, 4), 1): "not converted",
    ((3, 4, 5), (3,), 0): "right",
}


def old(x, b, axis):
    ports = [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)
             for name, shape in (("x", x), ("b", b), ("y", [None] * len(x)))]
    node = helper.make_node("Add", ["x", "b"], ["y"], broadcast=1, axis=axis)
    graph = helper.make_graph([node], "one", ports[:2], ports[2:])
    made = helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", 6)], ir_version=3)
    onnx.checker.check_model(made)
    return made


answers = {}
draws = np.random.default_rng()
for x, b, axis in EXPECTED:
    feeds = {"x": draws.normal(size=x).astype(np.float32),
             "b": draws.normal(size=b).astype(np.float32)}
    behind = (1,) * (len(x) - axis - len(b))
    truth = feeds["x"] + feeds["b"].reshape(*b, *behind)
    try:
        new = version_converter.convert_version(old(x, b, axis), 7)
    except RuntimeError:
        answers[x, b, axis] = "not converted"
        print(f"{list(x)}, {list(b)}, {axis}: not converted")
        continue
    new.ir_version = 8
    del new.graph.value_info[:]  # it leaves entries without an element type
    (insert,) = [node for node in new.graph.node if node.op_type == "Unsqueeze"]
    axes = list(insert.attribute[0].ints)
    options = ort.SessionOptions()
    options.log_severity_level = 4
    session = ort.InferenceSession(
        new.SerializeToString(), options, ["CPUExecutionProvider"])
    answer = session.run(None, feeds)[0]
    right = answer.shape == truth.shape and np.allclose(answer, truth)
    answers[x, b, axis] = "right" if right else "other shape"
    print(f"{list(x)}, {list(b)}, {axis}: {axes}, {list(answer.shape)}")
if answers != EXPECTED:
    raise SystemExit(f"it answers otherwise now: {answers}")
EOF
