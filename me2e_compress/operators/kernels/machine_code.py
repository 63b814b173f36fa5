"""Store kernels as machine code that needs no Numba to load.

Numba compiles once per machine, 1 to 2 s per kernel; afterwards LLVM alone loads the
code, in a third of the time of importing Numba. A file's name depends on this package's
kernels, the compilers, and the processor.
"""

import functools
import hashlib
import importlib
import platform
import threading
from collections.abc import Callable, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

from llvmlite import binding as llvm

from me2e_compress.base.errors import GraphError
from me2e_compress.operators.kernels.kernel import CompiledKernel
from me2e_compress.operators.kernels.trampoline import keep, private

# C library functions that kernels may call. Code that calls into Python or Numba would
# crash a process into which Numba is not loaded.
_FOREIGN = frozenset({"memset", "memcpy", "memmove", "floorf", "expf", "sqrt"})

# A C function around a Numba function, whose first two arguments are pointers to the
# result and to its exception; `cfunc`'s own wrapper raises in Python
_WRAPPER = """
declare i32 @"{inner}"(ptr, ptr, i64, i64)
define i64 @{name}(i64 %first, i64 %second) {{
    %result = alloca i64
    %raised = alloca ptr
    store i64 0, ptr %result
    call i32 @"{inner}"(ptr %result, ptr %raised, i64 %first, i64 %second)
    %value = load i64, ptr %result
    ret i64 %value
}}
"""

_DIGEST = hashlib.sha256().digest_size
_LOCK = threading.Lock()
# Owners of the code, which may run for as long as the process lives
_ENGINES: list[Any] = []


def load_or_compile(kernel: CompiledKernel, folder: Path) -> Mapping[str, int]:
    """Return the addresses of a kernel's functions by name, cached in ``folder``.

    The ``functions`` of its module take two words and return one. Code that calls into
    Python or Numba is a GraphError.
    """
    with _LOCK:
        place, name = private(folder), kernel.op_type
        path = None if place is None else place / f"{name}-{_fingerprint()}.o"
        # The file begins with the digest of its code
        content = path.read_bytes() if path is not None and path.is_file() else b""
        digest, code = content[:_DIGEST], content[_DIGEST:]
        if not code or hashlib.sha256(code).digest() != digest:
            module = importlib.import_module(f"{__package__}.{kernel.module}")
            code = _compiled(module.functions(name))
            if path is not None:
                keep(path, hashlib.sha256(code).digest() + code)
        # Load it
        engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _machine())
        engine.add_object_file(llvm.ObjectFileRef.from_data(code))
        engine.finalize_object()
        _ENGINES.append(engine)
        return {n: engine.get_function_address(n) for n in ("compute", "block")}


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


def _compiled(functions: Mapping[str, Callable[[int, int], int]]) -> bytes:
    """Compile Python functions to an object file of C functions of the same names."""
    import numba  # takes 0.25 s, and only here

    from me2e_compress.operators.kernels import intrinsics

    word = numba.types.intp
    machine = _machine()
    whole = llvm.parse_assembly("")
    # Link all functions with C wrappers
    for name, function in functions.items():
        made = numba.cfunc(word(word, word), **intrinsics.OPTIONS)(function)
        inner = made.native_name.removeprefix("cfunc.")
        whole.link_in(llvm.parse_assembly(made.inspect_llvm()))
        whole.link_in(llvm.parse_assembly(_WRAPPER.format(inner=inner, name=name)))
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
