import numpy as np
import onnx_ir as ir
import pytest
from hypothesis import given
from hypothesis import strategies as st

from me2e_compress.fidelity import sketches
from me2e_compress.fidelity.sketches import Sketch, apart, gap, sketch
from me2e_compress.runtime.probing import READINGS, insert_probes
from me2e_compress.runtime.session import Session

DOUBLED = """
<ir_version: 9, opset_import: ["" : %d]>
doubled (float[%s] x) => (float[%s] y) { y = Add(x, x) }
"""


def read(opset: int, form: str, x: np.ndarray) -> np.ndarray:
    model = ir.from_onnx_text(DOUBLED % (opset, form, form))
    session = Session(insert_probes(model, ["y"], Sketch()), optimize=False)
    return session.run({"x": x}, [READINGS])[READINGS]


@pytest.mark.parametrize(("form", "sized"), [("6,10,7", True), ("a,b,c", False)])
@pytest.mark.parametrize("opset", [11, 17])
def test_a_graph_computes_the_sketch_that_numpy_does(
    opset: int, form: str, sized: bool
) -> None:
    x = np.random.default_rng(0).standard_normal((6, 10, 7)).astype(np.float32)

    found = read(opset, form, x)

    np.testing.assert_allclose(found, sketch(2 * x, sized=sized), rtol=1e-3, atol=1e-3)


def test_large_tensors_have_a_sketch_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sketches, "LARGE", 64)
    x = np.random.default_rng(0).standard_normal((6, 10, 7)).astype(np.float32)

    np.testing.assert_allclose(
        read(17, "6,10,7", x), sketch(2 * x), rtol=1e-3, atol=1e-3
    )


@given(
    st.integers(0, 10_000),
    st.floats(1e-6, 1.0),
    st.tuples(st.integers(1, 9), st.integers(1, 40), st.integers(1, 9)),
)
def test_the_gap_of_sketches_is_that_of_the_tensors(
    seed: int, share: float, shape: tuple[int, ...]
) -> None:
    draws = np.random.default_rng(seed)
    a, noise = draws.standard_normal((2, *shape))
    b = a + share * noise

    found = gap(sketch(a)[None], sketch(b)[None])

    # sixteen products of signs: within a factor of ten, nearly always of two
    assert apart(a, b) / 10 < found < apart(a, b) * 10


def test_the_gap_is_right_to_a_third_on_average() -> None:
    draws = np.random.default_rng(0)
    ratios = []
    for _ in range(100):
        a, noise = draws.standard_normal((2, 50, 40))
        b = a + 0.1 * noise
        ratios.append(float(gap(sketch(a)[None], sketch(b)[None])) / apart(a, b))

    assert np.exp(np.mean(np.abs(np.log(ratios)))) < 1.33


def test_one_element_among_many_is_seen() -> None:
    a = np.random.default_rng(0).standard_normal((300, 400))
    b = a.copy()
    b[17, 33] += 0.1

    assert float(gap(sketch(a)[None], sketch(b)[None])) > 1e-4


@pytest.mark.parametrize("filled", [-1e9, -np.inf])
def test_what_stands_beside_masks_is_seen(filled: float) -> None:
    a = np.random.default_rng(0).standard_normal((30, 40))
    a[:, ::2] = filled
    b = a.copy()
    b[:, 1::2] *= 1.1

    assert float(gap(sketch(a)[None], sketch(b)[None])) > 1e-2
    assert apart(a, b) > 1e-2


def test_equal_tensors_have_no_gap_whatever_they_hold() -> None:
    for each in (np.zeros(4), np.array([np.nan, 1.0]), np.array([np.inf, -1.0])):
        assert float(gap(sketch(each)[None], sketch(each)[None])) == 0
        assert apart(each, each) == 0


def test_a_nan_in_one_of_them_is_an_infinite_gap() -> None:
    a, b = np.array([1.0, 2.0]), np.array([1.0, np.nan])

    assert float(gap(sketch(a)[None], sketch(b)[None])) == np.inf
    assert apart(a, b) == apart(a, np.ones(3)) == np.inf
