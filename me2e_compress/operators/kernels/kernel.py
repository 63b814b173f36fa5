"""The list of compiled kernels."""

import dataclasses

from me2e_compress.operators.kernels.abi import ANY, FLOAT, INT8, UINT8


@dataclasses.dataclass(frozen=True)
class CompiledKernel:
    """A compiled operator of :data:`DOMAIN`: its code's module, and its element types.

    ``messages`` are the errors for inputs that do not fit.
    """

    op_type: str
    module: str
    inputs: tuple[int, ...]
    messages: tuple[str, ...]
    output: int = FLOAT


# The domain to which nodes move when a graph is opened. No file has nodes in it, so no
# function body and no other library can claim them.
DOMAIN = "me2e.kernels"

_DEFORMABLE = (
    "the inputs have not the ranks that they must: value 4, spatial_shapes 2,"
    " level_start_index 1, sampling_locations 6, attention_weights 5",
    "the inputs do not fit each other: they must be value [N,S,M,D], spatial_shapes"
    " [L,2], level_start_index [L], sampling_locations [N,Q,M,L,P,2] (or M"
    " 1) and attention_weights [N,Q,M,L,P]",
    "spatial_shapes and level_start_index must be int32 or int64",
    "a level lies outside of value: level_start_index + height x width is more than"
    " value has rows, or a number is negative",
    "value has 2^31 or more numbers for one of the batch",
    "a head has more than 1024 points",
    "the scale of value must be one number, or one for every channel, its zero point"
    " one number",
)
_RAW = (
    "the inputs have not the ranks that they must: value 4, spatial_shapes 2,"
    " level_start_index 1, reference_points and sampling_offsets 6, attention_scores"
    " and mask 5",
    "the inputs do not fit each other: they must be value [N,S,M,D], spatial_shapes"
    " [L,2], level_start_index [L], reference_points [n,q,m,l,p,2], sampling_offsets"
    " [N,Q,M,l,P,2], attention_scores [n,q,m,r,c] and mask [n,q,m,l,p], where n, q and"
    " m are 1 or N, Q and M, l and p divide L and P, and r*c divides L*P",
    *_DEFORMABLE[2:],
)

BINS = 2048
"""Bins of a histogram of magnitudes, from 0 to the next power of two: at least 1,024 of
them in use, 8 for each of the 127 int8 steps. (TensorRT divides the range up to the
largest magnitude into 2,048, onnxruntime's percentile each side of zero.)"""
LEAST_EXPONENT = -100
"""Of that power: below, float32 cannot hold bins per unit."""

ATTENTION = "MultiHeadAttention"
WIDEST_HEAD = 256  # channels of a head at most, for attention

_ATTENTION = (
    "the inputs must be of rank 4",
    "the inputs do not fit each other: they must be query [N,Q,M,D], key and value"
    " [N,K,M,D], with one key at least",
    f"a head has more than {WIDEST_HEAD} channels",
)


def _deformable(
    name: str, module: str, others: int, messages: tuple[str, ...]
) -> tuple[CompiledKernel, ...]:
    """List the kernels for float, int8 and uint8 values, which come with a scale."""
    rest = (ANY, ANY, *[FLOAT] * others)
    return (
        CompiledKernel(name, module, (FLOAT, *rest), messages),
        *(
            CompiledKernel(name + word, module, (kind, *rest, FLOAT, kind), messages)
            for word, kind in (("Int8", INT8), ("Uint8", UINT8))
        ),
    )


# All compiled kernels
KERNELS = (
    *_deformable("MultiScaleDeformableAttention", "deformable_kernel", 2, _DEFORMABLE),
    *_deformable("RawDeformableAttention", "raw_attention_kernel", 4, _RAW),
    CompiledKernel(ATTENTION, "attention_kernel", (FLOAT, FLOAT, FLOAT), _ATTENTION),
    CompiledKernel(
        "Histogram",
        "histogram_kernel",
        (FLOAT, FLOAT, FLOAT),
        ("the inputs must be of rank 1, 0 and 0",),
    ),
)
