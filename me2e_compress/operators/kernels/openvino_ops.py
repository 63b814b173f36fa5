"""Compiled kernels as operators of OpenVINO (2026.4).

OpenVINO calls :meth:`_KernelOp.evaluate` in Python, which calls the same machine code
as onnxruntime does. The blocks of a kernel run on threads of its own, as many as the
session has: OpenVINO's pool cannot be used from there, and is idle meanwhile.
"""

import ctypes
import functools
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import count
from typing import Any

import numpy as np
import openvino as ov
from openvino.frontend.onnx import ConversionExtension

from me2e_compress.operators.kernels import abi
from me2e_compress.operators.kernels.custom_ops import load_or_compile
from me2e_compress.operators.kernels.kernel import DOMAIN, KERNELS, CompiledKernel
from me2e_compress.operators.kernels.trampoline import default_folder

SHAPE = "output_shape"
"""Attribute of a node of :data:`DOMAIN`: the shape of its output."""

_CONTEXT = CompiledKernel("OpenVinoContext", "openvino_context", (), ())
_FUNCTION = ctypes.CFUNCTYPE(ctypes.c_int64, *[ctypes.c_int64] * 2)
_PARALLEL_FOR = ctypes.CFUNCTYPE(ctypes.c_int64, *[ctypes.c_int64] * 5)
_TYPES = {
    np.dtype(np.float32): abi.FLOAT, np.dtype(np.uint8): abi.UINT8,
    np.dtype(np.int8): abi.INT8, np.dtype(np.int32): abi.INT32,
    np.dtype(np.int64): abi.INT64,
}  # fmt: skip


def extensions(threads: int) -> list[ConversionExtension]:
    """Return what makes OpenVINO's operators of nodes of :data:`DOMAIN`.

    Add them before a graph is read. Kernels are compiled where this machine has not
    cached them; without Numba it is an ImportError.
    """
    return [
        ConversionExtension(kernel.op_type, DOMAIN, _converter(kernel, threads))
        for kernel in KERNELS
    ]


def _converter(kernel: CompiledKernel, threads: int) -> Any:
    """Return the function that converts a node of a kernel."""

    def convert(node: Any) -> Any:
        inputs = [node.get_input(index) for index in range(node.get_input_size())]
        shape = [int(size) for size in node.get_attribute(SHAPE)]
        operator = _operator_of(kernel, threads)
        return [operator(inputs, shape).output(0)]

    return convert


@functools.cache
def _operator_of(kernel: CompiledKernel, threads: int) -> Any:
    """Return the class of OpenVINO's operators that call a kernel."""
    compute = _compute_of(kernel, threads)

    def call_kernel(self: Any, outputs: Any, inputs: Any) -> bool:
        compute(outputs[0].data, [tensor.data for tensor in inputs])
        return True

    class _KernelOp(ov.Op):  # type: ignore[misc]
        """Calls the kernel for every inference."""

        def __init__(self, inputs: Any = None, shape: Sequence[int] = ()) -> None:
            super().__init__(self)
            self._shape = list(shape)
            if inputs is not None:
                self.set_arguments(inputs)
                self.constructor_validate_and_infer_types()

        def validate_and_infer_types(self) -> None:
            self.set_output_type(0, ov.Type.f32, ov.PartialShape(self._shape))

        def clone_with_new_inputs(self, inputs: Any) -> Any:
            return _KernelOp(inputs, self._shape)

        def has_evaluate(self) -> bool:
            return True

        evaluate: Any = call_kernel  # of three signatures, one is overridden

    _KernelOp.__name__ = kernel.op_type
    return _KernelOp


def _compute_of(kernel: CompiledKernel, threads: int) -> Any:
    """Return the function that runs a kernel on arrays, its output the first."""
    code = load_or_compile(kernel, default_folder())
    names = abi.HOST_FUNCTIONS
    functions = dict(load_or_compile(_CONTEXT, default_folder(), names))
    if threads > 1:
        callback = ctypes.cast(_parallel_for(threads), ctypes.c_void_p)
        functions["PARALLEL_FOR"] = callback.value or 0
    messages = [ctypes.create_string_buffer(each.encode()) for each in kernel.messages]
    texts = [ctypes.addressof(message) for message in messages]
    addresses = [functions[name] for name in names]
    words = (*addresses, code["block"], *texts)
    state = (ctypes.c_int64 * abi.STATE_WORDS)(*words)
    run = _FUNCTION(code["compute"])

    def compute(output: Any, inputs: Sequence[Any]) -> None:
        context = (ctypes.c_int64 * (abi.TENSOR * (1 + len(inputs))))()
        for place, array in zip(count(0, abi.TENSOR), (output, *inputs), strict=False):
            dims = array.shape
            kind = _TYPES.get(array.dtype, abi.ANY)
            tensor = [array.ctypes.data, kind, len(dims), *dims]
            context[place : place + len(tensor)] = tensor
        status = run(ctypes.addressof(state), ctypes.addressof(context))
        if status:
            known = dict(zip(texts, kernel.messages, strict=True))
            reason = known.get(status, "its output does not fit")
            raise RuntimeError(f"kernel: {kernel.op_type}: {reason}")

    return compute


BLOCKS_PER_THREAD = 8
"""Parts of a kernel's blocks that a thread takes: enough to even out their times."""


@functools.cache
def _parallel_for(threads: int) -> Any:
    """Return a callback that runs the blocks of a kernel on a pool of threads."""
    pool = ThreadPoolExecutor(threads - 1, "me2e-kernels")

    def run_blocks(_c: int, function: int, total: int, _b: int, user: int) -> int:
        block, step = (
            _FUNCTION(function),
            max(1, total // (threads * BLOCKS_PER_THREAD)),
        )
        starts = iter(range(0, total, step))

        def work() -> None:
            for start in starts:  # one step of an iterator is atomic
                for index in range(start, min(start + step, total)):
                    block(user, index)

        others = [pool.submit(work) for _ in range(threads - 1)]
        work()
        for other in others:
            other.result()
        return 0

    return _PARALLEL_FOR(run_blocks)
