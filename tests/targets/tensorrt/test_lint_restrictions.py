"""What TensorRT's parser asks of the attributes and inputs of an operator."""

import onnx_ir as ir
import pytest

from me2e_compress.targets import TARGETS

HEAD = '<ir_version: 9, opset_import: ["" : 19]>'
SAMPLED = "m (float[1,1,2,2] x, float[4] s) => (float[1,1,A,B] y)"
AVERAGED = "m (float[1,1,9,9] x) => (float[1,1,A,B] y)"
TAKEN = "m (float[9] x, int64[1] k) => (float[A] y, int64[A] i) <int64[1] most = {9}>"
DEFORMED = (
    "m (float[1,1,4,4] x, float[1,1,1,1] w, float[1,2,6,6] o) => (float[1,1,A,B] y)"
)
RECURRENT = "m (float[2,1,4] x, float[1,12,4] w, float[1,12,3] r) => (float[2,1,1,3] y)"
NORMALIZED = "m (float[2,4] x, float[4] g) => (float[2,4] y, float[2,1] mean)"
REDUCED = "m (float[2,4] x, int64[1] a) => (float[2,1] y) <int64[1] one = {1}>"

CALLS = [
    (SAMPLED, "y = Resize(x, , s)", None),
    (SAMPLED, 'y = Resize<mode="linear">(x, , s)', None),
    (SAMPLED, "y = Resize<antialias=0>(x, , s)", None),
    (SAMPLED, "y = Resize<antialias=1>(x, , s)", "antialias must be 0"),
    (
        SAMPLED,
        'y = Resize<coordinate_transformation_mode="align_corners">(x, , s)',
        None,
    ),
    (
        SAMPLED,
        'y = Resize<coordinate_transformation_mode="half_pixel_symmetric">(x, , s)',
        "coordinates half_pixel_symmetric, must be of half_pixel, pytorch_half_pixel,"
        " tf_half_pixel_for_nn, asymmetric, align_corners",
    ),
    (
        SAMPLED,
        'y = Resize<keep_aspect_ratio_policy="not_larger">(x, , s)',
        "aspect ratio policy not_larger, must be stretch",
    ),
    (AVERAGED, "y = AveragePool<kernel_shape=[2,2], dilations=[1,1]>(x)", None),
    (
        AVERAGED,
        "y = AveragePool<kernel_shape=[2,2], dilations=[1,2]>(x)",
        "dilations [1, 2], must be 1",
    ),
    (TAKEN, "y, i = TopK(x, most)", None),
    (TAKEN, "y, i = TopK(x, k)", None),
    (TAKEN, "y, i = TopK<sorted=0>(x, most)", "sorted must be 1"),
    (DEFORMED, "y = DeformConv<pads=[1,1,1,1]>(x, w, o)", None),
    (DEFORMED, "y = DeformConv<pads=[1,2,1,2]>(x, w, o)", None),
    (
        DEFORMED,
        "y = DeformConv<pads=[0,1,2,1]>(x, w, o)",
        "pads [0, 1, 2, 1] differ between begin and end",
    ),
    (RECURRENT, "y = LSTM<hidden_size=3>(x, w, r)", None),
    (RECURRENT, "y = LSTM<hidden_size=3, layout=1>(x, w, r)", "layout must be 0"),
    (NORMALIZED, "y = LayerNormalization(x, g) mean = ReduceMean(x)", None),
    (
        NORMALIZED,
        "y, mean = LayerNormalization(x, g)",
        "only the first output is supported",
    ),
    (REDUCED, "y = ReduceMean(x, one)", None),
    (REDUCED, "y = ReduceMean(x, a)", "axes is computed, must be a constant"),
]


@pytest.mark.parametrize(("signature", "call", "message"), CALLS)
def test_a_call_as_the_parser_wants_it_or_not(
    signature: str, call: str, message: str | None
) -> None:
    model = ir.from_onnx_text(f"{HEAD} {signature} {{ {call} }}")

    said = [
        each.message
        for each in TARGETS.parse("tensorrt").lint(model)
        if each.rule == "restriction"
    ]

    operator = call.split("= ")[1].partition("(")[0].partition("<")[0]
    assert said == ([] if message is None else [f"{operator}: {message}"])
