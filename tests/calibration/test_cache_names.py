"""Tensors of a graph behind its passes, found in a cache of the file before them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.calibration.cache_names import SourceNames, taken_from
from me2e_compress.calibration.calibrator import Calibrator
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.ranges import IMPORTED, Ranges
from me2e_compress.calibration.review import factor, ratios_of
from me2e_compress.errors import FramesError
from me2e_compress.graph import digest, provenance
from me2e_compress.graph.provenance import Provenance
from me2e_compress.passes.import_normalize import ImportNormalize
from me2e_compress.workflows.prepare_int8 import PreparedGraph
from me2e_compress.zoo.shipped import WEIGHTS, shipped
from tests.nets import MODULES, net

CACHE = Path("trt.cache")


def model(body: str) -> ir.Model:
    """Read a graph of [1, 4] to [1, 4], every node its own origin."""
    read = ir.from_onnx_text(
        '<ir_version: 9, opset_import: ["" : 17]>\n'
        "m (float[1,4] x) => (float[1,4] y)"
        " <int64[2] row = {1, 4}, int64[1] flat = {4}>"
        f"{{ {body} }}"
    )
    for node in read.graph:
        provenance.stamp(node, Provenance("head", (str(node.name),)))
    return read


def cache(*names: str) -> Ranges:
    bounds = {name: (-float(at), float(at)) for at, name in enumerate(names, 1)}
    return Ranges(bounds, IMPORTED, 0, "", "", calibrator="EntropyCalibration2")


CONV_NORM = """
<ir_version: 9, opset_import: ["" : 17]>
net (float[1,16,8,8] x, float[16,16,3,3] w, float[16,16,3,3] w2,
     float[16] s, float[16] b)
    => (float[1,16,8,8] y) {
    ["/backbone/Conv"] a = Conv<kernel_shape=[3,3], pads=[1,1,1,1]>(x, w)
    ["/backbone/Norm"] n = BatchNormalization(a, s, b, b, s)
    ["/backbone/Relu"] r = Relu(n)
    ["/backbone/Last"] y = Conv<kernel_shape=[3,3], pads=[1,1,1,1]>(r, w2)
}
"""
SHAPES = {"w": (16, 16, 3, 3), "w2": (16, 16, 3, 3), "s": (16,), "b": (16,)}
SOURCE = model(
    '["/c"] c = Abs(x)\n["/s"] s = Neg(c)\n["/r"] r = Relu(s)\n["/y"] y = Exp(r)'
)
FUSED = '["f"] f = Sigmoid(x)\n["/y"] y = Exp(f)'


def fused(*origins: str) -> ir.Model:
    """Return the source with one node for some of it."""
    made = model(FUSED)
    provenance.stamp(made.graph[0], Provenance("head", origins, ("fuse",)))
    return made


def take(
    made: ir.Model, known: Ranges, *tensors: str, source: ir.Model = SOURCE
) -> tuple[Ranges, Sequence[str], str]:
    found, missing, said = taken_from(
        known, CACHE, made, tensors, SourceNames.of(source)
    )
    return found, missing, " / ".join(map(str, said))


def test_names_that_stayed_are_taken_as_they_are() -> None:
    found, missing, said = take(SOURCE, cache("x", "c", "r", "other"), "c", "r")

    assert found.tensors == {"c": (-2.0, 2.0), "r": (-3.0, 3.0)}
    assert (found.model, found.calibrator) == (digest(SOURCE), "EntropyCalibration2")
    assert (missing, said) == ([], "")


@pytest.mark.parametrize(
    "body",
    [
        '["/a"] a = Abs(x)\n["/v"] v = Reshape(a, flat)\n["/y"] y = Reshape(v, row)',
        '["/v"] v = Transpose<perm=[1,0]>(x)\n["/a"] a = Reshape(v, row)\n'
        '["/y"] y = Abs(a)',
    ],
)
def test_a_tensor_that_was_only_moved_has_the_range_of_its_elements(body: str) -> None:
    moved = model(body)

    found, missing, said = take(moved, cache("b", "a"), "v", source=moved)

    assert (found.tensors, missing) == ({"v": (-2.0, 2.0)}, [])
    assert said == "1 taken from a tensor of the same elements: v from a"


def test_other_operators_are_not_crossed() -> None:
    with pytest.raises(FramesError, match="lacks v and 0 more of 1 tensor; it has x"):
        take(
            model('["/v"] v = Slice(x, flat, flat)\n["/y"] y = Abs(v)'), cache("x"), "v"
        )


def test_a_merged_node_has_the_range_of_what_left_the_nodes_it_stands_for() -> None:
    found, missing, said = take(fused("/c", "/s", "/r"), cache("c", "s", "r"), "f")

    assert (found.tensors, missing) == ({"f": (-3.0, 3.0)}, [])
    assert said.endswith(": f from r")


def test_nodes_that_hand_on_two_tensors_are_not_guessed_between() -> None:
    source = model(
        '["/c"] c = Abs(x)\n["/s"] s = Neg(c)\n["/r"] r = Relu(c)\n["/y"] y = Add(s, r)'
    )
    made = fused("/c", "/s")

    with pytest.raises(FramesError, match="lacks f"):
        take(made, cache("c", "s", "r"), "f", source=source)


def test_a_name_that_a_merged_node_kept_is_not_trusted(tmp_path: Path) -> None:
    draws = np.random.default_rng(0)
    model = net(
        CONV_NORM, {name: draws.random(shape) for name, shape in SHAPES.items()}
    )
    source = SourceNames.of(model)
    ready = PreparedGraph.of(tmp_path / "m.onnx", model, MODULES)
    merged = ready.model.graph[0]
    assert [merged.op_type, merged.outputs[0].name] == ["Conv", "a"]

    found, missing, said = taken_from(
        cache("a", "n", "x"), CACHE, ready.model, ("x", "a"), source
    )

    assert (found.tensors["a"], missing) == ((-2.0, 2.0), [])
    assert [str(each) for each in said] == [
        "1 taken from a tensor of the same elements: a from n"
    ]
    with pytest.raises(FramesError, match="lacks a"):  # that of a is before the norm
        taken_from(cache("a"), CACHE, ready.model, ("a",), source)


@pytest.mark.slow
def test_the_drivers_tensors_get_the_ranges_that_calibration_gives_them() -> None:
    path = shipped("highway")
    loaded, frames = graph.load(path), CalibrationSet(WEIGHTS / "highway-frames")
    ready = PreparedGraph.of(path, loaded, None)
    first = PreparedGraph.of(path, loaded, None, (ImportNormalize(),)).model
    made = [value for node in first.graph for value in node.outputs]
    names = [str(each.name) for each in made if each.dtype == ir.DataType.FLOAT]
    calibrator, tensors = Calibrator(threads=1), ready.tensors()

    before = calibrator.run(first, [*names, "img"], frames)
    found, missing, _ = taken_from(
        before, CACHE, ready.model, tensors, SourceNames.of(first)
    )

    ours = calibrator.run(ready.model, tensors, frames)
    ratios = ratios_of(found, ours)
    assert missing == []
    assert max(map(factor, ratios.values())) < 1.001


def test_a_tensor_of_another_shape_is_another() -> None:
    source = model('["/c"] c = Abs(x)\n["/y"] y = Exp(c)')
    made = model('["/c"] c = Concat<axis=0>(x, x)\n["/y"] y = ReduceMax<axes=[0]>(c)')
    for each in (source, made):
        graph.infer_shapes(each)

    with pytest.raises(FramesError, match="lacks c"):
        take(made, cache("c", "y"), "c", source=source)


def test_half_of_what_one_node_was_is_not_its_result() -> None:
    made = model('["p"] p = Abs(x)\n["q"] q = Neg(p)\n["/y"] y = Exp(q)')
    for at in (0, 1):
        provenance.stamp(made.graph[at], Provenance("head", ("/c", "/s"), ("split",)))

    found, missing, _ = take(made, cache("c", "s"), "p", "q")

    assert (found.tensors, missing) == ({"q": (-2.0, 2.0)}, ["p"])


def test_what_a_cache_lacks_is_told_with_what_comes_of_it() -> None:
    _, missing, said = take(SOURCE, cache("x", "c"), "x", "c", "r")

    assert missing == ["r"]
    assert said == (
        "1 tensor not in trt.cache: r. What reads them stays float, as in TensorRT 10"
    )


@pytest.mark.parametrize("names", [("n1",), ("c", "n1", "n2")])
def test_a_cache_with_less_than_half_is_of_another_graph(
    names: tuple[str, ...],
) -> None:
    with pytest.raises(
        FramesError,
        match=rf"trt\.cache: a cache of another graph: it lacks \w and . more of 3"
        rf" tensors; it has {names[0]}",
    ):
        take(SOURCE, cache(*names), "c", "s", "r")
