"""ONNX's own single-operator models, brought into a form that onnxruntime runs."""

import dataclasses
import warnings
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import onnx
import onnxruntime

NEWEST_IR = 13
NEWEST_OPSET = 26
"""The newest that onnxruntime reads; the suite's own are newer."""

ROUNDINGS = 8
"""How far passes may move an output, in units of the last place of its largest number:
where they let onnxruntime fuse attention, it sums in another order (3 units)."""


@dataclasses.dataclass(frozen=True)
class Case:
    """One model, its inputs and the outputs that ONNX's reference gives.

    Inputs and outputs are arrays, lists of arrays for sequences, or None for an
    optional that is absent.
    """

    name: str
    model: onnx.ModelProto
    relabelled: bool
    inputs: list[Any]
    outputs: list[Any]
    rtol: float
    atol: float


def load() -> list[Case]:
    """Build the suite, each model of an opset that is too new said to be older.

    Whether it means the same there, only its outputs can say.
    """
    with warnings.catch_warnings():
        # Building the suite computes NaN and infinity on purpose.
        warnings.simplefilter("ignore")
        from onnx.backend.test.loader import load_model_tests

        suite = load_model_tests(kind="node")
    cases = []
    for case in suite:
        assert case.model is not None
        relabelled = _relabel(case.model)
        for inputs, outputs in case.data_sets or ():
            cases.append(
                Case(
                    name=case.name,
                    model=case.model,
                    relabelled=relabelled,
                    inputs=[_plain(value) for value in inputs],
                    outputs=[_plain(value) for value in outputs],
                    rtol=case.rtol,
                    atol=case.atol,
                )
            )
    return cases


def _relabel(model: onnx.ModelProto) -> bool:
    """Say an older format and opset; and the one locale that every machine has."""
    model.ir_version = min(model.ir_version, NEWEST_IR)
    for node in model.graph.node:
        if node.op_type == "StringNormalizer":
            node.attribute.append(onnx.helper.make_attribute("locale", "C"))
    newer = [
        opset
        for opset in model.opset_import
        if opset.domain == "" and opset.version > NEWEST_OPSET
    ]
    for opset in newer:
        opset.version = NEWEST_OPSET
    return bool(newer)


def _plain(value: Any) -> Any:
    if isinstance(value, onnx.TensorProto):
        return onnx.numpy_helper.to_array(value)
    return np.asarray(value) if isinstance(value, np.generic) else value


def bake(case: Case) -> Case:
    """Make constants of the inputs: initializers, and nodes that make lists of them."""
    model = onnx.ModelProto()
    model.CopyFrom(case.model)
    del model.graph.input[:], model.graph.node[:]
    for port, value in zip(case.model.graph.input, case.inputs, strict=True):
        _bake(model.graph, port.name, port.type, value)
    model.graph.node.extend(case.model.graph.node)
    return dataclasses.replace(case, model=model, inputs=[])


def _bake(graph: onnx.GraphProto, name: str, kind: onnx.TypeProto, value: Any) -> None:
    if kind.HasField("optional_type"):
        inner = kind.optional_type.elem_type
        if value is None:
            node = onnx.helper.make_node("Optional", [], [name], type=inner)
        else:
            _bake(graph, f"{name}_some", inner, value)
            node = onnx.helper.make_node("Optional", [f"{name}_some"], [name])
        graph.node.append(node)
    elif kind.HasField("sequence_type"):
        inner = kind.sequence_type.elem_type
        parts = [f"{name}_{index}" for index in range(len(value))]
        for part, one in zip(parts, value, strict=True):
            _bake(graph, part, inner, one)
        node = onnx.helper.make_node("SequenceConstruct", parts, [name])
        if not parts:
            empty = inner.tensor_type.elem_type
            node = onnx.helper.make_node("SequenceEmpty", [], [name], dtype=empty)
        graph.node.append(node)
    else:
        graph.initializer.append(onnx.numpy_helper.from_array(value, name))


def run(case: Case) -> list[Any]:
    """Run a model in onnxruntime."""
    model = case.model
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.log_severity_level = 4
    session = onnxruntime.InferenceSession(
        model.SerializeToString(), options, providers=["CPUExecutionProvider"]
    )
    quiet = onnxruntime.RunOptions()
    quiet.log_severity_level = 4
    # BatchNormalization that trains writes into what it is fed
    feeds = {
        port.name: value.copy() if isinstance(value, np.ndarray) else value
        for port, value in zip(model.graph.input, case.inputs, strict=True)
        if value is not None
    }
    return list(session.run(None, feeds, quiet))


def has_numpys_types(case: Case) -> bool:
    """Whether numpy itself has all elements: not bfloat16, float8 or int4."""
    ports = (*case.model.graph.input, *case.model.graph.output)
    elements = [port.type.tensor_type.elem_type for port in ports]
    return all(
        _is_numpys(onnx.helper.tensor_dtype_to_np_dtype(each))
        for each in elements
        if each
    )


def _is_numpys(dtype: np.dtype[Any]) -> bool:
    return dtype.isbuiltin == 1 or dtype.kind == "U"


def differs(case: Case, result: Sequence[Any]) -> str | None:
    """Say where outputs differ beyond the case's own tolerance; None if nowhere."""
    return _first(
        _unlike(left, right, case.rtol, case.atol)
        for left, right in _pairs(result, case.outputs)
    )


def moved(case: Case, result: Sequence[Any]) -> str | None:
    """Say where more than rounding moved an output; None if nowhere."""
    return _first(
        _unlike(left, right, 0.0, _rounding(right))
        for left, right in _pairs(result, case.outputs)
    )


def _first(faults: Iterator[str | None]) -> str | None:
    return next((fault for fault in faults if fault), None)


def _pairs(result: Sequence[Any], wanted: Sequence[Any]) -> Iterator[tuple[Any, Any]]:
    for left, right in zip(result, wanted, strict=True):
        if isinstance(right, list):
            yield from _pairs(left, right)
        else:
            yield np.asarray(left), np.asarray(right)


def _rounding(array: Any) -> float:
    """A few roundings of the largest number; nothing where numbers are not rounded."""
    if array.dtype.kind != "f":
        return 0.0
    largest = np.abs(array[np.isfinite(array)]).max(initial=0)
    return float(ROUNDINGS * np.finfo(array.dtype).eps * largest)


def _unlike(left: Any, right: Any, rtol: float, atol: float) -> str | None:
    if left.dtype.kind in "OUS" or right.dtype.kind in "OUS":
        same = left.astype(str).tolist() == right.astype(str).tolist()
        return None if same else "other strings"
    if left.shape != right.shape or left.dtype != right.dtype:
        return f"{left.dtype}{left.shape} instead of {right.dtype}{right.shape}"
    close = np.allclose(left, right, rtol, atol, equal_nan=True)
    return None if close else f"{left.reshape(-1)[:4]} not {right.reshape(-1)[:4]}"
