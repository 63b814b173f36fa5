"""Deformable attention in a session: its kernel against its float64 reference."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from me2e_compress.operators import Dialect, kernels
from me2e_compress.operators.deformable_attention import DeformableAttention
from me2e_compress.runtime import fused_nodes
from me2e_compress.runtime.session import Session
from tests.operators.running import graph_of
from tests.operators.test_deformable_attention import arrays_of

pytestmark = pytest.mark.skipif(
    kernels.why_not() is not None, reason=str(kernels.why_not())
)

OPERATOR = DeformableAttention()
calls = st.fixed_dictionaries(
    {
        "sizes": st.lists(
            st.tuples(st.integers(0, 5), st.integers(0, 6)), min_size=1, max_size=3
        ),
        "batch": st.integers(1, 3),
        "queries": st.sampled_from([1, 3, 300]),
        "heads": st.integers(1, 3),
        "width": st.sampled_from([1, 5, 8, 23, 32, 67]),
        "points": st.sampled_from([2, 4]),
        "group": st.just(2),
        "seed": st.integers(0, 1000),
    }
)


@settings(max_examples=40, deadline=None)
@given(
    dialect=st.sampled_from(OPERATOR.all_dialects()),
    call=calls,
    open_dims=st.booleans(),
)
def test_every_dialect_answers_its_reference(
    dialect: Dialect, call: dict[str, Any], open_dims: bool
) -> None:
    arrays = arrays_of(dialect, call)
    # what takes no index of the levels must know how many there are
    known = ["spatial_shapes"] if "level_start_index" not in arrays else []
    model = graph_of(
        dialect, arrays, opset=17, constants=known, open_dims=open_dims and not known
    )
    _, needed = fused_nodes.compiled_or_expanded(model, compiled=True)
    assert needed

    found = Session(model, threads=1).run(arrays)["result"]

    expected = OPERATOR.dialect_reference(dialect, list(arrays.values()), {})
    assert np.allclose(found, expected, rtol=1e-4, atol=1e-4)
