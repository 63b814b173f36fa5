"""Scales of int8 that float16 holds: none becomes 0, or loses its digits."""

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress.graph import array_of, input_at, rewrite
from me2e_compress.targets.quantized import DEQUANTIZE, QUANTIZE, pairs_of
from me2e_compress.targets.weights import requantized, scales_in


def hold_scales(model: ir.Model, narrow: set[ir.Node]) -> None:
    """Raise scales that float16 lacks, and round their stored integers again.

    Given:   y = DequantizeLinear(q, s)              s float32 [channels], some 1e-9
    Result:  y = DequantizeLinear(q', s')            s' at least 6e-8, q' for s'

    A channel whose weights are nearly 0 has such scales; TensorRT takes none of 0. Both
    nodes of a pair get the same ones, if one of them is ``narrow``. Nodes are changed
    in place; scales that float16 holds stay as they are.
    """
    names = rewrite.value_names(model.graph)
    fresh: dict[ir.Value, ir.Value] = {}
    for node in list(pairs_of(model)):
        scale, stored = node.inputs[1], array_of(node.inputs[1])
        if scale is None or stored is None or stored.dtype != np.float32:
            continue
        exact = stored.astype(np.float32)
        if narrow.isdisjoint((node, *_partners(node))):
            continue
        raised = scales_in(exact, np.float16).astype(np.float32)
        # Rounding to 11 bits moves no integer
        few = exact < np.finfo(np.float16).smallest_normal
        raised = np.where(few & (exact > 0), raised, exact)
        if np.array_equal(raised, exact):
            continue
        if scale not in fresh:
            fresh[scale] = rewrite.add_constant(
                model.graph, raised, f"{scale.name}_held", names
            )
        _round_again(model.graph, node, exact, raised, names)
        node.replace_input_with(1, fresh[scale])
    rewrite.sweep(model)


def _partners(node: ir.Node) -> list[ir.Node]:
    """Return the other nodes of a pair."""
    if node.op_type == QUANTIZE:
        readers = node.outputs[0].consumers()
        return [each for each in readers if each.op_type == DEQUANTIZE]
    maker = None if node.inputs[0] is None else node.inputs[0].producer()
    return [] if maker is None else [maker]


def _round_again(
    where: ir.Graph,
    node: ir.Node,
    exact: npt.NDArray[np.float32],
    raised: npt.NDArray[np.float32],
    names: set[str],
) -> None:
    """Round the integers that a DequantizeLinear reads, if they are stored."""
    stored = array_of(node.inputs[0])
    if node.op_type != DEQUANTIZE or stored is None or node.inputs[0] is None:
        return
    axis = node.attributes.get_int("axis", 1) if exact.size > 1 else None
    zero = array_of(input_at(node, 2))
    integers = requantized(stored, exact, raised, axis, zero)
    name = f"{node.inputs[0].name}_held"
    node.replace_input_with(0, rewrite.add_constant(where, integers, name, names))
