"""Winograd's convolution in a session: its kernel against its float64 reference."""

import resource
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx_ir as ir
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from me2e_compress.base.errors import FramesError
from me2e_compress.operators import kernels
from me2e_compress.operators.convolutions import WinogradConvolution
from me2e_compress.runtime.session import Session
from tests.operators.kernels import needs_kernels
from tests.operators.running import graph_of
from tests.support.profiles import scaled

pytestmark = needs_kernels

OPERATOR = WinogradConvolution()
Arrays = dict[str, npt.NDArray[np.float32]]

# small images are one block of tiles, others some; 70 channels are two groups
channels = st.sampled_from([1, 3, 16, 33, 70])
sides = st.sampled_from([1, 2, 3, 4, 7, 8, 13, 29, 70])
pads = st.lists(st.integers(0, 2), min_size=4, max_size=4)


def arrays_of(batch: int, deep: int, out: int, high: int, wide: int) -> Arrays:
    random = np.random.default_rng(high * wide + out)
    scale = 1 / np.sqrt(9 * deep)
    drawn = {
        "X": random.normal(1, 1, (batch, deep, high, wide)),
        "W": random.normal(0, scale, (out, deep, 3, 3)),
        "B": random.normal(size=out),
    }
    return {name: array.astype(np.float32) for name, array in drawn.items()}


def check(arrays: Arrays, attributes: dict[str, Any], threads: int) -> None:
    model = graph_of(OPERATOR.own, arrays, opset=17, attributes=attributes)
    expected = OPERATOR.reference(list(arrays.values()), attributes)

    result = Session(model, threads=threads).run(arrays)["result"]

    found = np.asarray(result, np.float32)
    assert found.shape == expected.shape
    # a Conv's own error here is up to 2e-6
    np.testing.assert_allclose(found, expected, rtol=0, atol=4e-5)


@settings(max_examples=scaled(12))
@given(
    batch=st.integers(1, 3),
    deep=channels,
    out=channels,
    high=sides,
    wide=sides,
    pads=pads,
    relu=st.integers(0, 1),
    threads=st.integers(1, 2),
)
@example(2, 3, 70, 70, 70, [1, 1, 1, 1], 0, 2)
@example(1, 33, 70, 13, 7, [1, 0, 2, 0], 1, 2)
def test_any_size_and_any_pads(
    batch: int,
    deep: int,
    out: int,
    high: int,
    wide: int,
    pads: list[int],
    relu: int,
    threads: int,
) -> None:
    pads[2] = max(pads[2], 3 - high - pads[0])
    pads[3] = max(pads[3], 3 - wide - pads[1])
    arrays = arrays_of(batch, deep, out, high, wide)

    check(arrays, {"pads": pads, "relu": relu}, threads)


def test_the_error_is_small_against_a_sum_of_thousands() -> None:
    arrays = arrays_of(1, 512, 16, 12, 20)
    arrays["X"] -= 1
    model = graph_of(OPERATOR.own, arrays, opset=17)
    expected = OPERATOR.reference(list(arrays.values()), {"pads": (0,) * 4, "relu": 0})

    error = Session(model, threads=1).run(arrays)["result"] - expected

    assert 10 * np.log10(expected.var() / np.square(error).mean()) > 115


def test_no_run_keeps_memory() -> None:
    arrays = arrays_of(1, 16, 16, 70, 70)
    session = Session(graph_of(OPERATOR.own, arrays, opset=17), threads=1)
    for _ in range(3):
        session.run(arrays)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt

    for _ in range(10):
        session.run(arrays)

    # a run takes 4 MB, a thousand pages
    assert resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before < 2000


@pytest.mark.parametrize(
    ("name", "shape", "message"),
    [
        ("X", (1, 4, 5), "ranks"),
        ("X", (1, 5, 5, 5), "do not fit"),
        ("W", (3, 2, 4, 6), "do not fit"),
        ("B", (5,), "do not fit"),
        ("options", (4,), "do not fit"),
        ("X", (1, 4, 1, 5), "at least 2 x 2"),
    ],
)
def test_misfit_inputs(name: str, shape: tuple[int, ...], message: str) -> None:
    shapes = {"X": (1, 4, 5, 5), "W": (3, 3, 4, 6), "B": (6,), "options": (5,)}
    shapes[name] = shape
    arrays: dict[str, npt.NDArray[Any]] = {
        each: np.zeros(size, np.int64 if each == "options" else np.float32)
        for each, size in shapes.items()
    }
    model = graph_of(OPERATOR.own, arrays, opset=17, open_dims=True)
    for node in model.graph:
        node.domain = kernels.DOMAIN
    model.graph.outputs[0].type = ir.TensorType(ir.DataType.FLOAT)

    with pytest.raises(FramesError, match=message):
        Session(model, threads=1).run(arrays)
