"""From a draft to a graph that onnxruntime runs in int8."""

import onnx_ir as ir

from me2e_compress import rewrite
from me2e_compress.errors import FramesError
from me2e_compress.targets.onnxruntime.draft import Draft
from me2e_compress.targets.onnxruntime.grid import Grid
from me2e_compress.targets.onnxruntime.layer_forms import write_layer
from me2e_compress.targets.onnxruntime.pairs import write_pairs
from me2e_compress.targets.onnxruntime.region import find_region
from me2e_compress.targets.onnxruntime.writer import Writer


def lower(draft: Draft) -> ir.Model:
    """Write the int8 part of a draft into its graph.

    Raises:
        FramesError: the range of a tensor is not known.
    """
    main = draft.model.graph
    region = find_region(main, draft.weights)
    if missing := [name for name in region.ranged if name not in draft.reach]:
        raise FramesError(
            f"{len(missing)} tensors have no range, the first is {missing[0]}:"
            " onnxruntime's convolutions answer uint8, so what they answer is"
            " calibrated too"
        )
    grids = {
        value: Grid.of(origin, draft.reach[str(origin.name)])
        for value, origin in region.grids.items()
    }
    jobs = [
        (layer, draft.weights[str(layer.outputs[0].name)], grids[value].scale)
        for layer, value in region.layers.items()
    ]
    writer = Writer(main)
    write_pairs(writer, region, grids)
    for layer, weight, step in jobs:
        write_layer(writer, layer, weight, step)
    rewrite.sweep(draft.model)
    return draft.model
