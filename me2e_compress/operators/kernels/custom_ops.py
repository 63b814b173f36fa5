"""Compile kernels, and register them as custom operators of onnxruntime sessions.

Numba compiles once per machine, 1 to 2 s per kernel; the code is stored so that LLVM
alone loads it afterwards, in a third of the time of importing Numba. A file's name
depends on this package's kernels, the compilers, and the processor.

Everything passed to onnxruntime here lives as long as the process: a session calls its
operators until it is destroyed, and Python cannot tell when that is. Python is called
only while a session is being opened, never while one runs or ends.
"""

import ctypes
import functools
import hashlib
import importlib
import platform
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import onnxruntime as ort
from llvmlite import binding as llvm

from me2e_compress.base.errors import GraphError
from me2e_compress.operators.kernels import abi
from me2e_compress.operators.kernels.kernel import DOMAIN, KERNELS, CompiledKernel
from me2e_compress.operators.kernels.trampoline import (
    STATE_OFFSET,
    default_folder,
    keep,
    private,
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
    state += [block, *map(ctypes.addressof, texts)]
    for index, word in enumerate(state):
        written[STATE_OFFSET // 8 + index] = word
    _KEPT.extend((name, texts, callbacks, written))
    return written


def _answer(result: Any, function: Callable[..., Any], *arguments: Any) -> Any:
    """Return a callback of an operator, whose first argument is that operator."""
    return ctypes.CFUNCTYPE(result, _POINTER, *arguments)(function)


def _address(callback: Any) -> int:
    address = ctypes.cast(callback, _POINTER).value
    assert address is not None
    return address


# C library functions that kernels may call. Code that calls into Python or Numba would
# crash a process into which Numba is not loaded.
_FOREIGN = frozenset({"memset", "memcpy", "memmove", "floorf", "expf", "sqrt"})

# A C function of words around a Numba function, whose first two arguments are pointers
# to the result and to its exception; `cfunc`'s own wrapper raises in Python
_WRAPPER = """
declare i32 @"{inner}"(ptr, ptr, {types})
define i64 @{name}({arguments}) {{
    %result = alloca i64
    %raised = alloca ptr
    store i64 0, ptr %result
    call i32 @"{inner}"(ptr %result, ptr %raised, {arguments})
    %value = load i64, ptr %result
    ret i64 %value
}}
"""

_DIGEST = hashlib.sha256().digest_size
_LOCK = threading.Lock()
# Owners of the code, which may run for as long as the process lives
_ENGINES: list[Any] = []


def load_or_compile(
    kernel: CompiledKernel, folder: Path, names: Sequence[str] = ("compute", "block")
) -> Mapping[str, int]:
    """Return the addresses of a kernel's functions by name, cached in ``folder``.

    The ``functions`` of its module take words and return one. Code that calls into
    Python or Numba is a GraphError.
    """
    with _LOCK:
        place, op_type = private(folder), kernel.op_type
        path = None if place is None else place / f"{op_type}-{_fingerprint()}.o"
        # The file begins with the digest of its code
        content = path.read_bytes() if path is not None and path.is_file() else b""
        digest, code = content[:_DIGEST], content[_DIGEST:]
        if not code or hashlib.sha256(code).digest() != digest:
            module = importlib.import_module(f"{__package__}.{kernel.module}")
            code = _compiled(module.functions(op_type))
            if path is not None:
                keep(path, hashlib.sha256(code).digest() + code)
        # Load it
        engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _machine())
        engine.add_object_file(llvm.ObjectFileRef.from_data(code))
        engine.finalize_object()
        _ENGINES.append(engine)
        return {name: engine.get_function_address(name) for name in names}


@functools.cache
def _fingerprint() -> str:
    """Return a digest of everything that machine code depends on."""
    known = hashlib.sha256()
    for file in sorted(Path(__file__).parent.glob("*.py")):
        known.update(file.read_bytes())
    versions = (metadata.version(package) for package in ("numba", "llvmlite"))
    cpu = (llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten())
    known.update("\n".join((*versions, *cpu, platform.machine())).encode())
    return known.hexdigest()[:32]


def _machine() -> Any:
    """Return LLVM's machine of this processor, with all that it can do."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    target = llvm.Target.from_default_triple()
    features = llvm.get_host_cpu_features().flatten()
    return target.create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=features, opt=3, jit=True
    )


def _compiled(functions: Mapping[str, Callable[..., int]]) -> bytes:
    """Compile Python functions to an object file of C functions of the same names."""
    import numba  # takes 0.25 s, and only here

    from me2e_compress.operators.kernels import intrinsics

    word = numba.types.intp
    machine = _machine()
    whole = llvm.parse_assembly("")
    # Link all functions with C wrappers
    for name, function in functions.items():
        count = function.__code__.co_argcount
        made = numba.cfunc(word(*[word] * count), **intrinsics.OPTIONS)(function)
        wrapper = _WRAPPER.format(
            inner=made.native_name.removeprefix("cfunc."),
            name=name,
            types=", ".join(["i64"] * count),
            arguments=", ".join(f"i64 %word{index}" for index in range(count)),
        )
        whole.link_in(llvm.parse_assembly(made.inspect_llvm()))
        whole.link_in(llvm.parse_assembly(wrapper))
    # Only the wrappers stay visible; remove the rest if unused
    for symbol in (*whole.functions, *whole.global_variables):
        if not symbol.is_declaration and symbol.name not in functions:
            symbol.linkage = "internal"
    passes = llvm.create_new_module_pass_manager()
    passes.add_global_dead_code_eliminate_pass()
    options = llvm.create_pipeline_tuning_options()
    passes.run(whole, llvm.create_pass_builder(machine, options))
    # Refuse calls that need Numba at run time
    declared = {f.name for f in whole.functions if f.is_declaration}
    foreign = {name for name in declared if not name.startswith("llvm.")}
    if unknown := sorted(foreign - _FOREIGN):
        raise GraphError(f"a kernel calls {unknown[0]}, which only Numba has")
    return bytes(machine.emit_object(whole))
