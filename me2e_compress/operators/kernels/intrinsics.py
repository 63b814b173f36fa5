"""Numba intrinsics for addresses, calls through them, and memory on the stack."""

from collections.abc import Callable
from typing import Any, TypeAlias, TypeVar, cast

from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

WORD = ir.IntType(64)
FLOAT = ir.FloatType()
INT = ir.IntType(32)
BYTE = ir.IntType(8)
ELEMENTS = {
    types.float32: FLOAT,
    types.int64: WORD,
    types.int32: INT,
    types.int8: BYTE,
    types.uint8: BYTE,
}

OPTIONS: Any = {
    "error_model": "numpy",
    "fastmath": {"contract"},
    "_nrt": False,
    "forceinline": True,
}
"""Options of every compilation: numpy's error model, fused multiply-add, and no
reference counting, since nothing here owns memory."""

Word: TypeAlias = Any
"""An int64 for Numba; untyped for type checkers."""

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """Decorate a function that kernels call."""
    return cast("Function", njit(**OPTIONS)(function))


def _at(kind: Any) -> Any:
    """Return the intrinsic that casts an address to a pointer to numbers of a type."""

    def typed(context: Any, address: Any) -> tuple[Any, Callable[..., Any]]:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return builder.inttoptr(arguments[0], ELEMENTS[kind].as_pointer())

        return types.CPointer(kind)(types.intp), generate

    return intrinsic(typed)


def _address(context: Any, place: Any) -> tuple[Any, Callable[..., Any]]:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.ptrtoint(arguments[0], WORD)

    return types.intp(place), generate


def _call(context: Any, at: Any, a: Any, b: Any, c: Any, d: Any, e: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        function = ir.FunctionType(WORD, [WORD] * 5).as_pointer()
        return builder.call(builder.inttoptr(arguments[0], function), arguments[1:])

    return types.intp(*[types.intp] * 6), generate


words: Any = _at(types.int64)
"""``words(address)[index]``: numbers in memory; nothing is checked."""
ints: Any = _at(types.int32)
floats: Any = _at(types.float32)
signed_bytes: Any = _at(types.int8)
unsigned_bytes: Any = _at(types.uint8)

address_of: Any = intrinsic(_address)
"""``address_of(pointer)``: the inverse."""

call: Any = intrinsic(_call)
"""``call(address, a, b, c, d, e)``: call a C function of up to five words; one that
takes fewer ignores the rest. The result is a word, undefined for ``void``."""


def stack(kind: Any, count: int) -> Any:
    """Return an intrinsic for ``count`` uninitialized numbers on the stack.

    Numba's own ``alloca_once`` fills them with zeros, by one instruction that takes
    LLVM 12 s to compile at 12,000 numbers. Memory is allocated once per function call.
    """

    def typed(context: Any) -> tuple[Any, Callable[..., Any]]:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            with builder.goto_entry_block():
                room = builder.alloca(ir.ArrayType(ELEMENTS[kind], count))
            return builder.bitcast(room, ELEMENTS[kind].as_pointer())

        return types.CPointer(kind)(), generate

    return intrinsic(typed)
