from pathlib import Path

import numpy as np
import onnx_ir as ir
import onnxruntime as ort
import pytest

from me2e_compress import graph
from me2e_compress.base.errors import GraphError
from me2e_compress.graph.files import external_tensors
from me2e_compress.graph.rewrite import add_constant
from me2e_compress.runtime.kernel_types import nodes_without_kernel
from me2e_compress.runtime.session import Session, open_graph
from tests.passes import onnx_cases
from tests.support.nets import net, parsed, stored

TEXT = """
block (float[1,8,9,9] x, float[16,8,3,3] w, float[16] b, float[16] m, float[16] v,
       float[1296,40] l) => (float[1,40] y) <int64[2] flat = {1, -1}> {
    c = Conv<kernel_shape=[3,3], pads=[1,1,1,1]>(x, w)
    n = BatchNormalization(c, b, b, m, v)
    f = Reshape(n, flat)
    y = MatMul(f, l)
}
"""


@pytest.fixture
def weights() -> dict[str, np.ndarray]:
    random = np.random.default_rng(7)
    shapes = {"w": (16, 8, 3, 3), "b": (16,), "m": (16,), "v": (16,), "l": (1296, 40)}
    return {name: random.uniform(0.5, 1.0, shape) for name, shape in shapes.items()}


@pytest.fixture
def model(weights: dict[str, np.ndarray]) -> ir.Model:
    return net(TEXT, weights)


def image() -> dict[str, np.ndarray]:
    random = np.random.default_rng(8)
    return {"x": random.normal(size=(1, 8, 9, 9)).astype(np.float32)}


def test_lent_and_mapped_weights_give_what_the_file_gives(
    model: ir.Model, tmp_path: Path
) -> None:
    graph.save(model, tmp_path / "m.onnx")
    from_file = Session(tmp_path / "m.onnx", threads=1)

    lent = Session(model, threads=1)

    want = from_file.run(image())["y"]
    assert np.array_equal(lent.run(image())["y"], want)
    graph.save(model, tmp_path / "apart.onnx", external=True)
    mapped = graph.load(tmp_path / "apart.onnx")  # not copied
    assert external_tensors(mapped)
    assert np.array_equal(Session(mapped, threads=1).run(image())["y"], want)


def test_onnxruntime_fuses_lent_weights_and_leaves_them_as_they_are(
    model: ir.Model, weights: dict[str, np.ndarray]
) -> None:
    _, lent = open_graph(model, ort.SessionOptions())

    assert set(lent) == {"w", "l"}  # the others are too small to be worth it
    for name in lent:
        kept = graph.array_of(model.graph.initializers[name])
        assert kept is not None
        assert np.array_equal(kept, weights[name].astype(np.float32))


def test_a_session_outlives_its_graph(model: ir.Model) -> None:
    session = Session(model, threads=1)
    first = session.run(image())["y"]
    del model

    assert np.array_equal(session.run(image())["y"], first)


def test_an_own_node_of_an_older_version_runs_by_its_body() -> None:
    text = """<ir_version: 10, opset_import: ["" : 17, "me2e" : 1]>
    m (float[2] x) => (float[2] y) { y = me2e.Gone(x) }
    <opset_import: ["" : 17], domain: "me2e">
    Gone (a) => (b) { b = Neg(a) }"""
    model = ir.from_onnx_text(text)
    feeds = {"x": np.array([1, 2], np.float32)}

    np.testing.assert_array_equal(Session(model).run(feeds)["y"], -feeds["x"])
    model.functions.clear()
    with pytest.raises(GraphError, match="no operator me2e::Gone"):
        Session(model)


def test_weights_of_a_body_that_lie_in_a_file_are_found(tmp_path: Path) -> None:
    big = ", ".join("1" for _ in range(600))
    text = f"""
    fork (bool turn, float[600] x) => (float[600] y) {{
        y = If (turn) <
            then_branch = twice () => (float[600] t) <float[600] o = {{{big}}}>
                {{ t = Add(x, o) }},
            else_branch = same () => (float[600] e) {{ e = Identity(x) }}
        >
    }}
    """
    graph.save(parsed(text), tmp_path / "m.onnx", external=True)
    mapped = ir.load(tmp_path / "m.onnx")  # graph.load would read them at once
    assert external_tensors(mapped)
    feeds = {"turn": np.array(True), "x": np.zeros(600, np.float32)}

    assert np.array_equal(Session(mapped).run(feeds)["y"], np.ones(600, np.float32))


@pytest.mark.parametrize("opset", [17, 20, 21, 22])
def test_int8_activations_run_at_every_opset(opset: int) -> None:
    """From 21 on, onnxruntime's own step from int8 to uint8 breaks this graph."""
    text = f"""
    <ir_version: 10, opset_import: ["" : {opset}]>
    layer (float[1,8,32] x, int8[32,64] w, float[64] b) => (float[1,8,64] y)
    <float s = {{0.05}}, int8 z = {{0}}> {{
        q = QuantizeLinear(x, s, z)
        a = DequantizeLinear(q, s, z)
        c = DequantizeLinear(w, s, z)
        m = MatMul(a, c)
        y = Add(m, b)
    }}
    """
    random = np.random.default_rng(opset)
    w, b = random.integers(-127, 128, (32, 64)).astype(np.int8), random.normal(size=64)
    x = random.uniform(-3, 3, (1, 8, 32)).astype(np.float32)
    model = stored(net(text, {"b": b}), {"w": w})

    found = Session(model, threads=1).run({"x": x})["y"]

    grid = np.round(x.astype(np.float64) / 0.05) * 0.05
    assert found == pytest.approx(grid @ (0.05 * w) + b, abs=0.02)


PADDED_POOL = """
pool (float[1,1,2,2] x) => (float[1,1,2,2] y)
<int64[8] around = {0, 0, 1, 1, 0, 0, 1, 1}> {
    q = Pad(x, around)
    y = MaxPool<kernel_shape=[3,3]>(q)
}
"""


def test_zeros_around_a_max_pool_stay_zeros() -> None:
    below = {"x": np.full((1, 1, 2, 2), -1, np.float32)}

    found = Session(parsed(PADDED_POOL), threads=1).run(below)["y"]

    assert not found.any()  # -1 where onnxruntime folds the Pad into the pool


def test_a_large_weight_that_nothing_reads_is_not_lent(model: ir.Model) -> None:
    idle = ir.tensor(np.ones(2000, np.float32), name="idle")
    model.graph.register_initializer(ir.Value(name="idle", const_value=idle))

    assert set(Session(model, threads=1).run(image())) == {"y"}


def test_a_graph_that_is_refused_twice_makes_no_warning(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    model = parsed(
        "g (float[1,4] x, float[3,3] w) => (float[1,3] y) { y = MatMul(x, w) }"
    )
    (_, weight), product = model.graph.inputs, model.graph[0]
    model.graph.inputs.remove(weight)
    known = add_constant(model.graph, np.ones((3, 3), np.float32), "known")
    product.replace_input_with(1, known)
    graph.save(model, tmp_path / "m.onnx")

    with pytest.raises(GraphError, match="onnxruntime cannot run this graph"):
        Session(tmp_path / "m.onnx")

    assert capfd.readouterr() == ("", "")


# Which operators of which types onnxruntime's CPU runs, as it says itself.


SAMPLED = """
    <ir_version: 9, opset_import: ["" : 16]>
    m (%(kind)s[1,1,2,2] x, float[1,1,1,2] g) => (%(kind)s[1,1,1,1] y) {
        a = Cast<to=11>(x) b = Cast<to=11>(g)
        ["sampler"] s = GridSample(a, b)
        y = Cast<to=%(to)d>(s)
    }
"""


@pytest.mark.parametrize(
    ("kind", "to", "remedy"),
    [
        ("float", 1, r": import-normalize makes it float32 \(compress -r exact\)$"),
        ("double", 11, "'sampler'.$"),  # import-normalize keeps inputs and outputs
    ],
)
def test_a_session_says_what_has_no_kernel(kind: str, to: int, remedy: str) -> None:
    model = ir.from_onnx_text(SAMPLED % {"kind": kind, "to": to})

    said = r"^onnxruntime has no kernel for GridSample of float64 \(node 'sampler'\)"
    with pytest.raises(GraphError, match=said) as refused:
        Session(model)

    assert refused.match(remedy)


@pytest.mark.slow
def test_nothing_that_opens_is_said_to_have_no_kernel() -> None:
    """Every model of ONNX's own suite: 1,500 open, 25 of 39 others are named."""
    opened = named = 0
    for case in onnx_cases.load():
        model = ir.from_proto(case.model)
        graph.infer_shapes(model)
        said = [what for _, what in nodes_without_kernel(model)]
        try:
            Session(model)
        except (GraphError, TypeError):
            named += bool(said)
        else:
            assert said == [], case.name
            opened += 1
    assert opened > 1_000
    assert named >= 10
