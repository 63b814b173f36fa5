"""Lower a graph that was quantized for TensorRT, by this package or by another."""

import dataclasses

import onnx_ir as ir

from me2e_compress.calibration.ranges import Ranges
from me2e_compress.targets.onnxruntime.lower import lower
from me2e_compress.targets.onnxruntime.region import find_region
from me2e_compress.targets.onnxruntime.strip import draft_of_qdq


def convert(model: ir.Model, ranges: Ranges | None = None) -> ir.Model:
    """Give a copy of an int8 graph that onnxruntime runs in int8 on the CPU.

    As it stands, such a graph is slower than a float one: onnxruntime's convolutions
    answer uint8 and so need a pair behind them, and it has no fast kernel for int8
    activations. The copy has the same layers in int8, with the same weights and the
    same ranges.

    Args:
        model: a graph with symmetric int8 pairs, e.g. ModelOpt's; it stays as it is.
        ranges: of the tensors that :func:`unranged` names.

    Raises:
        PreconditionError: the pairs are not symmetric int8, or there are none.
        FramesError: the range of a tensor is missing.
    """
    draft = draft_of_qdq(model)
    measured = {} if ranges is None else ranges.tensors
    more = {name: max(-low, high) for name, (low, high) in measured.items()}
    return lower(dataclasses.replace(draft, reach={**more, **draft.reach}))


def unranged(model: ir.Model) -> tuple[str, ...]:
    """Name the tensors whose range is needed, and which the graph does not tell.

    They are what convolutions answer where no pair follows: before a residual Add, and
    where a float node reads them.
    """
    draft = draft_of_qdq(model)
    region = find_region(draft.model.graph, draft.weights)
    return tuple(name for name in region.ranged if name not in draft.reach)
