"""Run a graph as it stands, on drawn inputs, and say how far two answers lie apart.

No code of the passes, nor of the manager's own proof, is used.
"""

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import onnx
import onnx_ir as ir
import onnxruntime as ort

from me2e_compress.errors import GraphError, Me2eError
from me2e_compress.runtime.session import Session

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


def uses_plugins(model: onnx.ModelProto) -> bool:
    """Say whether a node needs kernels of this toolkit."""
    own = {each.domain for each in model.functions}
    return any(each.domain not in {"", "ai.onnx", *own} for each in model.graph.node)


class Runner:
    """A graph that is loaded, every optimization of onnxruntime off.

    Raises:
        RefusedError: onnxruntime does not take it.
    """

    def __init__(self, model: onnx.ModelProto) -> None:
        self._ours = uses_plugins(model) or any(
            each.domain.startswith("me2e") for each in model.functions
        )
        self.outputs: list[str] = [each.name for each in model.graph.output]
        if self._ours:
            self._session = self._open_ours(model)
            return
        options = ort.SessionOptions()
        options.log_severity_level = 4
        options.intra_op_num_threads = 1
        level = ort.GraphOptimizationLevel.ORT_DISABLE_ALL
        options.graph_optimization_level = level
        try:
            content = model.SerializeToString()
            self._session = ort.InferenceSession(
                content, options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # its refusals have no common type
            raise RefusedError(_line(error)) from error

    @staticmethod
    def _open_ours(model: onnx.ModelProto) -> Session:
        try:
            return Session(ir.from_proto(model), threads=1, optimize=False)
        except Me2eError as error:
            raise RefusedError(_line(error)) from error

    @property
    def inputs(self) -> dict[str, tuple[str, tuple[int | str | None, ...]]]:
        """Type and shape of every input."""
        if isinstance(self._session, Session):
            ports = self._session.inputs
            return {
                name: (each.type, tuple(each.shape)) for name, each in ports.items()
            }
        given = self._session.get_inputs()
        return {each.name: (each.type, tuple(each.shape)) for each in given}

    @property
    def output_types(self) -> dict[str, str]:
        """Type of every output."""
        if isinstance(self._session, Session):
            return {name: each.type for name, each in self._session.outputs.items()}
        return {each.name: each.type for each in self._session.get_outputs()}

    def run(self, feeds: Mapping[str, npt.NDArray[Any]]) -> Arrays:
        """Run once.

        Raises:
            RefusedError: a node failed.
        """
        try:
            if isinstance(self._session, Session):
                return self._session.run(feeds)
            values = self._session.run(self.outputs, dict(feeds))
        except GraphError as error:
            raise RefusedError(_line(error)) from error
        except Exception as error:  # as above
            raise RefusedError(_line(error)) from error
        found = zip(self.outputs, values, strict=True)
        return {name: np.asarray(value) for name, value in found}


def drawn_inputs(runner: Runner, seed: int, batch: int) -> Arrays:
    """Draw inputs, none of them zero, every open dimension of one size."""
    draws = np.random.default_rng((seed, batch))
    made: Arrays = {}
    for name, (kind, dims) in runner.inputs.items():
        shape = [each if isinstance(each, int) else batch for each in dims]
        if kind == "tensor(bool)":
            made[name] = np.asarray(draws.random(shape) < 0.5)
        elif kind == "tensor(int64)":
            made[name] = np.asarray(draws.integers(0, 2, shape), np.int64)
        else:
            values = draws.normal(size=shape)
            made[name] = np.asarray(values + (values == 0), TYPES[kind])
    return made


def nudged(feeds: Mapping[str, npt.NDArray[Any]], seed: int) -> Arrays:
    """Move every float by a few units in its last place."""
    signs = np.random.default_rng(seed)
    return {name: _nudge(each, signs) for name, each in feeds.items()}


def _nudge(values: npt.NDArray[Any], signs: np.random.Generator) -> npt.NDArray[Any]:
    if values.dtype.kind != "f":
        return values
    moved = signs.choice((-ULPS, ULPS), values.shape)
    return np.asarray(values + moved * np.spacing(values), values.dtype)


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:300]


def open_sizes(seed: int, model: onnx.ModelProto) -> Sequence[int]:
    """Draw the sizes that open dimensions get; one is enough where none is open."""
    dims = [
        dim
        for port in model.graph.input
        for dim in port.type.tensor_type.shape.dim
        if not dim.HasField("dim_value")
    ]
    first = 2 + seed % 3
    return (first, 1 + first * 2) if dims else (first,)


TOLERANCES = {"float64": 1e-9, "float32": 1e-4, "float16": 1e-2, "bfloat16": 5e-2}
"""What the manager allows, written out so that nobody loosens both at once."""

TRIALS = 3
"""How often inputs are nudged."""


def distance(wanted: npt.NDArray[Any], found: npt.NDArray[Any]) -> float:
    """Return max|a-b|/max|a| of floats; of anything else, 0 if equal."""
    if wanted.shape != found.shape or wanted.dtype != found.dtype:
        return float("inf")
    if wanted.size == 0:
        return 0.0
    if wanted.dtype.kind != "f":
        return 0.0 if np.array_equal(wanted, found) else float("inf")
    a, b = wanted.astype(np.float64), found.astype(np.float64)
    finite = np.isfinite(a)
    if not np.array_equal(finite, np.isfinite(b)):
        return float("inf")
    if not np.array_equal(a[~finite], b[~finite], equal_nan=True):
        return float("inf")
    if not finite.any():
        return 0.0
    gap = float(np.abs(a[finite] - b[finite]).max())
    scale = float(np.abs(a[finite]).max())
    if gap == 0:
        return 0.0
    return gap / scale if scale else float("inf")


def allowed(values: npt.NDArray[Any]) -> float:
    return TOLERANCES.get(values.dtype.name, 0.0)


class Answers:
    """What a graph answers on some inputs, and how rounding alone moves that."""

    def __init__(self, runner: Runner, feeds: Sequence[Arrays]) -> None:
        self.runner, self.feeds = runner, feeds
        self.values = [runner.run(each) for each in feeds]
        self._moved: list[dict[str, float]] | None = None

    def off(self, at: int, found: Mapping[str, npt.NDArray[Any]]) -> dict[str, float]:
        """Return the outputs that differ by more than is allowed, and by how much."""
        gaps = {
            name: distance(value, found[name])
            for name, value in self.values[at].items()
        }
        wanted = self.values[at]
        return {n: gap for n, gap in gaps.items() if gap > allowed(wanted[n])}

    def is_steady(self, at: int, gaps: Mapping[str, float]) -> bool:
        """Say whether some of these moved further than nudged inputs move them."""
        moved = self._spread(at)
        return any(gap > moved[name] for name, gap in gaps.items())

    def _spread(self, at: int) -> dict[str, float]:
        if self._moved is None:
            self._moved = [self._nudges(each) for each in range(len(self.feeds))]
        return self._moved[at]

    def _nudges(self, at: int) -> dict[str, float]:
        worst = dict.fromkeys(self.values[at], 0.0)
        for trial in range(TRIALS):
            found = self.runner.run(nudged(self.feeds[at], trial))
            for name, value in self.values[at].items():
                worst[name] = max(worst[name], distance(value, found[name]))
        return worst
