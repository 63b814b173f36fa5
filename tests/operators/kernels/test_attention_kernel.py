"""Attention in a session: its kernel against its float64 reference."""

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from me2e_compress.base.errors import FramesError
from me2e_compress.operators.multi_head_attention import FusedMultiHeadAttention
from me2e_compress.runtime import runnable
from me2e_compress.runtime.session import Session
from tests.operators.kernels import needs_kernels
from tests.operators.running import graph_of
from tests.support.profiles import scaled

pytestmark = needs_kernels

OPERATOR = FusedMultiHeadAttention()
Arrays = dict[str, npt.NDArray[Any]]


def drawn(
    batch: int, queries: int, keys: int, width: int, *, seed: int = 0, large: float = 1
) -> Arrays:
    random = np.random.default_rng(seed)
    sizes = {"query": queries, "key": keys, "value": keys}
    draws = {
        name: random.normal(size=(batch, count, width)) for name, count in sizes.items()
    }
    draws["query"] *= large
    return {name: array.astype(np.float32) for name, array in draws.items()}


def ran(
    arrays: Arrays, heads: int, *, threads: int = 1, open_dims: bool = False
) -> Any:
    attributes = {"heads": heads}
    model = graph_of(
        OPERATOR.own, arrays, opset=17, attributes=attributes, open_dims=open_dims
    )
    return Session(model, threads=threads).run(arrays)["result"]


def expected(arrays: Arrays, heads: int) -> npt.NDArray[np.floating]:
    return OPERATOR.reference(list(arrays.values()), {"heads": heads})


@settings(max_examples=scaled(15))
@given(
    batch=st.integers(1, 2),
    queries=st.sampled_from([1, 7, 16, 47, 49, 96, 200]),
    keys=st.sampled_from([1, 5, 64, 255, 256, 257, 600]),
    heads=st.integers(1, 3),
    channels=st.sampled_from([1, 5, 16, 32, 67, 128]),
    large=st.sampled_from([0.1, 1, 10]),
    seed=st.integers(0, 1000),
)
@example(batch=2, queries=97, keys=300, heads=2, channels=256, large=1, seed=0)
def test_it_answers_its_reference(
    batch: int, queries: int, keys: int, heads: int, channels: int, large: float,
    seed: int,
) -> None:  # fmt: skip
    arrays = drawn(batch, queries, keys, heads * channels, seed=seed, large=large)

    result = ran(arrays, heads)

    assert np.allclose(result, expected(arrays, heads), rtol=1e-4, atol=2e-5)


@pytest.mark.parametrize(("width", "called"), [(8, ["MultiHeadAttention"]), (300, [])])
def test_the_kernel_refuses_wide_heads(width: int, called: list[str]) -> None:
    arrays = drawn(1, 5, 6, width)
    model = graph_of(OPERATOR.own, arrays, opset=17)

    _, needed = runnable.replace_fused(model, compiled=True)

    assert [each.op_type for each in needed] == called
    assert np.allclose(ran(arrays, 1), expected(arrays, 1), atol=1e-5)


def test_scores_that_would_overflow_without_the_maximum() -> None:
    arrays = drawn(1, 50, 700, 32)
    arrays["query"] *= 1000
    arrays["key"] = np.sort(arrays["key"], axis=1)  # later blocks have larger scores
    arrays["query"][:] = np.abs(arrays["query"])

    result = ran(arrays, 2)

    assert np.isfinite(result).all()
    assert np.allclose(result, expected(arrays, 2), rtol=1e-3, atol=1e-3)


def test_powers_are_accurate() -> None:
    x = np.linspace(-80, 0, 5000, dtype=np.float32).reshape(1, -1, 1)
    key = np.array([[[0], [1]]], np.float32)

    result = ran({"query": x, "key": key, "value": key}, 1)

    power = np.exp(x.astype(np.float64))
    assert np.allclose(result, power / (1 + power), rtol=1e-5, atol=0)
    near = x > -4  # further below, the rounding of x log2(e) is most of it
    assert np.allclose(result[near], (power / (1 + power))[near], rtol=6e-7, atol=0)


def test_a_query_that_is_no_number_is_none_afterwards() -> None:
    arrays = drawn(1, 60, 300, 16)
    arrays["query"][0, 7, 3] = np.nan

    result = ran(arrays, 1)

    assert np.isnan(result[0, 7]).all()
    assert np.isfinite(np.delete(result, 7, axis=1)).all()


def test_sizes_that_differ_are_a_sentence() -> None:
    arrays = drawn(1, 5, 6, 8)
    model = graph_of(OPERATOR.own, arrays, opset=17)
    for port in model.graph.inputs:
        assert port.shape is not None
        port.shape[1] = port.name
    session = Session(model, threads=1)

    with pytest.raises(FramesError, match="the inputs do not fit each other"):
        session.run({**arrays, "key": arrays["key"][:, :4]})
