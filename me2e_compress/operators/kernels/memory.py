"""Memory of the session's arena, for as long as one call of a kernel.

``KernelContext_GetScratchBuffer`` is no such thing: on the CPU, nothing ever frees it.
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
