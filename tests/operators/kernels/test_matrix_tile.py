"""The matrix product of kernels against numpy in float64."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tests.operators.kernels import needs_kernels
from tests.support.profiles import scaled

pytestmark = needs_kernels


@pytest.fixture(scope="module")
def product() -> Callable[..., None]:
    import numba

    from me2e_compress.operators.kernels.intrinsics import OPTIONS
    from me2e_compress.operators.kernels.vectors import host_tile, matrix_product

    multiply = matrix_product(host_tile())

    def call(
        a: int, b: int, c: int, a_row: int, a_step: int, b_step: int, c_row: int,
        m: int, n: int, k: int, add: int,
    ) -> None:  # fmt: skip
        multiply((a, b, c, a_row, a_step, b_step, c_row, m, n, k, add))

    made: Callable[..., None] = numba.njit(**OPTIONS)(call)
    return made


@settings(max_examples=scaled(60))
@given(
    m=st.integers(0, 40),
    n=st.integers(0, 70),
    k=st.integers(0, 12),
    add=st.booleans(),
    turned=st.booleans(),
    seed=st.integers(0, 1000),
)
@example(m=29, n=95, k=7, add=True, turned=False, seed=0)
def test_it_is_the_product_and_nothing_beyond_is_written(
    product: Callable[..., None],
    m: int, n: int, k: int, add: bool, turned: bool, seed: int,
) -> None:  # fmt: skip
    random = np.random.default_rng(seed)
    # Rows are longer than what is multiplied; what lies beyond is no number
    a = random.normal(size=(k, m) if turned else (m, k)).astype(np.float32)
    b = np.full((k, n + 5), np.nan, np.float32)
    b[:, :n] = random.normal(size=(k, n))
    c: Any = random.normal(size=(m + 1, n + 3)).astype(np.float32)
    before = c.copy()
    strides = (1, m) if turned else (k, 1)

    product(
        a.ctypes.data, b.ctypes.data, c.ctypes.data, *strides, n + 5, n + 3,
        m, n, k, int(add),
    )  # fmt: skip

    rows = (a.T if turned else a).astype(np.float64)
    wanted = before.astype(np.float64)
    wanted[:m, :n] = rows @ b[:, :n] + (wanted[:m, :n] if add else 0)
    assert np.allclose(c, wanted, rtol=1e-5, atol=1e-5)
    assert np.array_equal(c[m:], before[m:])
    assert np.array_equal(c[:, n:], before[:, n:])
