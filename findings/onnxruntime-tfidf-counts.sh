#!/usr/bin/env bash
# Guess: TfIdfVectorizer with mode TF counts in whole numbers and converts the counts to
# float32 at the end, so that of 16,778,216 equal words (a number that float32 holds) it
# answers 16,778,216. It is the only standard operator that counts, and so a way to write
# a histogram inside a graph.
#
# In truth, every word adds 1 to a float32. At 2^24 = 16,777,216 adding 1 changes nothing
# any more: every larger count stands still there, without a warning. A picture of six
# cameras has more elements than that, and most of what follows a Relu is zero.
#
# onnxruntime 1.32.0 (CPU), onnx 1.23.2, numpy 2.4.6, Python 3.11; 2026-12-01.
# Output (words, of which 1,000 are another: the two counts):
#   1000000: 999000, 1000
#   16779216: 16777216, 1000
#   33556432: 16777216, 1000
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
import onnxruntime as ort
from onnx import TensorProto, helper

MOST = 1 << 24
SIZES = (1_000_000, MOST + 2_000, 2 * MOST + 2_000)
node = helper.make_node(
    "TfIdfVectorizer", ["words"], ["counts"], mode="TF", min_gram_length=1,
    max_gram_length=1, max_skip_count=0, ngram_counts=[0], ngram_indexes=[0, 1],
    pool_int64s=[7, 9])
ports = [helper.make_tensor_value_info("words", TensorProto.INT32, ["n"]),
         helper.make_tensor_value_info("counts", TensorProto.FLOAT, [2])]
model = helper.make_model(
    helper.make_graph([node], "one", ports[:1], ports[1:]),
    opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
session = ort.InferenceSession(
    model.SerializeToString(), providers=["CPUExecutionProvider"])
for size in SIZES:
    words = np.full(size, 7, np.int32)
    words[np.random.default_rng().choice(size, 1_000, replace=False)] = 9
    counts = session.run(None, {"words": words})[0].astype(int).tolist()
    print(f"{size}: {counts[0]}, {counts[1]}")
    if counts != [min(size - 1_000, MOST), 1_000]:
        raise SystemExit(f"it counts otherwise now: {counts}")
EOF
