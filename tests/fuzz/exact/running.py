"""Run a graph as it stands, on drawn inputs, and say how far two answers lie apart.

No code of the passes, nor of the manager's own proof, is used.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import onnx
import onnx_ir as ir
import onnxruntime as ort

from me2e_compress.runtime.session import Session, SessionPort

Arrays: TypeAlias = dict[str, npt.NDArray[Any]]

TYPES = {
    "tensor(float)": np.float32,
    "tensor(double)": np.float64,
    "tensor(int64)": np.int64,
    "tensor(bool)": np.bool_,
}

ULPS = 4
"""How many units in the last place an input is nudged."""


class RefusedError(Exception):
    """onnxruntime does not load or run a graph."""


def _needs_our_kernels(model: onnx.ModelProto) -> bool:
    functions = {each.domain for each in model.functions}
    domains = {each.domain for each in model.graph.node} - {"", "ai.onnx", *functions}
    return bool(domains) or any(each.startswith("me2e") for each in functions)


class Runner:
    """A graph that is loaded, every optimization of onnxruntime off.

    Attributes:
        inputs: their ports, by name.
        outputs: theirs.

    Raises:
        RefusedError: onnxruntime does not take it.
    """

    def __init__(self, model: onnx.ModelProto) -> None:
        try:
            if _needs_our_kernels(model):
                ours = Session(ir.from_proto(model), threads=1, optimize=False)
                self.inputs, self.outputs = ours.inputs, ours.outputs
                self._run: Callable[[Arrays], Arrays] = ours.run
            else:
                self._open(model.SerializeToString())
        except Exception as error:  # the refusals of onnxruntime have no common type
            raise RefusedError(_line(error)) from error

    def _open(self, content: bytes) -> None:
        options = ort.SessionOptions()
        options.log_severity_level = 4
        options.intra_op_num_threads = 1
        options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_DISABLE_ALL
        session = ort.InferenceSession(content, options, ["CPUExecutionProvider"])
        self.inputs, self.outputs = (
            {port.name: SessionPort(port.type, tuple(port.shape)) for port in ports}
            for ports in (session.get_inputs(), session.get_outputs())
        )
        names = list(self.outputs)
        self._run = lambda feeds: dict(
            zip(names, map(np.asarray, session.run(names, feeds)), strict=True)
        )

    def run(self, feeds: Arrays) -> Arrays:
        """Run once.

        Raises:
            RefusedError: a node failed.
        """
        try:
            return self._run(feeds)
        except Exception as error:  # as above
            raise RefusedError(_line(error)) from error


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:300]


def drawn_inputs(runner: Runner, seed: int, batch: int) -> Arrays:
    """Draw inputs, none of them zero, every open dimension of one size."""
    draws = np.random.default_rng((seed, batch))
    made: Arrays = {}
    for name, port in runner.inputs.items():
        shape = [each if isinstance(each, int) else batch for each in port.shape]
        if port.type == "tensor(bool)":
            made[name] = np.asarray(draws.random(shape) < 0.5)
        elif port.type == "tensor(int64)":
            made[name] = np.asarray(draws.integers(0, 2, shape), np.int64)
        else:
            values = draws.normal(size=shape)
            made[name] = np.asarray(values + (values == 0), TYPES[port.type])
    return made


def nudged(feeds: Arrays, seed: int) -> Arrays:
    """Move every float by a few units in its last place."""
    signs = np.random.default_rng(seed)
    moved = dict(feeds)
    for name, values in feeds.items():
        if values.dtype.kind == "f":
            steps = signs.choice((-ULPS, ULPS), values.shape) * np.spacing(values)
            moved[name] = np.asarray(values + steps, values.dtype)
    return moved


def open_sizes(seed: int, model: onnx.ModelProto) -> Sequence[int]:
    """Draw the sizes that open dimensions get; one is enough where none is open."""
    ports = (port.type.tensor_type.shape.dim for port in model.graph.input)
    is_open = any(not dim.HasField("dim_value") for dims in ports for dim in dims)
    first = 2 + seed % 3
    return (first, 1 + first * 2) if is_open else (first,)


TOLERANCES = {"float64": 1e-9, "float32": 1e-4, "float16": 1e-2, "bfloat16": 5e-2}
"""What the manager allows, written out so that nobody loosens both at once."""

TRIALS = 3
"""How often inputs are nudged."""


def distance(wanted: npt.NDArray[Any], found: npt.NDArray[Any]) -> float:
    """Return max|a-b|/max|a| of floats; of anything else, 0 if equal."""
    if wanted.shape != found.shape or wanted.dtype != found.dtype:
        return float("inf")
    if wanted.dtype.kind != "f":
        return 0.0 if np.array_equal(wanted, found) else float("inf")
    finite = np.isfinite(wanted)
    same = np.array_equal(wanted[~finite], found[~finite], equal_nan=True)
    if not same or not np.isfinite(found[finite]).all():
        return float("inf")
    a, b = wanted[finite].astype(np.float64), found[finite].astype(np.float64)
    gap, scale = (float(np.abs(x).max(initial=0.0)) for x in (a - b, a))
    if gap == 0:
        return 0.0
    return gap / scale if scale else float("inf")


class Answers:
    """What a graph answers on some inputs, and how rounding alone moves that."""

    def __init__(self, runner: Runner, feeds: Sequence[Arrays]) -> None:
        self.runner, self.feeds = runner, feeds
        self.values = [runner.run(each) for each in feeds]
        self._moved = dict[int, dict[str, float]]()

    def off(self, at: int, found: Arrays) -> dict[str, float]:
        """Return the outputs that differ by more than is allowed, and by how much."""
        gaps = dict[str, float]()
        for name, value in self.values[at].items():
            gap = distance(value, found[name])
            if gap > TOLERANCES.get(value.dtype.name, 0.0):
                gaps[name] = gap
        return gaps

    def is_steady(self, at: int, gaps: Mapping[str, float]) -> bool:
        """Say whether some of these moved further than nudged inputs move them."""
        if at not in self._moved:
            self._moved[at] = self._nudges(at)
        return any(gap > self._moved[at][name] for name, gap in gaps.items())

    def _nudges(self, at: int) -> dict[str, float]:
        runs = [self.runner.run(nudged(self.feeds[at], t)) for t in range(TRIALS)]
        return {
            name: max(distance(value, found[name]) for found in runs)
            for name, value in self.values[at].items()
        }
