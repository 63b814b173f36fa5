"""Sessions that run one graph, its weights lent to onnxruntime, not serialized.

onnxruntime gets the graph without its large weights, as if they were in an external
file, and the arrays in place of that file. So their total size does not matter,
although a protobuf message ends at 2 GiB.
"""

import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TypeAlias, cast

import numpy as np
import onnx_ir as ir
import onnxruntime as ort
from onnxruntime.capi import onnxruntime_pybind11_state as _native  # pyright: ignore[reportAttributeAccessIssue]

from me2e_compress import graph
from me2e_compress.base.errors import FramesError, GraphError
from me2e_compress.graph.files import INLINE_LIMIT_BYTES, file_contains
from me2e_compress.graph.nodes import NATIVE, is_read
from me2e_compress.graph.recurrence import SessionPort, not_fed_back, recurrence
from me2e_compress.runtime.frames import Array, Frame
from me2e_compress.runtime.kernel_types import float32_hint, nodes_without_kernel
from me2e_compress.runtime.providers import CPU, Engine, Provider
from me2e_compress.runtime.runnable import (
    QDQ_OFF,
    int8_entry,
    make_runnable,
    why_unsupported,
)

# The compiled module has no stubs.
# Raised where inputs do not fit
InvalidArgument: type[Exception] = _native.InvalidArgument

# Everything raised where a graph cannot be read, built or run
REFUSALS: tuple[type[Exception], ...] = (
    _native.Fail,
    _native.InvalidArgument,
    _native.InvalidGraph,
    _native.InvalidProtobuf,
    _native.NoModel,
    _native.NoSuchFile,
    _native.NotImplemented,
    _native.RuntimeException,
    UnicodeDecodeError,  # from a message about names that are not UTF-8
    MemoryError,  # what it computes of constants as it opens is too large
    RuntimeError,  # an output of a type that numpy lacks, such as bfloat16
)

_KEEP_INT8 = "session.qdqisint8allowed"
# Smaller tensors stay in the graph: shape inference reads them.
LENT_BYTES = 1024

Weights: TypeAlias = Mapping[str, ort.OrtValue]
"""Lent weights by name; they must live as long as the session."""

_LENDABLE = frozenset(
    {
        ir.DataType.FLOAT, ir.DataType.DOUBLE, ir.DataType.FLOAT16, ir.DataType.INT8,
        ir.DataType.UINT8, ir.DataType.INT32, ir.DataType.INT64,
    }
)  # fmt: skip


def open_file(
    path: Path,
    options: ort.SessionOptions,
    provider: Provider = CPU,
    without: Sequence[str] | None = None,
) -> tuple[ort.InferenceSession, Weights]:
    """Open an ONNX file directly or, if onnxruntime refuses it, by loading it here."""
    if not path.is_file():
        raise GraphError(f"{path}: no such file")
    # Most files open directly: to load one takes ten times as long as to search it.
    if not file_contains(path, _OWN_NODE_BYTES, _LOOP_BYTES):
        try:
            return _open_with_retry(str(path), options, provider, without), {}
        except GraphError:
            pass
    # Graphs that are newer than onnxruntime, that store shapes in a file of weights, or
    # that hold fused operators
    return open_graph(graph.load(path), options, provider, without)


# Bytes of a node in the toolkit's own domain; onnxruntime would run its body
_OWN_NODE_BYTES = b":\x04me2e"
# Bytes of a node that may never end: loaded, it is checked
_LOOP_BYTES = b'"\x04Loop'


def open_graph(
    model: ir.Model,
    options: ort.SessionOptions,
    provider: Provider = CPU,
    without: Sequence[str] | None = None,
) -> tuple[ort.InferenceSession, Weights]:
    """Open a graph in memory, and return its session and its lent weights.

    The weights must live as long as the session, and must not change. The provider is
    attached to ``options``; ``without`` lists optimizations to disable, by default
    those of the provider. The GraphError of a refused graph names the operator.
    """
    if reason := why_unsupported(model, provider):
        raise GraphError(reason)
    model = make_runnable(model, options, provider)
    try:
        return _open_lent(model, options, provider, without)
    except GraphError as refusal:
        # Name the first operator that has no kernel, else give onnxruntime's reason.
        reason = str(refusal)
        if provider.native == CPU.native:
            typed = model.clone()
            graph.infer_shapes(typed)
            for node, missing in nodes_without_kernel(typed):
                reason = f"{missing} (node {node.name!r}){float32_hint(typed, missing)}"
                break
        raise GraphError(reason) from refusal


def _open_lent(
    model: ir.Model,
    options: ort.SessionOptions,
    provider: Provider,
    without: Sequence[str] | None,
) -> tuple[ort.InferenceSession, Weights]:
    """Open a graph whose large weights onnxruntime reads from this process's arrays."""
    # Lend the large weights that are read, and write the rest into the graph.
    lent: dict[str, ir.TensorProtocol] = {}
    inline: list[ir.TensorProtocol] = []
    for body in model.graphs():
        for name, value in body.initializers.items():
            tensor = value.const_value
            if tensor is None:
                continue
            if (
                body is model.graph
                and tensor.dtype in _LENDABLE
                and tensor.nbytes
                and (tensor.nbytes >= LENT_BYTES or _is_external(tensor))
                and is_read(value)  # onnxruntime drops the others, and then misses them
            ):
                lent[name] = tensor
            else:
                inline.append(tensor)
    # What remains may be external, or too large for one message.
    if (
        any(map(_is_external, inline))
        or sum(tensor.nbytes for tensor in inline) > INLINE_LIMIT_BYTES
    ):
        with tempfile.TemporaryDirectory(prefix="me2e-session-") as folder:
            path = Path(folder) / "model.onnx"
            graph.save(model, path)
            return _open_with_retry(str(path), options, provider, without), {}
    weights = {
        name: ort.OrtValue.ortvalue_from_numpy(np.ascontiguousarray(tensor.numpy()))
        for name, tensor in lent.items()
    }
    # The arrays stand in for an external file: of them the graph has name and type.
    options.add_external_initializers(list(weights), list(weights.values()))
    lent_values = {name: model.graph.initializers[name] for name in lent}
    try:
        for name, tensor in lent.items():
            shape = ir.Shape(tensor.shape.numpy())
            lent_values[name].const_value = ir.ExternalTensor(
                "lent", 0, tensor.nbytes, tensor.dtype, shape=shape, name=name
            )
        content = ir.to_proto(model).SerializeToString()
    finally:
        for name, tensor in lent.items():
            lent_values[name].const_value = tensor
    return _open_with_retry(content, options, provider, without), weights


def _is_external(tensor: ir.TensorProtocol) -> bool:
    return isinstance(tensor, ir.ExternalTensor)


def _open_with_retry(
    source: str | bytes,
    options: ort.SessionOptions,
    provider: Provider,
    without: Sequence[str] | None,
) -> ort.InferenceSession:
    """Open a graph; on failure, retry without what the optimizer makes of it."""
    left_out = provider.left_out if without is None else without
    try:
        return _open_once(source, options, provider, left_out)
    except REFUSALS as error:
        refusal = error.with_traceback(None)  # no circle that holds our callers
    # First without converting int8 to uint8: from opset 21 on, that step of onnxruntime
    # (1.31) leaves QuantizeLinear nodes whose `output_dtype` is not that of their zero
    # point, and then refuses them. Setting the option twice would make it warn
    try:
        options.get_session_config_entry(_KEEP_INT8)
    except RuntimeError:  # it is not set yet
        options.add_session_config_entry(_KEEP_INT8, "1")
    level = options.graph_optimization_level
    # Then as the nodes stand: 1.32 makes a MatMulNBits of float16 products of int8
    # weights with float32 scales, and refuses that. Who asks for the rewritten graph
    # gets that
    for tried in (level, level if options.optimized_model_filepath else _UNOPTIMIZED):
        options.graph_optimization_level = tried
        try:
            return _open_once(source, options, provider, left_out)
        except REFUSALS:
            pass
    options.graph_optimization_level = level
    line = " ".join(str(refusal).split())
    raise GraphError(f"onnxruntime cannot run this graph: {line}") from refusal


def _open_once(
    source: str | bytes,
    options: ort.SessionOptions,
    provider: Provider,
    left_out: Sequence[str],
) -> ort.InferenceSession:
    """Open a graph once, and check that it runs on the provider."""
    session = ort.InferenceSession(
        source,
        options,
        providers=provider.chain(),
        disabled_optimizers=list(left_out),
        enable_fallback=False,  # to another provider, with a print
    )
    provider.confirm(session.get_providers())
    return session


__all__ = ["Session", "SessionPort", "detached", "replay", "run_once"]

# Element types by onnxruntime's word for them
DTYPES: Mapping[str, np.dtype[np.generic]] = {
    f"tensor({kind.name.lower()})": kind.numpy() for kind in NATIVE
}

_SHRINK = "memory.enable_memory_arena_shrinkage"
_WEIGHTS_FILE = "session.optimized_model_external_initializers_file_name"
_UNOPTIMIZED = ort.GraphOptimizationLevel.ORT_DISABLE_ALL
_OPTIMIZED = ort.GraphOptimizationLevel.ORT_ENABLE_ALL


class Session:
    """An onnxruntime session; ``last_us`` has the microseconds of its last run.

    Args:
        model: the graph, or the file that holds it.
        threads: threads within an operator; 0 takes every core.
        optimize: False runs the nodes exactly as written (``ORT_DISABLE_ALL``).
        stock: all that onnxruntime does by itself: also the optimizations that the
            provider leaves out, and int8 kernels.
        int8_kernels: runs pairs of quantization nodes by onnxruntime's int8 kernels,
            those whose sums do not overflow. Without them the session answers what the
            nodes say; for what the kernels answer otherwise see :data:`QDQ_OFF`.
        frugal: runs nodes in the priority-based order, in which a reduction written
            right after its producer frees that tensor at once.
        release: frees working memory after every run, so that several sessions fit in
            the memory of one.
        rewritten: a file for the graph as onnxruntime optimizes it, with a file of
            weights beside it; it fits this machine's kernels only.
        provider: execution provider, and the libraries of operators it knows.
        profiled: a folder for the profile that :meth:`end_profile` writes.
        metadata: what overrides the model's own.

    Raises:
        GraphError: onnxruntime cannot run this graph; the message names the operator.
        ProviderError: the provider is not installed, or cannot start here.
    """

    def __init__(
        self,
        model: ir.Model | Path,
        *,
        threads: int = 0,
        optimize: bool = True,
        stock: bool = False,
        int8_kernels: bool = False,
        frugal: bool = False,
        release: bool = False,
        rewritten: Path | None = None,
        provider: Provider = CPU,
        profiled: Path | None = None,
        metadata: Mapping[str, str] | None = None,
    ) -> None:
        options = ort.SessionOptions()
        provider.attach(options)
        self.provider = provider
        options.intra_op_num_threads = threads
        options.log_severity_level = 4
        # Idle threads that spin slow down whatever else runs on the machine.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        # The optimizations: level, memory and order of nodes.
        options.graph_optimization_level = _OPTIMIZED if optimize else _UNOPTIMIZED
        # One block for all tensors of a run: twice the memory on VAD-tiny, no gain.
        options.enable_mem_pattern = False
        if not stock and provider.target == CPU.target:
            entry = int8_entry() if int8_kernels else (QDQ_OFF, "1")
            options.add_session_config_entry(*entry)
        if frugal:
            options.execution_order = ort.ExecutionOrder.PRIORITY_BASED
        if rewritten is not None:
            options.optimized_model_filepath = str(rewritten)
            options.add_session_config_entry(_WEIGHTS_FILE, f"{rewritten.name}.data")
            # Weights packed for the kernels are not what is written.
            options.add_session_config_entry("session.disable_prepacking", "1")
        if profiled is not None:
            options.enable_profiling = True
            options.profile_file_prefix = str(profiled / "nodes")
        # Open the graph, and read its ports and metadata
        self.last_us = 0
        own = provider.open(model, threads, int8_kernels=stock or int8_kernels)
        left = () if stock else None
        engine = own or _OnnxRuntime(model, options, provider, left, release=release)
        self._engine, self.inputs, self.outputs = engine, engine.inputs, engine.outputs
        self.metadata = {**engine.metadata, **(metadata or {})}
        self.recurrent = recurrence(self.metadata, self.inputs, self.outputs)

    def first_state(self, arrays: Mapping[str, Array]) -> dict[str, Array]:
        """Return the first values of recurrent inputs: from ``arrays``, else zeros.

        An open dimension has the size that an array has for its name; an input of
        unknown shape is a GraphError.
        """
        sizes = {
            dim: size
            for name, port in self.inputs.items()
            if name in arrays
            for dim, size in zip(port.shape, arrays[name].shape, strict=False)
            if dim_name(dim)
        }
        ports = self.inputs
        return {
            name: arrays[name]
            if name in arrays
            else zero_state(name, ports[name], sizes)
            for name in self.recurrent
        }

    def run(
        self, feeds: Mapping[str, Array], outputs: Sequence[str] | None = None
    ) -> dict[str, Array]:
        """Run one inference; return all outputs, or those that are named.

        ``feeds`` has one array for every input; other names are ignored. An input that
        is missing or does not fit is a FramesError, a node that fails a GraphError.
        """
        begun_ns = time.perf_counter_ns()
        if missing := [name for name in self.inputs if name not in feeds]:
            reason = not_fed_back(missing[0], self.inputs, self.outputs)
            raise FramesError(
                f"input {missing[0]} is missing; there is {', '.join(feeds) or 'none'}"
                f"{reason}"
            )
        names = list(self.outputs) if outputs is None else list(outputs)
        inputs = {name: feeds[name] for name in self.inputs}
        outputs_by_name = dict(zip(names, self._engine.run(names, inputs), strict=True))
        self.last_us = (time.perf_counter_ns() - begun_ns) // 1_000
        return outputs_by_name

    def end_profile(self) -> Path:
        """Write the profile; return its file, which has one event a line."""
        return self._engine.end_profile()


class _OnnxRuntime(Engine):
    """Runs a graph in onnxruntime."""

    def __init__(
        self,
        model: ir.Model | Path,
        options: ort.SessionOptions,
        provider: Provider,
        without: Sequence[str] | None,
        *,
        release: bool,
    ) -> None:
        self._each_run, self._lent = ort.RunOptions(), dict[str, ort.OrtValue]()
        if release:
            self._each_run.add_run_config_entry(_SHRINK, "cpu:0")
        if isinstance(model, ir.Model):
            self._ort, lent = open_graph(model, options, provider, without)
        else:
            self._ort, lent = open_file(model, options, provider, without)
        self._lent.update(lent)
        try:
            self.inputs = _ports(self._ort.get_inputs())
            self.outputs = _ports(self._ort.get_outputs())
            self.metadata = self._ort.get_modelmeta().custom_metadata_map
        except UnicodeDecodeError as error:
            raise GraphError(f"a name in the graph is not UTF-8: {error}") from error

    def run(self, names: Sequence[str], inputs: Mapping[str, Array]) -> list[Array]:
        # Inputs that do not fit are the caller's fault, others the graph's.
        try:
            return cast(
                "list[Array]", self._ort.run(names, dict(inputs), self._each_run)
            )
        except InvalidArgument as error:
            raise FramesError(
                f"these inputs do not fit: {_on_one_line(error)}"
            ) from error
        except REFUSALS as error:
            raise GraphError(f"onnxruntime failed: {_on_one_line(error)}") from error

    def end_profile(self) -> Path:
        return Path(self._ort.end_profiling())


def replay(
    session: Session,
    frames: Iterable[Frame],
    outputs: Sequence[str] | None = None,
) -> Iterator[dict[str, Array]]:
    """Run a model over a recording and yield its outputs; see :func:`feed_forward`."""
    wanted = list(session.outputs) if outputs is None else list(outputs)
    for _, values, _ in feed_forward(session, frames, wanted):
        yield {name: values[name] for name in wanted}


def feed_forward(
    session: Session,
    frames: Iterable[Frame],
    outputs: Sequence[str],
    state: Mapping[str, Array] | None = None,
) -> Iterator[tuple[dict[str, Array], dict[str, Array], dict[str, Array]]]:
    """Run a model over a recording, its recurrent state fed forward.

    ``state`` holds the recurrent inputs before a first frame that continues a scene, to
    resume an interrupted replay.

    Yields:
        All inputs of a frame, the outputs and those that are state, the next state.

    Raises:
        FramesError: a frame does not fit; the message names it.
        GraphError: a recurrent input of unknown shape has no first value.
    """
    # State is fetched even if the caller does not want it.
    fetched = list(dict.fromkeys([*outputs, *session.recurrent.values()]))
    memory = dict(state or {})
    for frame in frames:
        # At the start of a scene a recurrent input comes from the frame or is zeros;
        # later it is the last output, whatever the frame has
        if frame.starts_scene:
            memory = session.first_state(frame.arrays)
        inputs = {**frame.arrays, **memory}
        try:
            values = session.run(inputs, fetched)
        except FramesError as error:
            raise FramesError(f"frame {frame.index}: {error}") from error
        # The outputs of this frame are the next one's state.
        memory = {name: values[answer] for name, answer in session.recurrent.items()}
        yield inputs, values, memory


def detached(outputs: Mapping[str, Array]) -> dict[str, Array]:
    """Copy outputs out of onnxruntime's memory."""
    # An output keeps the whole working memory of its session alive, 1.7 GB on VAD-tiny
    return {name: np.array(value) for name, value in outputs.items()}


def run_once(model: ir.Model, feeds: Mapping[str, Array]) -> dict[str, Array]:
    """Run a graph once in a new session, to evaluate a few constants."""
    return Session(model, threads=1, optimize=False).run(feeds)


def _ports(arguments: Sequence[ort.NodeArg]) -> dict[str, SessionPort]:
    return {port.name: SessionPort(port.type, tuple(port.shape)) for port in arguments}


def dim_name(dim: int | str | None) -> str:
    """Return the name of an open dimension; empty where it has none, or a size."""
    return dim if isinstance(dim, str) and any(map(str.isalnum, dim)) else ""


def zero_state(
    name: str, port: SessionPort, sizes: Mapping[int | str | None, int] | None = None
) -> Array:
    """Return zeros for a recurrent input, its open dimensions of the named sizes."""
    known = sizes or {}
    shape = [dim if isinstance(dim, int) else known.get(dim) for dim in port.shape]
    sizes_known = [size for size in shape if size is not None]
    if len(sizes_known) < len(shape):
        axis = shape.index(None)
        dim = dim_name(port.shape[axis]) or f"{name}:{axis}"
        raise GraphError(
            f"recurrent input {name} is {port.type} {list(port.shape)}, and nothing"
            f" gives {dim} a size: me2e-compress compress M.onnx -r exact"
            f" --set-dim {dim}=1 -o FIXED.onnx, and go on with FIXED.onnx"
        )
    if port.type not in DTYPES:
        raise GraphError(f"recurrent input {name} is {port.type}: it has no zeros")
    return np.zeros(sizes_known, DTYPES[port.type])


def _on_one_line(error: Exception) -> str:
    return " ".join(str(error).split())
