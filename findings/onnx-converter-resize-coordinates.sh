#!/usr/bin/env bash
# Guess: onnx.version_converter writes Upsample (opset 9) and Resize (opset 10) as a Resize
# of opset 13 that answers the same, since their sampling can be written with attributes.
#
# In truth, it writes neither coordinate_transformation_mode nor nearest_mode. Before
# opset 11 pixels were sampled at i / scale, since then a Resize that says nothing samples
# at (i + 0.5) / scale - 0.5: every linear resize answers otherwise, and a nearest one
# does where the scale is no whole number. Both graphs pass the checker. With
# "asymmetric" and "floor" added by hand the converted graph answers as the old one.
#
# onnx 1.23.2, onnxruntime 1.31.1 (CPU), numpy 2.4.6, Python 3.11; 2026-11-29.
# Output (operator, mode, scale: as converted, and with the attributes):
#   Upsample, linear, 2.0: differs, same     Resize, linear, 2.0: differs, same
#   Upsample, nearest, 2.0: same, same       Resize, nearest, 2.0: same, same
#   Upsample, nearest, 1.6: differs, same    Resize, nearest, 1.6: differs, same
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
from onnx import TensorProto, helper, numpy_helper, version_converter

OPSET = {"Upsample": 9, "Resize": 10}
picture = np.random.default_rng().normal(size=(1, 3, 10, 10)).astype(np.float32)


def model(operator, mode, scale):
    scales = numpy_helper.from_array(np.float32([1, 1, scale, scale]), "scales")
    graph = helper.make_graph(
        [helper.make_node(operator, ["x", "scales"], ["y"], mode=mode)], "one",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, picture.shape)],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, [1, 3, "h", "w"])], [scales])
    made = helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", OPSET[operator])], ir_version=8)
    onnx.checker.check_model(made, full_check=True)
    return made


def answer(made):
    onnx.checker.check_model(made, full_check=True)
    options = ort.SessionOptions()
    options.log_severity_level = 3
    session = ort.InferenceSession(
        made.SerializeToString(), options, ["CPUExecutionProvider"])
    return session.run(None, {"x": picture})[0]


differ = []
for operator in OPSET:
    for mode, scale in (("linear", 2.0), ("nearest", 2.0), ("nearest", 1.6)):
        old = model(operator, mode, scale)
        truth = answer(old)
        new = version_converter.convert_version(old, 13)
        converted = np.abs(answer(new) - truth).max()
        (resize,) = [node for node in new.graph.node if node.op_type == "Resize"]
        resize.attribute.extend(
            helper.make_attribute(key, value) for key, value in
            (("coordinate_transformation_mode", "asymmetric"), ("nearest_mode", "floor")))
        mended = np.abs(answer(new) - truth).max()
        words = ["differs" if error > 1e-5 else "same" for error in (converted, mended)]
        print(f"{operator}, {mode}, {scale}: {', '.join(words)}")
        if mended > 1e-5:
            raise SystemExit("with the attributes it no longer answers as before")
        if converted > 1e-5:
            differ.append((operator, mode, scale))
expected = [(each, *rest) for each in OPSET for rest in (("linear", 2.0), ("nearest", 1.6))]
if differ != expected:
    raise SystemExit(f"other graphs differ now: {differ}")
EOF
