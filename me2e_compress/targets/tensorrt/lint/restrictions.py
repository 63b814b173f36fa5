"""Restrictions on single operators, as the support matrix of the parser notes them."""

from collections.abc import Callable, Iterator

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.graph import input_at, is_standard, nodes_of, rank_of
from me2e_compress.targets.base import LintFinding, error

MAX_K = 3840
"""Largest K of a TopK."""

_RESIZE_MODES = ("nearest", "linear")
_RESIZE_TRANSFORMS = (
    "half_pixel", "pytorch_half_pixel", "tf_half_pixel_for_nn", "asymmetric",
    "align_corners",
)  # fmt: skip


def restrictions(model: ir.Model) -> Iterator[LintFinding]:
    """Check every node against the restrictions on its operator."""
    for node in nodes_of(model):
        for check in _CHECKS.get(node.op_type, ()) if is_standard(node) else ():
            if objection := check(node):
                yield error("restriction", node, f"{node.op_type}: {objection}")


def _image(node: ir.Node) -> str | None:
    """Check for two or three spatial dimensions."""
    rank = rank_of(node.inputs[0])
    return None if rank in (None, 4, 5) else f"rank {rank}, must be 4 or 5"


def _four(node: ir.Node) -> str | None:
    rank = rank_of(node.inputs[0])
    return None if rank in (None, 4) else f"rank {rank}, must be 4"


def _undilated(node: ir.Node) -> str | None:
    found = node.attributes.get_ints("dilations", ())
    return None if set(found) <= {1} else f"dilations {list(found)}, must be 1"


def _first_output(node: ir.Node) -> str | None:
    extra = [value for value in node.outputs[1:] if value.name]
    return None if not extra else "only the first output is supported"


def _constant(index: int, name: str) -> Callable[[ir.Node], str | None]:
    def check(node: ir.Node) -> str | None:
        value = input_at(node, index)
        if value is None or graph.array_of(value) is not None:
            return None
        return f"{name} is computed, must be a constant"

    return check


def _top_k(node: ir.Node) -> str | None:
    if node.attributes.get_int("sorted", 1) != 1:
        return "sorted must be 1"
    k = graph.array_of(node.inputs[1])
    if k is None or int(k.reshape(-1)[0]) <= MAX_K:
        return None
    return f"K = {int(k.reshape(-1)[0])}, at most {MAX_K}"


def _no_reduction(node: ir.Node) -> str | None:
    found = node.attributes.get_string("reduction", "none")
    return None if found == "none" else f"reduction {found}, must be none"


def _resize(node: ir.Node) -> str | None:
    text = node.attributes.get_string
    mode = text("mode", "nearest")
    if mode not in _RESIZE_MODES:
        return f"mode {mode}, must be {' or '.join(_RESIZE_MODES)}"
    transform = text("coordinate_transformation_mode", "half_pixel")
    if transform not in _RESIZE_TRANSFORMS:
        return f"coordinates {transform}, must be of {', '.join(_RESIZE_TRANSFORMS)}"
    policy = text("keep_aspect_ratio_policy", "stretch")
    if policy != "stretch":
        return f"aspect ratio policy {policy}, must be stretch"
    return "antialias must be 0" if node.attributes.get_int("antialias", 0) else None


def _even_pads(node: ir.Node) -> str | None:
    pads = tuple(node.attributes.get_ints("pads", ()))
    half = len(pads) // 2
    if pads[:half] == pads[half:]:
        return None
    return f"pads {list(pads)} differ between begin and end"


def _no_layout(node: ir.Node) -> str | None:
    return "layout must be 0" if node.attributes.get_int("layout", 0) else None


_CHECKS: dict[str, tuple[Callable[[ir.Node], str | None], ...]] = {
    "AveragePool": (_image, _undilated),
    "Conv": (_image,),
    "ConvTranspose": (_image,),
    "CumSum": (_constant(1, "axis"),),
    "DeformConv": (_even_pads,),
    "GridSample": (_four,),
    "LSTM": (_no_layout,),
    "LayerNormalization": (_first_output,),
    "LpPool": (_undilated,),
    "MaxPool": (_image, _undilated, _first_output),
    "OneHot": (_constant(1, "depth"),),
    "Resize": (_resize,),
    "ScatterElements": (_no_reduction,),
    "ScatterND": (_no_reduction,),
    "Squeeze": (_constant(1, "axes"),),
    "TopK": (_top_k,),
    "Unsqueeze": (_constant(1, "axes"),),
    **{
        f"Reduce{name}": (_constant(1, "axes"),)
        for name in (
            "L1", "L2", "LogSum", "LogSumExp", "Max", "Mean", "Min", "Prod", "Sum",
            "SumSquare",
        )
    },
}  # fmt: skip
