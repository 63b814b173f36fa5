from pathlib import Path

import numpy as np
import onnx_ir as ir
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from me2e_compress import graph
from me2e_compress.base.errors import FramesError, GraphError
from me2e_compress.calibration.means import token_means
from me2e_compress.runtime.frames import Frame
from tests.support.nets import parsed
from tests.support.profiles import scaled

KINDS = """
kinds (float[1,4] x) => (float[1,4] y) <float limit = {0.0}> {
    best = ArgMax <axis = 1> (x)
    brave = Greater (x, limit)
    half = Cast <to = 10> (x)
    y = Neg (x)
}
"""


def kinds() -> ir.Model:
    model = parsed(KINDS)
    graph.infer_shapes(model)
    return model


def rows(*values: list[float]) -> list[Frame]:
    return [
        Frame(index, index == 0, {"x": np.array([value], np.float32)})
        for index, value in enumerate(values)
    ]


@settings(max_examples=scaled(15))
@given(
    st.lists(
        st.lists(st.floats(-3, 3, width=32), min_size=4, max_size=4),
        min_size=1,
        max_size=6,
    )
)
def test_means_majorities_and_modes(drawn: list[list[float]]) -> None:
    table = np.array(drawn, np.float32)

    means = token_means(kinds(), rows(*drawn), ["y", "brave", "best"], threads=1)

    np.testing.assert_allclose(means["y"][0].tolist(), -table.mean(0), atol=1e-5)
    np.testing.assert_array_equal(means["brave"][0], (table > 0).mean(0) >= 0.5)
    best = np.bincount(table.argmax(1), minlength=4)
    assert int(means["best"][0, 0]) == int(best.argmax())
    assert means["best"].shape == (1, 1)


def test_the_type_stays(tmp_path: Path) -> None:
    means = token_means(kinds(), rows([1, 2, 3, 4], [2, 2, 2, 2]), ["half"])

    assert means["half"].dtype == np.float16
    assert means["half"].tolist() == [[1.5, 2.0, 2.5, 3.0]]


def test_an_unknown_value_no_frames_and_no_question() -> None:
    assert token_means(kinds(), rows(), []) == {}
    with pytest.raises(FramesError, match="no frames: y has no mean"):
        token_means(kinds(), rows(), ["y"])
    with pytest.raises(GraphError, match="no value bev"):
        token_means(kinds(), rows([1, 2, 3, 4]), ["y", "bev"])


@pytest.mark.parametrize(("bad", "kind"), [(np.nan, "NaN"), (np.inf, "infinite")])
def test_what_is_not_finite_has_no_mean(bad: float, kind: str) -> None:
    frames = rows([1, 2, 3, 4], [1, bad, 3, 4])

    with pytest.raises(FramesError, match=f"frame 1 makes y {kind}: it has no mean"):
        token_means(kinds(), frames, ["y"])


def test_one_value_one_shape() -> None:
    model = parsed(" m (float[1,4] x) => (int64[2,n] where) { where = NonZero(x) }")

    with pytest.raises(FramesError, match=r"frame 1 makes where \[2, 1\], it was"):
        token_means(model, rows([1, 2, 3, 4], [0, 0, 0, 4]), ["where"])
