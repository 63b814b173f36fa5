#!/usr/bin/env bash
# Guess: session.x64quantprecision changes how int8 sums are added, so every graph that
# opens without it opens with it.
#
# In truth, it makes onnxruntime write each signed weight anew as uint8, once for every
# product that reads it and each time under one name. A layer that is applied twice, whose
# int8 weight is one initializer, is refused the second time; a copy of the weight under
# another name opens.
#
# onnxruntime 1.31.1 (CPU, x86-64), onnx 1.23.2, numpy 2.4.6, Python 3.11; 2026-11-29.
# Output (products, weights, session.x64quantprecision):
#   1 product, 1 weight, 0: opens    1 product, 1 weight, 1: opens
#   2 products, 1 weight, 0: opens   2 products, 1 weight, 1: refused
#   2 products, 2 weights, 0: opens  2 products, 2 weights, 1: opens
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

weight = np.random.default_rng().integers(-127, 128, (8, 8)).astype(np.int8)


def model(products, weights):
    constants = {"s": np.float32(0.02), "z": np.uint8(128), "ws": np.float32(0.01)}
    for k in range(weights):
        constants |= {f"w{k}": weight, f"wz{k}": np.int8(0)}
    nodes = [helper.make_node("QuantizeLinear", ["x", "s", "z"], ["q"]),
             helper.make_node("DequantizeLinear", ["q", "s", "z"], ["y"])]
    source = "y"
    for k in range(products):
        own = k % weights
        nodes += [
            helper.make_node("DequantizeLinear", [f"w{own}", "ws", f"wz{own}"], [f"f{k}"]),
            helper.make_node("MatMul", [source, f"f{k}"], [f"m{k}"]),
            helper.make_node("QuantizeLinear", [f"m{k}", "s", "z"], [f"q{k}"]),
            helper.make_node("DequantizeLinear", [f"q{k}", "s", "z"], [f"y{k}"])]
        source = f"y{k}"
    graph = helper.make_graph(
        nodes, "layers",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, [4, 8])],
        [helper.make_tensor_value_info(source, TensorProto.FLOAT, [4, 8])],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()])
    made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    onnx.checker.check_model(made, full_check=True)
    return made.SerializeToString()


def opens(content, entry):
    options = ort.SessionOptions()
    options.add_session_config_entry("session.x64quantprecision", entry)
    options.log_severity_level = 4
    try:
        ort.InferenceSession(content, options, ["CPUExecutionProvider"])
    except Exception as error:
        if "replace the existing tensor" not in str(error):
            raise
        return False
    return True


result = {}
for products, weights in ((1, 1), (2, 1), (2, 2)):
    for entry in "01":
        result[products, weights, entry] = opens(model(products, weights), entry)
        print(f"{products} products, {weights} weights, {entry}:",
              "opens" if result[products, weights, entry] else "refused")
refused = [case for case, is_open in result.items() if not is_open]
if refused != [(2, 1, "1")]:
    raise SystemExit("the option no longer refuses a weight of two products alone")
EOF
