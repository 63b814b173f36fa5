"""What a kernel asks of its call: its inputs, its output, and memory.

Memory is of the session's arena. ``KernelContext_GetScratchBuffer`` is no such thing:
on the CPU, nothing ever frees it.
"""

from typing import Any

from numba import types

from me2e_compress.operators.kernels import abi
from me2e_compress.operators.kernels.intrinsics import (
    Word,
    address_of,
    call,
    compiled,
    stack,
)

ADDRESS, TYPE, EACH = 8, 9, 10
"""Ten words an input: eight dimensions, address and element type."""

_slot = stack(types.int64, 1)


@compiled
def refused(t: Any, message: int) -> Word:
    """Return the status with a kernel's message, by index."""
    create, said = t[abi.CREATE_STATUS], t[abi.MESSAGES + message]
    return call(create, abi.INVALID_ARGUMENT, said, 0, 0, 0)


@compiled
def read(t: Any, context: int, index: int, to: int) -> Word:
    """Read an input into ten words (dimensions, address, type) and return its rank.

    More than eight dimensions are not read.
    """
    slot = _slot()
    at = address_of(slot)
    call(t[abi.GET_INPUT], context, index, at, 0, 0)
    tensor = slot[0]
    call(t[abi.GET_DATA], tensor, to + ADDRESS * 8, 0, 0, 0)
    call(t[abi.GET_INFO], tensor, at, 0, 0, 0)
    info = slot[0]
    call(t[abi.GET_TYPE], info, to + TYPE * 8, 0, 0, 0)
    call(t[abi.GET_RANK], info, at, 0, 0, 0)
    rank = slot[0]
    if rank <= ADDRESS:
        call(t[abi.GET_DIMS], info, to, rank, 0, 0)
    call(t[abi.RELEASE_INFO], info, 0, 0, 0, 0)
    return rank


@compiled
def made(t: Any, context: int, dims: Any, rank: int, to: int) -> Word:
    """Create the output, write its address to ``to`` and return the status."""
    slot = _slot()
    at = address_of(slot)
    status = call(t[abi.GET_OUTPUT], context, 0, address_of(dims), rank, at)
    if status == 0:
        call(t[abi.GET_DATA], slot[0], to, 0, 0, 0)
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
    status = call(t[abi.GET_ALLOCATOR], context, t[abi.MEMORY], at, 0, 0)
    if status != 0:
        return status
    status = call(t[abi.ALLOCATE], slots[0], size + LINE, at + 8, 0, 0)
    if status != 0:
        call(t[abi.RELEASE_ALLOCATOR], slots[0], 0, 0, 0, 0)
        return status
    to[0] = (slots[1] + LINE - 1) // LINE * LINE
    to[1], to[2] = slots[0], slots[1]
    return 0


@compiled
def give_back(t: Any, held: Any) -> None:
    """Return what :func:`borrow` took."""
    call(t[abi.FREE], held[1], held[2], 0, 0, 0)
    call(t[abi.RELEASE_ALLOCATOR], held[1], 0, 0, 0, 0)
