"""What one backward pass tells, beside what one int8 node at a time does."""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.quantization.plan import RESIDUAL
from me2e_compress.sensitivity import error_sources
from me2e_compress.sensitivity import estimate as room
from me2e_compress.sensitivity.estimate import NO_PATH
from me2e_compress.sensitivity.gradients import tape
from tests.nets import conv_attention, net
from tests.sensitivity.calibrated import HEAD, Case, block


@pytest.mark.parametrize(
    ("make", "factor"), [(block, 1.6), (lambda: block(30.0), 1.6), (conv_attention, 2)]
)
def test_the_estimate_is_near_what_one_int8_node_at_a_time_costs(
    tmp_path: Path, make: Callable[[], ir.Model], factor: float
) -> None:
    case = Case.of(tmp_path, make())
    told = case.told()

    assert len(told) >= 3
    for name, cost in told.items():
        measured = case.measured(name)
        assert cost.noise is not None
        for output, noise in cost.noise.items():
            if measured[output] > 0:
                assert abs(math.log(noise / measured[output])) < math.log(factor)
            else:
                assert noise == 0


CANCELS = (
    HEAD
    + """
net (float[1,32,6,6] image, float[32,32,1,1] w0, float[32,1] w1)
    => (float[1,1] y) <int64[2] row = {1, 32}> {
    ["/backbone/stem"] a = Conv(image, w0)
    ["/backbone/Pool"] p = GlobalAveragePool(a)
    ["/head/Reshape"] r = Reshape(p, row)
    ["/head/Sum"] y = MatMul(r, w1)
}"""
)


@pytest.mark.parametrize("seed", range(3))
def test_what_channels_do_to_one_number_cancels_as_it_does(
    tmp_path: Path, seed: int
) -> None:
    random = np.random.default_rng(seed)
    weights = {"w0": random.normal(0, 0.2, (32, 32, 1, 1)), "w1": np.ones((32, 1))}
    case = Case.of(tmp_path, net(CANCELS, weights))

    cost = case.told()["/backbone/stem"]

    assert cost.noise is not None
    assert cost.noise["y"] == pytest.approx(case.measured("/backbone/stem")["y"], 0.005)


HEAVY = (
    HEAD
    + """
net (float[1,4,12,12] image, float[48,4,3,3] w0, float[48] b0, float[48,32] w1,
     float[32,32] w2, float[1,32] b2, float[32,1] w3)
    => (float[1,144,32] many, float[1,1] one)
    <int64[3] tokens = {1, 48, 144}, int64[2] two = {144, 32}> {
    ["/backbone/stem"] a = Conv<pads=[1,1,1,1]>(image, w0, b0)
    ["/backbone/Relu"] r = Relu(a)
    ["/head/Reshape"] flat = Reshape(r, tokens)
    ["/head/Transpose"] rows = Transpose<perm=[0,2,1]>(flat)
    ["/head/rows"] many = MatMul(rows, w1)
    ["/head/Flat"] matrix = Reshape(many, two)
    ["/head/Gemm"] g = Gemm<transB=1>(matrix, w2, b2)
    ["/head/Mean"] mean = ReduceMean<axes=[0], keepdims=1>(g)
    ["/head/sum"] one = MatMul(mean, w3)
}"""
)


def heavy() -> ir.Model:
    """A convolution, a product and a Gemm that is turned, of no few channels."""
    random = np.random.default_rng(0)
    shapes = {"w0": (48, 4, 3, 3), "w1": (48, 32), "w2": (32, 32), "w3": (32, 1)}
    weights = {name: random.normal(0, 0.2, each) for name, each in shapes.items()}
    biases = {"b0": random.normal(0, 1, 48), "b2": random.normal(0, 1, (1, 32))}
    return net(HEAVY, weights | biases)


def test_of_a_heavy_weight_a_part_is_looked_at_and_nothing_is_lost_of_the_sum(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    case = Case.of(tmp_path, heavy())
    whole = case.told()

    monkeypatch.setattr(error_sources, "HEAVY", 1)
    part = case.told()

    assert len(part) == 3
    for name, cost in part.items():
        told, exact = cost.noise or {}, whole[name].noise or {}
        # one number: sums alone count; of many the squares of a part of the channels
        assert told["one"] == pytest.approx(exact["one"], rel=0.02)
        assert told["many"] == pytest.approx(exact["many"], rel=0.1)
        assert told["many"] != exact["many"] or not exact["many"]


@pytest.mark.parametrize("pieces", [1, 1 << 40])
def test_waiting_for_a_gradient_changes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pieces: int
) -> None:
    case = Case.of(tmp_path, block())
    expected = case.told()

    monkeypatch.setattr(tape, "LARGE", pieces)
    told = case.told()

    for name, cost in told.items():
        assert cost.noise == pytest.approx(expected[name].noise, rel=1e-5)


def test_readers_of_one_tensor_share_its_error(tmp_path: Path) -> None:
    case = Case.of(tmp_path, block())
    grids = case.target.grids(case.plan, case.model, case.ranges)

    made = room._write(case.model, case.plan, grids, None, room.MOST_HELD).model

    rounded = [n.inputs[0] for n in made.graph if n.op_type == "QuantizeLinear"]
    assert len(rounded) == len({*rounded})
    probes = [n.inputs[0] for n in made.graph if "probe" in str(n.outputs[0].name)]
    assert len(probes) > len(rounded) > 2


def test_a_residual_branch_is_counted_to_the_convolution_it_follows(
    tmp_path: Path,
) -> None:
    case = Case.of(tmp_path, block())
    (add,) = (each for each in case.plan.placed if each.rule == RESIDUAL)
    without = tuple(each for each in case.plan.decisions if each is not add)
    bare = dataclasses.replace(
        case, plan=dataclasses.replace(case.plan, decisions=without)
    )

    both, alone = case.told()["/backbone/main"], bare.told()["/backbone/main"]

    assert "/backbone/Add" not in case.told()
    assert both.noise is not None
    assert alone.noise is not None
    assert both.noise["y"] > 1.02 * alone.noise["y"]


def test_the_same_seed_gives_the_same_bytes(tmp_path: Path) -> None:
    case = Case.of(tmp_path, block())

    first, again, other = (
        [each.noise for each in case.told(seed).values()] for seed in (0, 0, 1)
    )

    assert first == again
    assert first != other


def test_onnxruntimes_finer_grid_of_what_is_never_negative_is_known(
    tmp_path: Path,
) -> None:
    coarse = Case.of(tmp_path, block()).told()["/backbone/main"].noise
    (tmp_path / "cpu").mkdir()
    fine = (
        Case.of(tmp_path / "cpu", block(), "onnxruntime").told()["/backbone/main"].noise
    )

    assert coarse is not None
    assert fine is not None
    assert fine["small"] < 0.9 * coarse["small"]


CUT = (
    HEAD
    + """
net (float[4,32] x, float[32,32] w0, float[32,32] w1, float[32,32] w2)
    => (float[4,32] y, int64[4,1] best) {{
    ["/head/first"] a = MatMul(x, w0)
    ["/head/odd"] b = {op}(a)
    ["/head/second"] y = MatMul(b, w1)
    ["/head/third"] c = MatMul(x, w2)
    ["/head/best"] best = ArgMax<axis=1>(c)
}}"""
)


def cut(op: str) -> ir.Model:
    random = np.random.default_rng(0)
    weights = {f"w{at}": random.normal(0, 0.2, (32, 32)) for at in range(3)}
    return net(CUT.format(op=op), weights)


def test_what_lies_behind_an_operator_without_a_rule_is_not_estimated(
    tmp_path: Path,
) -> None:
    told = Case.of(tmp_path, cut("Atan")).told()

    assert told["/head/first"].noise is None
    assert told["/head/first"].reason == "Atan /head/odd: no rule"
    assert told["/head/second"].noise is not None


def test_a_node_that_only_a_choice_reads_is_not_estimated_and_not_zero(
    tmp_path: Path,
) -> None:
    told = Case.of(tmp_path, cut("Tanh")).told()

    assert told["/head/third"].noise is None
    assert told["/head/third"].reason == NO_PATH
    assert told["/head/first"].noise is not None


def test_memory_is_kept_and_what_lies_behind_the_limit_is_not_estimated(
    tmp_path: Path,
) -> None:
    told = Case.of(tmp_path, block()).told(most_held=30_000)

    assert told["/head/Linear"].noise is not None
    assert told["/backbone/stem"].noise is None
    assert "held already" in told["/backbone/stem"].reason


def test_what_a_fused_operator_samples_has_the_grid_in_front_of_its_reshapes() -> None:
    text = """<ir_version: 9, opset_import: ["" : 17]>
    net (float[4,6] x) => (float[2,12] y) <int64[2] s = {6, 4}, int64[2] t = {2, 12}> {
        ["/head/a"] a = Reshape(x, s)
        ["/head/b"] y = Reshape(a, t)
    }"""
    grid = np.float32(0.5), 128
    (value,) = net(text, {}).graph.outputs
    assert error_sources._grid(value, {"x": grid}) == grid
