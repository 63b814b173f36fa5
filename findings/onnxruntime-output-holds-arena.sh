#!/usr/bin/env bash
# Guess: what InferenceSession.run returns are numpy arrays of their own; once the session
# is deleted, all memory of its runs is free, and an output of four bytes holds four bytes.
#
# In truth, an output array lies in the session's arena and keeps all of it alive: as long
# as one scalar output is referenced, the working memory of the whole run stays resident
# after `del session` and a garbage collection. Keeping a copy of the scalar frees it.
#
# onnxruntime 1.32.0 (CPU), onnx 1.23.2, numpy 2.4.6, Python 3.11; 2026-12-01.
# Output (MB above the start, of a run whose two largest tensors take 268 MB each):
#   scalar kept, session deleted: 512 or more
#   copy of the scalar kept, session deleted: under 64
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
export ORT_DISABLE_TELEMETRY=1
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install -q --disable-pip-version-check onnxruntime==1.32.0 \
    onnx==1.23.2 numpy==2.4.6 protobuf==7.36.2 ml_dtypes==0.6.0
cd "$folder"
env/bin/python -I - <<'EOF'
import gc
import os

import numpy as np
import onnx
import onnxruntime as ort

TEXT = """
<ir_version: 9, opset_import: ["" : 17]>
wide (float[1] x, int64[1] n) => (float y) {
    a = Expand(x, n)
    b = Sigmoid(a)
    c = Mul(b, a)
    y = ReduceMax<keepdims = 0>(c)
}
"""
COUNT = 1 << 26
PAGE = os.sysconf("SC_PAGE_SIZE")


def resident_mb():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * PAGE / 1e6


def left_mb(copied):
    before = resident_mb()
    session = ort.InferenceSession(MODEL, providers=["CPUExecutionProvider"])
    (y,) = session.run(None, {"x": np.array([0.5], "f"), "n": np.array([COUNT])})
    kept = y.copy() if copied else y
    del session, y
    gc.collect()
    left = resident_mb() - before
    del kept
    return left


MODEL = onnx.parser.parse_model(TEXT).SerializeToString()
shared, own = left_mb(False), left_mb(True)
print(f"scalar kept: {shared:.0f} MB left; its copy kept: {own:.0f} MB left")
raise SystemExit(0 if shared > 512 and own < 64 else "this has changed")
EOF
