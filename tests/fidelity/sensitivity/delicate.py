"""Six layers of which one suffers from int8, and the trials that find it."""

from pathlib import Path

import numpy as np
import onnx_ir as ir

from me2e_compress.calibration.calibrator import Calibrator
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.fidelity.sensitivity import Trials
from me2e_compress.passes import Context
from me2e_compress.passes.quantize_int8 import QuantizeInt8
from me2e_compress.quantization.rules import RULE_SETS
from me2e_compress.targets import TARGETS
from tests.support.frames import record
from tests.support.nets import MODULES, net

LAYERS = 6


def delicate(bad: int) -> ir.Model:
    """Six layers in a row; one of the last four reads a tensor with an outlier."""
    steps, weights = [], {}
    random = np.random.default_rng(0)
    value = "x"
    for at in range(LAYERS):
        module = "backbone" if at < 2 else "head"
        spoil = "spike" if at == bad else "ones"
        steps.append(f'["/{module}/Mul_{at}"] a{at} = Mul({value}, {spoil})')
        steps.append(f'["/{module}/MatMul_{at}"] b{at} = MatMul(a{at}, w{at})')
        value = f"b{at}"
        turn, _ = np.linalg.qr(random.standard_normal((32, 32)))
        weights[f"w{at}"] = turn
    spike = np.ones(32)
    spike[3] = 2000.0
    weights |= {"spike": spike, "ones": np.ones(32)}
    if bad < LAYERS:
        weights[f"w{bad}"] = weights[f"w{bad}"].copy()
        weights[f"w{bad}"][3] /= 2000.0
    ports = ", ".join(f"float[32,32] w{at}" for at in range(LAYERS))
    text = (
        f"deep (float[6,32] x, {ports}, float[32] spike, float[32] ones)"
        " => (float[1,6,2] plan) <int64[2] s = {0, 0}, int64[2] e = {6, 2},"
        " int64[1] z = {0}> {" + "\n".join(steps) + f' ["/head/cut"] c = Slice({value}'
        ', s, e) ["/head/up"] plan = Unsqueeze(c, z) }'
    )
    return net(text, weights)


def trials(tmp_path: Path, bad: int) -> Trials:
    random = np.random.default_rng(1)
    frames = [
        {"x": random.standard_normal((6, 32)).astype(np.float32)} for _ in range(3)
    ]
    recording = CalibrationSet(record(tmp_path / "frames", frames))
    model = delicate(bad)
    target = TARGETS.parse("tensorrt")
    rules = RULE_SETS.parse("paper")
    everything = QuantizeInt8(rules="paper").plan(model, Context(MODULES))
    ranges = Calibrator(threads=1).run(
        model, target.tensors(everything, model), recording
    )
    return Trials(model, MODULES, rules, target, ranges, recording)
