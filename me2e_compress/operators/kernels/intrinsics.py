"""Functions that kernels call: addresses, C functions, memory, inputs and outputs.

Memory is that of the stack. Nothing ever frees that of
``KernelContext_GetScratchBuffer`` on the CPU.
"""

from collections.abc import Callable
from typing import Any, TypeAlias, TypeVar, cast

from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

from me2e_compress.operators.kernels import abi

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

# Options of every compilation: numpy's error model, fused multiply-add, and no
# reference counting, since nothing here owns memory
OPTIONS: Any = {
    "error_model": "numpy",
    "fastmath": {"contract"},
    "_nrt": False,
    "forceinline": True,
}

Word: TypeAlias = Any  # an int64 for Numba; untyped for type checkers

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


# `words(address)[index]`: numbers in memory; nothing is checked
words: Any = _at(types.int64)
ints: Any = _at(types.int32)
floats: Any = _at(types.float32)
signed_bytes: Any = _at(types.int8)
unsigned_bytes: Any = _at(types.uint8)

address_of: Any = intrinsic(_address)  # `address_of(pointer)`: the inverse

# `call(address, a, b, c, d, e)`: call a C function of up to five words; one that takes
# fewer ignores the rest. The result is a word, undefined for `void`.
call: Any = intrinsic(_call)


def stack(kind: Any, count: int) -> Any:
    """Return an intrinsic for ``count`` uninitialized numbers on the stack."""
    # Numba's own `alloca_once` fills them with zeros, by one instruction that takes
    # LLVM 12 s to compile at 12,000 numbers. Memory is allocated once per function
    # call.

    def typed(context: Any) -> tuple[Any, Callable[..., Any]]:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            with builder.goto_entry_block():
                room = builder.alloca(ir.ArrayType(ELEMENTS[kind], count))
            return builder.bitcast(room, ELEMENTS[kind].as_pointer())

        return types.CPointer(kind)(), generate

    return intrinsic(typed)


_slot = stack(types.int64, 1)


@compiled
def error_status(t: Any, message: int) -> Word:
    """Return the error status with a message of the kernel, by index."""
    create, text = t[abi.CREATE_STATUS], t[abi.MESSAGES + message]
    return call(create, abi.INVALID_ARGUMENT, text, 0, 0, 0)


@compiled
def read_input(t: Any, context: int, index: int, to: int) -> Word:
    """Read an input into ten words (dimensions, address, type) and return its rank."""
    slot = _slot()
    at = address_of(slot)
    call(t[abi.GET_INPUT], context, index, at, 0, 0)
    tensor = slot[0]
    call(t[abi.GET_DATA], tensor, to + abi.ADDRESS * 8, 0, 0, 0)
    call(t[abi.GET_INFO], tensor, at, 0, 0, 0)
    info = slot[0]
    call(t[abi.GET_TYPE], info, to + abi.TYPE * 8, 0, 0, 0)
    call(t[abi.GET_RANK], info, at, 0, 0, 0)
    rank = slot[0]
    if rank <= abi.ADDRESS:  # more than eight dimensions are not read
        call(t[abi.GET_DIMS], info, to, rank, 0, 0)
    call(t[abi.RELEASE_INFO], info, 0, 0, 0, 0)
    return rank


@compiled
def create_output(t: Any, context: int, dims: Any, rank: int, to: int) -> Word:
    """Create the output, write its address to ``to`` and return the status."""
    slot = _slot()
    at = address_of(slot)
    status = call(t[abi.GET_OUTPUT], context, 0, address_of(dims), rank, at)
    if status == 0:
        call(t[abi.GET_DATA], slot[0], to, 0, 0, 0)
    return status
