import ml_dtypes
import numpy as np
import onnx_ir as ir
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from me2e_compress.manager.equivalence import passed
from me2e_compress.manager.output_errors import errors, relative, tolerances
from me2e_compress.manager.report import Verification
from me2e_compress.manager.verification_inputs import VerificationInputs
from me2e_compress.runtime.frames import Frame

FLOATS = hnp.arrays(
    np.float32,
    hnp.array_shapes(max_side=4),
    elements=st.floats(-1e6, 1e6, width=32, allow_subnormal=False),
)


@given(FLOATS)
def test_nothing_differs_from_itself(a: np.ndarray) -> None:
    assert relative(a, a.copy()) == 0.0


@given(FLOATS, st.floats(0.0009765625, 0.5, width=32))
def test_the_error_is_relative_to_the_largest(a: np.ndarray, share: float) -> None:
    peak = np.unravel_index(np.abs(a).argmax(), a.shape)
    if abs(a[peak]) < 1e-3:
        return
    b = a.astype(np.float64)
    b[peak] *= 1 + share
    assert relative(a.astype(np.float64), b) == pytest.approx(share, rel=1e-9)


@pytest.mark.parametrize(
    ("a", "b"),
    [
        (np.zeros(2, np.float32), np.zeros(3, np.float32)),
        (np.zeros(2, np.float32), np.zeros(2, np.float64)),
        (np.zeros(2, np.float32), np.full(2, 1e-30, np.float32)),
        (np.array([1.0, np.nan], np.float32), np.array([1.0, 2.0], np.float32)),
        (np.array([1.0, np.inf], np.float32), np.array([1.0, -np.inf], np.float32)),
        (np.array([1, 2]), np.array([1, 3])),
        (np.array(["a"]), np.array(["b"])),
    ],
)
def test_what_no_number_can_measure_is_infinite(a: np.ndarray, b: np.ndarray) -> None:
    assert relative(a, b) == float("inf")


def test_a_new_non_number_is_infinite() -> None:
    a, b = np.ones(2, np.float32), np.array([1.0, np.nan], np.float32)
    assert relative(a, b) == float("inf")


def test_empty_outputs_are_equal() -> None:
    assert relative(np.zeros((0, 3)), np.zeros((0, 3))) == 0.0


@pytest.mark.parametrize(
    ("dtype", "rounding", "change"),
    [
        ("float64", 5e-10, 2e-9),
        ("float32", 5e-5, 2e-4),
        ("float16", 5e-3, 2e-2),
        ("bfloat16", 2.5e-2, 1e-1),
    ],
)
def test_what_counts_as_rounding_depends_on_the_type(
    dtype: str, rounding: float, change: float
) -> None:
    def is_rounding(share: float) -> bool:
        kind = np.dtype(getattr(ml_dtypes, dtype, dtype))
        a = np.linspace(-0.5, 1.0, 61)
        left, right = {"y": a.astype(kind)}, {"y": (a * (1 + share)).astype(kind)}
        found = errors([left], [right])
        return passed(Verification(("p",), "recorded", found, tolerances(left)))

    assert is_rounding(rounding)
    assert not is_rounding(change)


@given(FLOATS, st.integers(0, 9))
def test_a_nudge_moves_the_last_places_of_floats_only(a: np.ndarray, seed: int) -> None:
    inputs = VerificationInputs(
        [Frame(0, True, {"x": a, "n": np.arange(3)})], "recorded"
    )
    (frame,) = inputs.nudged(seed).frames
    moved = np.abs(frame.arrays["x"].astype(np.float64) - a)
    assert frame.arrays["x"].dtype == a.dtype
    assert np.all(moved <= 8 * np.abs(np.spacing(a)).astype(np.float64))
    assert np.all(moved > 0)
    assert np.array_equal(frame.arrays["n"], np.arange(3))


def test_outputs_do_not_keep_the_memory_of_their_session(driver: ir.Model) -> None:
    frame = Frame(0, True, {"camera": np.ones((1, 4), np.float32)})

    (outputs,) = VerificationInputs([frame], "recorded").run(driver)

    assert all(value.flags.owndata for value in outputs.values())
