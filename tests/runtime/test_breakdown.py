"""Where the time goes: nodes that onnxruntime made count where they came from."""

from pathlib import Path

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.base.errors import ProviderError
from me2e_compress.runtime.breakdown import (
    NO_MODULE,
    OUTSIDE,
    Breakdown,
    break_down,
    node_runs,
)
from me2e_compress.runtime.frames import Frame
from me2e_compress.runtime.latency_trace import LatencyTrace, time_shares
from me2e_compress.runtime.optimized import optimize, origins, with_unique_names
from me2e_compress.runtime.providers import CPU, CudaProvider, Provider
from tests.support.nets import net

TEXT = """
m (float[1,4,8,8] image, float[4,4,3,3] k, float[4] b, float[64,8] w, float[8] c)
    => (float[1,4,8] y) <int64[3] flat = {1, 4, 64}> {
    ["/backbone/Conv"] a = Conv<kernel_shape=[3,3], pads=[1,1,1,1]>(image, k, b)
    ["/backbone/Relu"] r = Relu(a)
    ["/backbone/Reshape"] f = Reshape(r, flat)
    ["/head/MatMul"] m = MatMul(f, w)
    ["/head/Add"] s = Add(m, c)
    ["/tail/Relu"] y = Relu(s)
}
"""
SHAPES = {"k": (4, 4, 3, 3), "b": (4,), "w": (64, 8), "c": (8,)}
FRAMES = [Frame(0, True, {"image": np.ones((1, 4, 8, 8), np.float32)})]


@pytest.fixture
def model() -> ir.Model:
    draws = np.random.default_rng(0)
    return net(TEXT, {name: draws.normal(size=size) for name, size in SHAPES.items()})


def module_of(node: ir.Node) -> str:
    return {"backbone": "backbone", "head": "head"}.get(
        str(node.name).split("/")[1], ""
    )


def measured(model: ir.Model, provider: Provider = CPU) -> Breakdown:
    return break_down(
        model, module_of, FRAMES, runs=5, warm_up=2, threads=1, provider=provider
    )


def test_every_node_that_runs_is_of_a_module_and_both_ways_add_up(
    model: ir.Model,
) -> None:
    found = measured(model)

    assert set(found.modules_us) == {"backbone", "head", NO_MODULE, OUTSIDE}
    assert list(found.modules_us)[-1] == OUTSIDE
    assert any(name.endswith("Conv") for name in found.operators_us)
    by_module, by_operator = (
        [sum(taken) for taken in zip(*parts.values(), strict=True)]
        for parts in (found.modules_us, found.operators_us)
    )
    assert by_module == by_operator
    assert len(by_module) == 5
    assert sum(each.share for each in time_shares(found.modules_us)) == pytest.approx(1)


def test_fused_and_inserted_nodes_stand_for_those_of_the_file(model: ir.Model) -> None:
    found = optimize(model)
    stands_for = origins(model, found)

    told = [
        (node.op_type.removeprefix("Fused"), stands_for[str(node.name)].name)
        for node in found.graph
    ]
    convolutions = [name for kernel, name in told if kernel == "Conv"]
    assert convolutions in (["/backbone/Conv"], ["/backbone/Relu"])  # fused, blocked
    assert [name for kernel, name in told if kernel == "Gemm"] == ["/head/MatMul"]
    assert not {kernel for kernel, _ in told} & {"MatMul", "Add"}


def test_nodes_without_a_name_of_their_own_get_one(model: ir.Model) -> None:
    for node in model.graph:
        node.name = "same"

    found = with_unique_names(model)

    names = [node.name for node in found.graph]
    assert len(set(names)) == len(names)
    assert {node.name for node in model.graph} == {"same"}


def line(kind: str, name: str, ts: int, dur: int) -> str:
    operator = name.removesuffix("_kernel_time").upper()
    return (
        f'{{"cat" : "{kind}","dur" :{dur},"ts" :{ts},"name" :"{name}",'
        f'"args" : {{"op_name" : "{operator}"}}}},\n'
    )


def test_what_runs_inside_a_body_is_counted_once() -> None:
    lines = [
        "[\n",
        line("Node", "a_kernel_time", 10, 5),
        line("Node", "inner_kernel_time", 21, 3),
        line("Node", "if_kernel_time", 20, 6),
        line("Session", "model_run", 9, 30),
        line("Node", "a_kernel_time", 50, 7),
        line("Session", "model_run", 49, 9),
        "]\n",
    ]

    found = [
        (taken, [(node.name, node.operator, node.duration_us) for node in nodes])
        for taken, nodes in node_runs(lines)
    ]

    assert found == [(30, [("a", "A", 5), ("if", "IF", 6)]), (9, [("a", "A", 7)])]


def test_nodes_elsewhere_than_on_the_cpu_are_not_timed(model: ir.Model) -> None:
    with pytest.raises(ProviderError, match="cuda: times of nodes are measured on"):
        measured(model, CudaProvider())


def test_a_trace_keeps_its_modules_and_older_ones_are_read(tmp_path: Path) -> None:
    plain = LatencyTrace("0", "a CPU", (7, 8))
    divided = LatencyTrace("0", "a CPU", (7, 8), modules_us={"head": (1, 2)})
    for trace in (plain, divided):
        trace.save(tmp_path / "t.json")
        assert LatencyTrace.load(tmp_path / "t.json") == trace
    assert "modules_us" not in plain.to_json()
