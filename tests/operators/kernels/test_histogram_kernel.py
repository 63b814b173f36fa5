"""The histogram of magnitudes in a session: its kernel against its reference."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from me2e_compress.operators.histogram import Histogram
from me2e_compress.runtime.session import Session
from tests.operators.drawn import histogram
from tests.operators.kernels import needs_kernels
from tests.operators.running import graph_of
from tests.support.profiles import scaled

pytestmark = needs_kernels
OPERATOR = Histogram()


@settings(max_examples=scaled(25))
@given(seed=st.integers(0, 10_000))
def test_the_kernel_counts_as_the_reference_does(seed: int) -> None:
    arrays, _ = histogram(OPERATOR.own, np.random.default_rng(seed))
    model = graph_of(OPERATOR.own, arrays, opset=17, attributes={})

    result = Session(model).run(arrays)["result"]

    np.testing.assert_array_equal(result, OPERATOR.reference([*arrays.values()], {}))


def test_more_than_a_float_counts_in_steps_of_one_are_counted() -> None:
    arrays = {"X": np.zeros((1 << 24) + 8, np.float32)}
    arrays |= {name: np.array(0, np.float32) for name in ("low", "high")}
    model = graph_of(OPERATOR.own, arrays, opset=17, attributes={})

    result = Session(model).run(arrays)["result"]

    assert int(result[0]) == (1 << 24) + 8
