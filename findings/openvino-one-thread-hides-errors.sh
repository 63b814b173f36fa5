#!/usr/bin/env bash
# Guess: where a node of a compiled model fails, `infer` raises, on however many threads.
#
# In truth, with INFERENCE_NUM_THREADS=1 the synchronous `infer` returns as if nothing
# had happened, and its outputs are those of the inference before: a Reshape of three
# numbers to four "answers" the last three. With two threads the same call raises, and
# so does `start_async` followed by `wait` on one thread. A driving stack that is pinned
# to one thread would go on with the last frame's answer.
#
# OpenVINO 2026.4.1 (CPU), onnx 1.23.2, numpy 2.4.6, Python 3.11; 2026-12-01.
# Output:
#   infer, 1 thread: answers [1.0, 2.0, 3.0] again
#   infer, 2 threads: raises RuntimeError
#   start_async and wait, 1 thread: raises RuntimeError
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install -q --disable-pip-version-check openvino==2026.4.1 \
    onnx==1.23.2 numpy==2.4.6 protobuf==7.36.2 ml_dtypes==0.6.0
cd "$folder"
env/bin/python -I - <<'EOF'
import numpy as np
import openvino
from onnx import TensorProto, helper

node = helper.make_node("Reshape", ["x", "shape"], ["y"])
ports = [helper.make_tensor_value_info("x", TensorProto.FLOAT, [3]),
         helper.make_tensor_value_info("shape", TensorProto.INT64, [2]),
         helper.make_tensor_value_info("y", TensorProto.FLOAT, ["rows", "columns"])]
model = helper.make_model(helper.make_graph([node], "one", ports[:2], ports[2:]),
                          opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
good = {0: np.array([1, 2, 3], np.float32), 1: np.array([1, 3])}
bad = {0: np.array([7, 8, 9], np.float32), 1: np.array([2, 2])}


def waits(request, feeds):
    request.start_async(feeds)
    request.wait()


def infers(request, feeds):
    request.infer(feeds)


answers = []
for name, run, threads in (("infer", infers, 1), ("infer", infers, 2),
                           ("start_async and wait", waits, 1)):
    core = openvino.Core()
    compiled = core.compile_model(core.read_model(model.SerializeToString()), "CPU",
                                  {"INFERENCE_NUM_THREADS": threads})
    request = compiled.create_infer_request()
    run(request, good)
    try:
        run(request, bad)
        answer = f"answers {request.get_output_tensor(0).data.ravel().tolist()} again"
    except RuntimeError as error:
        answer = f"raises {type(error).__name__}"
    print(f"{name}, {threads} thread{'s' * (threads > 1)}: {answer}")
    answers.append(answer)
raised = "raises RuntimeError"
if answers != ["answers [1.0, 2.0, 3.0] again", raised, raised]:
    raise SystemExit("OpenVINO no longer hides a failure on one thread")
EOF
