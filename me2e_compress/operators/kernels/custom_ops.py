"""Register compiled kernels as custom operators of an onnxruntime session.

Everything given to onnxruntime here lives as long as the process: a session calls its
operators until it is destroyed, and Python cannot tell when that is. Python is called
only while a session is being opened, never while one runs or ends.
"""

import ctypes
import functools
import threading
from collections.abc import Callable, Iterable
from typing import Any

import onnxruntime as ort

from me2e_compress.operators.kernels import abi
from me2e_compress.operators.kernels.kernel import DOMAIN, KERNELS, CompiledKernel
from me2e_compress.operators.kernels.machine_code import load_or_compile
from me2e_compress.operators.kernels.trampoline import (
    STATE_OFFSET,
    default_folder,
    trampoline,
)

_POINTER = ctypes.c_void_p
_INT, _SIZE = ctypes.c_int, ctypes.c_size_t

# What this thread is registering; onnxruntime calls back within that same call
_asked = threading.local()


def register(options: ort.SessionOptions, kernels: Iterable[CompiledKernel]) -> None:
    """Let sessions with these options run kernels; call it once per options object.

    A kernel is compiled if this machine has not cached it.

    Raises:
        OSError: no shared object can be opened; see :mod:`trampoline`.
        ImportError: Numba is not installed, or does not work here.
    """
    library = trampoline()
    _asked.code = {
        kernel: load_or_compile(kernel, default_folder()) for kernel in kernels
    }
    library.fill(_address(_register))
    options.register_custom_ops_library(library.path)


def register_named(options: ort.SessionOptions, names: Iterable[str]) -> None:
    """Call :func:`register` for kernels given by name."""
    known = {kernel.op_type: kernel for kernel in KERNELS}
    register(options, [known[name] for name in names])


def _add(options: int, base: int) -> None:
    """Add the requested operators; onnxruntime calls this through the trampoline."""
    # Create the domain
    api = _api(base)
    domain = _POINTER()
    name = ctypes.create_string_buffer(DOMAIN.encode())
    create = ctypes.CFUNCTYPE(_POINTER, _POINTER, _POINTER)(api[abi.CREATE_DOMAIN])
    add = ctypes.CFUNCTYPE(_POINTER, _POINTER, _POINTER)
    create(ctypes.addressof(name), ctypes.addressof(domain))
    # Add the operators to it, then the domain to the options
    for kernel, code in _asked.code.items():
        operator = _operator(kernel, code["compute"], code["block"], base)
        add(api[abi.ADD_OP])(domain, ctypes.addressof(operator))
    add(api[abi.ADD_DOMAIN])(options, domain)


_register = ctypes.CFUNCTYPE(_POINTER, _POINTER, _POINTER)(_add)


def _api(base: int) -> Any:
    """Return the table of `OrtApi`: addresses of its functions, by offset."""
    get = ctypes.cast(base, ctypes.POINTER(_POINTER))[0]
    table = ctypes.CFUNCTYPE(_POINTER, ctypes.c_uint32)(get)(abi.API_VERSION)
    return ctypes.cast(table, ctypes.POINTER(_POINTER))


_KEPT: list[object] = []  # what onnxruntime has addresses of


@functools.cache
def _operator(kernel: CompiledKernel, compute: int, block: int, base: int) -> Any:
    """Write an ``OrtCustomOp``, followed by the state of its kernels."""
    name = ctypes.create_string_buffer(kernel.op_type.encode())
    texts = [
        ctypes.create_string_buffer(f"{kernel.op_type}: {message}".encode())
        for message in kernel.messages
    ]
    # Callbacks that describe the operator, called only on opening
    callbacks = {
        "GetName": _answer(_POINTER, lambda _: ctypes.addressof(name)),
        "GetExecutionProviderType": _answer(_POINTER, lambda _: None),
        "GetInputType": _answer(_INT, lambda _, index: kernel.inputs[index], _SIZE),
        "GetInputTypeCount": _answer(_SIZE, lambda _: len(kernel.inputs)),
        "GetOutputType": _answer(_INT, lambda _, index: kernel.output, _SIZE),
        "GetOutputTypeCount": _answer(_SIZE, lambda _: 1),
        # Inputs are required
        **{name: _answer(_INT, lambda *_: 0, _SIZE) for name in abi.CHARACTERISTICS},
        **{name: _answer(_INT, lambda _: 1) for name in abi.VARIADIC},
    }
    # Fill in the struct
    written = (_POINTER * (STATE_OFFSET // 8 + abi.STATE_WORDS))()
    written[0] = abi.OP_VERSION
    for field, callback in callbacks.items():
        written[abi.FIELDS.index(field)] = _address(callback)
    for field in ("CreateKernel", "KernelDestroy"):
        written[abi.FIELDS.index(field)] = trampoline().address(field)
    written[abi.FIELDS.index("KernelComputeV2")] = compute
    # The state of its kernels follows the struct
    api = _api(base)
    state = [api[place] for place in abi.CALLED_BY_KERNELS]
    state += [block, _memory(base), *map(ctypes.addressof, texts)]
    for index, word in enumerate(state):
        written[STATE_OFFSET // 8 + index] = word
    _KEPT.extend((name, texts, callbacks, written))
    return written


@functools.cache
def _memory(base: int) -> int:
    """Return onnxruntime's description of the CPU's memory."""
    create = ctypes.CFUNCTYPE(_POINTER, _INT, _INT, _POINTER)
    made = _POINTER()
    create(_api(base)[abi.CREATE_MEMORY])(
        abi.ARENA, abi.DEFAULT, ctypes.addressof(made)
    )
    assert made.value is not None
    return made.value


def _answer(result: Any, function: Callable[..., Any], *arguments: Any) -> Any:
    """Return a callback of an operator, whose first argument is that operator."""
    return ctypes.CFUNCTYPE(result, _POINTER, *arguments)(function)


def _address(callback: Any) -> int:
    address = ctypes.cast(callback, _POINTER).value
    assert address is not None
    return address
