"""The functions that kernels ask for their arrays inside OpenVINO.

They have the form of onnxruntime's (see :data:`abi.CALLED_BY_KERNELS`), so that the
same machine code runs in both. A call's context is its tensors in a row, the output
first: address, element type, rank, dimensions.
"""

from collections.abc import Callable, Mapping

from me2e_compress.operators.kernels.abi import DIMENSIONS, RANK, TENSOR, TYPE_OF
from me2e_compress.operators.kernels.intrinsics import Word, call, ints, words


def _get_input(context: int, index: int, to: int, d: int, e: int) -> Word:
    words(to)[0] = context + 8 * TENSOR * (index + 1)
    return 0


def _get_output(context: int, index: int, dims: int, rank: int, to: int) -> Word:
    """Return the output, whose memory is there already: its shape must be that."""
    tensor = words(context)
    if tensor[RANK] != rank:
        return 1
    for axis in range(rank):
        if tensor[DIMENSIONS + axis] != words(dims)[axis]:
            return 1
    words(to)[0] = context
    return 0


def _word(place: int) -> Callable[..., Word]:
    """Return the function that reads a word of a tensor."""

    def read(tensor: int, to: int, c: int, d: int, e: int) -> Word:
        words(to)[0] = words(tensor)[place]
        return 0

    return read


def _get_info(tensor: int, to: int, c: int, d: int, e: int) -> Word:
    words(to)[0] = tensor
    return 0


def _get_type(tensor: int, to: int, c: int, d: int, e: int) -> Word:
    ints(to)[0] = words(tensor)[TYPE_OF]
    return 0


def _get_dims(tensor: int, to: int, count: int, d: int, e: int) -> Word:
    for axis in range(count):
        words(to)[axis] = words(tensor)[DIMENSIONS + axis]
    return 0


def _create_status(code: int, text: int, c: int, d: int, e: int) -> Word:
    return text


def _nothing(a: int, b: int, c: int, d: int, e: int) -> Word:
    return 0


def _one_by_one(context: int, function: int, total: int, d: int, user: int) -> Word:
    """Run all blocks of a kernel on this thread."""
    for index in range(total):
        call(function, user, index, 0, 0, 0)
    return 0


def functions(op_type: str) -> Mapping[str, Callable[..., Word]]:
    """Return the functions to compile, by their names in :mod:`abi`."""
    return {
        "CREATE_STATUS": _create_status, "GET_INPUT": _get_input,
        "GET_OUTPUT": _get_output, "GET_DATA": _word(0), "GET_INFO": _get_info,
        "GET_TYPE": _get_type, "GET_RANK": _word(RANK), "GET_DIMS": _get_dims,
        "RELEASE_INFO": _nothing, "PARALLEL_FOR": _one_by_one,
    }  # fmt: skip
