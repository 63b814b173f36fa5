"""Constants shared by Python, compiled kernels and onnxruntime's C interface.

Offsets in ``OrtApi`` and ``OrtCustomOp`` are those of ``onnxruntime_c_api.h``, where
entries are only ever added at the end.

What a kernel asks of its call: its inputs, its output, and memory.

Memory is of the session's arena. ``KernelContext_GetScratchBuffer`` is no such thing:
on the CPU, nothing ever frees it.
"""

from typing import Any

from numba import types

from me2e_compress.operators.kernels.intrinsics import (
    Word,
    address_of,
    call,
    compiled,
    stack,
)

API_VERSION = 17
"""The first with ``KernelContext_ParallelFor``: onnxruntime 1.17."""

OP_VERSION = 16
"""The first with ``KernelComputeV2``, which returns a status."""

CREATE_DOMAIN, ADD_OP, ADD_DOMAIN, CREATE_MEMORY = 26, 27, 28, 69

CALLED_BY_KERNELS = (
    0,  # CreateStatus
    90,  # KernelContext_GetInput
    91,  # KernelContext_GetOutput
    51,  # GetTensorMutableData
    65,  # GetTensorTypeAndShape
    60,  # GetTensorElementType
    61,  # GetDimensionsCount
    62,  # GetDimensions
    99,  # ReleaseTensorTypeAndShapeInfo
    274,  # KernelContext_ParallelFor
    253,  # KernelContext_GetAllocator
    75,  # AllocatorAlloc
    76,  # AllocatorFree
    132,  # ReleaseAllocator
)
(
    CREATE_STATUS,
    GET_INPUT,
    GET_OUTPUT,
    GET_DATA,
    GET_INFO,
    GET_TYPE,
    GET_RANK,
    GET_DIMS,
    RELEASE_INFO,
    PARALLEL_FOR,
    GET_ALLOCATOR,
    ALLOCATE,
    FREE,
    RELEASE_ALLOCATOR,
) = range(len(CALLED_BY_KERNELS))
"""Words of a kernel's state: the addresses of those functions, then"""
BLOCK = len(CALLED_BY_KERNELS)
"""the address of the kernel's own ``block``, which ``ParallelFor`` calls, then"""
MEMORY = BLOCK + 1
"""what describes the memory of the CPU, then"""
MESSAGES = MEMORY + 1
"""the addresses of its error messages."""
STATE_WORDS = MESSAGES + 16

ARENA, DEFAULT = 1, 0
"""``OrtArenaAllocator`` and ``OrtMemTypeDefault``."""

INVALID_ARGUMENT = 2
"""``ORT_INVALID_ARGUMENT``."""

FLOAT, UINT8, INT8, INT32, INT64, ANY = 1, 2, 3, 6, 7, 0
"""``ONNXTensorElementDataType``; ``ANY`` leaves the check to the kernel."""

VARIADIC = (
    "GetVariadicInputMinArity",
    "GetVariadicInputHomogeneity",
    "GetVariadicOutputMinArity",
    "GetVariadicOutputHomogeneity",
)
FIELDS = (
    "version",
    "CreateKernel",
    "GetName",
    "GetExecutionProviderType",
    "GetInputType",
    "GetInputTypeCount",
    "GetOutputType",
    "GetOutputTypeCount",
    "KernelCompute",
    "KernelDestroy",
    "GetInputCharacteristic",
    "GetOutputCharacteristic",
    "GetInputMemoryType",
    *VARIADIC,
    "CreateKernelV2",
    "KernelComputeV2",
)
"""Fields of ``OrtCustomOp``, one word each; the fields after them are newer."""


ADDRESS, TYPE, EACH = 8, 9, 10
"""Ten words an input: eight dimensions, address and element type."""

_slot = stack(types.int64, 1)


@compiled
def refused(t: Any, message: int) -> Word:
    """Return the status with a kernel's message, by index."""
    create, said = t[CREATE_STATUS], t[MESSAGES + message]
    return call(create, INVALID_ARGUMENT, said, 0, 0, 0)


@compiled
def read(t: Any, context: int, index: int, to: int) -> Word:
    """Read an input into ten words (dimensions, address, type) and return its rank.

    More than eight dimensions are not read.
    """
    slot = _slot()
    at = address_of(slot)
    call(t[GET_INPUT], context, index, at, 0, 0)
    tensor = slot[0]
    call(t[GET_DATA], tensor, to + ADDRESS * 8, 0, 0, 0)
    call(t[GET_INFO], tensor, at, 0, 0, 0)
    info = slot[0]
    call(t[GET_TYPE], info, to + TYPE * 8, 0, 0, 0)
    call(t[GET_RANK], info, at, 0, 0, 0)
    rank = slot[0]
    if rank <= ADDRESS:
        call(t[GET_DIMS], info, to, rank, 0, 0)
    call(t[RELEASE_INFO], info, 0, 0, 0, 0)
    return rank


@compiled
def made(t: Any, context: int, dims: Any, rank: int, to: int) -> Word:
    """Create the output, write its address to ``to`` and return the status."""
    slot = _slot()
    at = address_of(slot)
    status = call(t[GET_OUTPUT], context, 0, address_of(dims), rank, at)
    if status == 0:
        call(t[GET_DATA], slot[0], to, 0, 0, 0)
    return status


LINE = 64
"""Bytes of a cache line, on which memory begins."""

_slots = stack(types.int64, 2)


@compiled
def borrow(t: Any, context: int, size: int, to: Any) -> Word:
    """Take memory and return the status; it begins at ``to[0]``.

    ``to`` are three words, which :func:`give_back` needs.
    """
    slots = _slots()
    at = address_of(slots)
    status = call(t[GET_ALLOCATOR], context, t[MEMORY], at, 0, 0)
    if status != 0:
        return status
    status = call(t[ALLOCATE], slots[0], size + LINE, at + 8, 0, 0)
    if status != 0:
        call(t[RELEASE_ALLOCATOR], slots[0], 0, 0, 0, 0)
        return status
    to[0] = (slots[1] + LINE - 1) // LINE * LINE
    to[1], to[2] = slots[0], slots[1]
    return 0


@compiled
def give_back(t: Any, held: Any) -> None:
    """Return what :func:`borrow` took."""
    call(t[FREE], held[1], held[2], 0, 0, 0)
    call(t[RELEASE_ALLOCATOR], held[1], 0, 0, 0, 0)
