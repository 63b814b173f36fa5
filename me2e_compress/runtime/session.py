"""Sessions that run one graph, and the replay of recordings."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal, TypeAlias, cast

import numpy as np
import onnx_ir as ir
import onnxruntime as ort

from me2e_compress.errors import FramesError, GraphError
from me2e_compress.graph.nodes import NATIVE
from me2e_compress.graph.recurrence import SessionPort, not_fed_back, recurrence
from me2e_compress.runtime.frames import Array, Frame
from me2e_compress.runtime.opening import (
    REFUSALS,
    InvalidArgument,
    Weights,
    open_file,
    open_graph,
)
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.runnable import NO_OVERFLOW, QDQ_OFF

__all__ = [
    "Level",
    "Session",
    "SessionPort",
    "detached",
    "replay",
    "run_once",
]

DTYPES: Mapping[str, np.dtype[np.generic]] = {
    f"tensor({kind.name.lower()})": kind.numpy() for kind in NATIVE
}
"""Element types by onnxruntime's word for them."""


_SHRINK = "memory.enable_memory_arena_shrinkage"
_WEIGHTS_FILE = "session.optimized_model_external_initializers_file_name"


Level: TypeAlias = Literal["none", "basic", "extended", "layout", "all"]
"""How far onnxruntime optimizes a graph; each level includes those before it."""

_LEVELS: Mapping[Level, ort.GraphOptimizationLevel] = {
    "none": ort.GraphOptimizationLevel.ORT_DISABLE_ALL,
    "basic": ort.GraphOptimizationLevel.ORT_ENABLE_BASIC,
    "extended": ort.GraphOptimizationLevel.ORT_ENABLE_EXTENDED,
    "layout": ort.GraphOptimizationLevel.ORT_ENABLE_LAYOUT,
    "all": ort.GraphOptimizationLevel.ORT_ENABLE_ALL,
}
_DEFAULT: Mapping[bool, Level] = {False: "none", True: "all"}


class Session:
    """An onnxruntime session.

    Args:
        model: the graph, or the file that holds it.
        threads: threads within an operator; 0 takes every core.
        optimize: False runs the nodes exactly as written (``ORT_DISABLE_ALL``), like
            the level ``none``; True is the level ``all``.
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
        said: metadata that overrides the model's own.

    Raises:
        GraphError: onnxruntime cannot run this graph; the message names the operator.
        ProviderError: the provider is not installed, or cannot start here.
    """

    def __init__(
        self,
        model: ir.Model | Path,
        *,
        threads: int = 0,
        optimize: bool | Level = True,
        stock: bool = False,
        int8_kernels: bool = False,
        frugal: bool = False,
        release: bool = False,
        rewritten: Path | None = None,
        provider: Provider = CPU,
        profiled: Path | None = None,
        said: Mapping[str, str] | None = None,
    ) -> None:
        options = ort.SessionOptions()
        provider.attach(options)
        self.provider = provider
        options.intra_op_num_threads = threads
        options.log_severity_level = 4
        # Idle threads that spin slow down whatever else runs on the machine.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        # The optimizations: level, memory and order of nodes.
        level: Level = optimize if isinstance(optimize, str) else _DEFAULT[optimize]
        options.graph_optimization_level = _LEVELS[level]
        # One block for all tensors of a run: twice the memory on VAD-tiny, no gain.
        options.enable_mem_pattern = False
        if not stock and provider.target == CPU.target:
            entry = NO_OVERFLOW if int8_kernels else QDQ_OFF
            options.add_session_config_entry(entry, "1")
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
        self._each_run = ort.RunOptions()
        if release:
            self._each_run.add_run_config_entry(_SHRINK, "cpu:0")
        # Open the graph, and read its ports and metadata.
        self._lent: Weights = {}
        without = () if stock else None
        if isinstance(model, ir.Model):
            self._ort, self._lent = open_graph(model, options, provider, without)
        else:
            self._ort, self._lent = open_file(model, options, provider, without)
        try:
            self.inputs = _ports(self._ort.get_inputs())
            self.outputs = _ports(self._ort.get_outputs())
            metadata: dict[str, str] = self._ort.get_modelmeta().custom_metadata_map
        except UnicodeDecodeError as error:
            raise GraphError(f"a name in the graph is not UTF-8: {error}") from error
        self.metadata = {**metadata, **(said or {})}
        self.recurrent = recurrence(self.metadata, self.inputs, self.outputs)

    def first_state(self, held: Mapping[str, Array]) -> dict[str, Array]:
        """Return the first values of recurrent inputs: from ``held``, else zeros.

        Raises:
            GraphError: an input of unknown shape has no first value.
        """
        return {
            name: held[name] if name in held else zeros(name, self.inputs[name])
            for name in self.recurrent
        }

    def run(
        self,
        feeds: Mapping[str, Array],
        outputs: Sequence[str] | None = None,
    ) -> dict[str, Array]:
        """Run one inference; return all outputs, or those that are named.

        ``feeds`` has one array for every input; other names are ignored.

        Raises:
            FramesError: an input is missing or has the wrong type or shape.
            GraphError: a node failed on these inputs.
        """
        if missing := [name for name in self.inputs if name not in feeds]:
            reason = not_fed_back(missing[0], self.inputs, self.outputs)
            raise FramesError(
                f"input {missing[0]} is missing; there is {', '.join(feeds) or 'none'}"
                f"{reason}"
            )
        names = list(self.outputs) if outputs is None else list(outputs)
        # Inputs that do not fit are the caller's fault, others the graph's.
        try:
            fed = {name: feeds[name] for name in self.inputs}
            values = cast("list[Array]", self._ort.run(names, fed, self._each_run))
        except InvalidArgument as error:
            raise FramesError(f"these inputs do not fit: {_line(error)}") from error
        except REFUSALS as error:
            raise GraphError(f"onnxruntime failed: {_line(error)}") from error
        return dict(zip(names, values, strict=True))

    def end_profile(self) -> Path:
        """Write the profile; return its file, which has one event a line."""
        return Path(self._ort.end_profiling())


def replay(
    session: Session,
    frames: Iterable[Frame],
    outputs: Sequence[str] | None = None,
    state: Mapping[str, Array] | None = None,
) -> Iterator[dict[str, Array]]:
    """Run a model over a recording, its recurrent state fed forward; yield its outputs.

    At the start of a scene a recurrent input comes from the frame or, if the frame has
    none, is zeros. Afterwards it is the model's output of the previous frame, even if
    the frame has an array for it. ``state`` holds the recurrent inputs before a first
    frame that continues a scene, to resume an interrupted replay; ``outputs`` None
    yields all.

    Raises:
        FramesError: a frame does not fit; the message names it.
        GraphError: a recurrent input of unknown shape has no first value.
    """
    wanted = list(session.outputs) if outputs is None else list(outputs)
    # State is fetched even if the caller does not want it.
    fetched = list(dict.fromkeys([*wanted, *session.recurrent.values()]))
    memory: Mapping[str, Array] = {} if state is None else state
    for frame in frames:
        if frame.starts_scene:
            memory = session.first_state(frame.arrays)
        try:
            fed = {**frame.arrays, **memory}
            values = session.run(fed, fetched)
        except FramesError as error:
            raise FramesError(f"frame {frame.index}: {error}") from error
        # The outputs of this frame are the next one's state.
        memory = {name: values[answer] for name, answer in session.recurrent.items()}
        yield {name: values[name] for name in wanted}


def detached(outputs: Mapping[str, Array]) -> dict[str, Array]:
    """Copy outputs out of onnxruntime's memory.

    An output keeps the whole working memory of its session alive, 1.7 GB on VAD-tiny.
    """
    return {name: np.array(value) for name, value in outputs.items()}


def run_once(model: ir.Model, feeds: Mapping[str, Array]) -> dict[str, Array]:
    """Run a graph once in a new session, to evaluate a few constants.

    Raises:
        GraphError: onnxruntime cannot run this graph.
        FramesError: an input is missing or does not fit.
    """
    return Session(model, threads=1, optimize=False).run(feeds)


def _ports(arguments: Sequence[ort.NodeArg]) -> dict[str, SessionPort]:
    return {each.name: SessionPort(each.type, tuple(each.shape)) for each in arguments}


def zeros(name: str, port: SessionPort) -> Array:
    """Return zeros for a recurrent input; GraphError if its shape is open."""
    shape = [size for size in port.shape if isinstance(size, int)]
    if len(shape) < len(port.shape) or port.type not in DTYPES:
        raise GraphError(
            f"recurrent input {name} is {port.type} {list(port.shape)}: its first value"
            " must stand in the frame that opens a scene"
        )
    return np.zeros(shape, DTYPES[port.type])


def _line(error: Exception) -> str:
    return " ".join(str(error).split())
