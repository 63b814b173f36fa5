"""Convert graphs to an opset in which onnxruntime can run them."""

from pathlib import Path

import onnx
import onnx_ir as ir

from me2e_compress.base.errors import GraphError
from me2e_compress.graph.nodes import bodies, converted_opset, is_standard, opset_of
from me2e_compress.graph.rewrite.raise_opset import OLDEST_OPSET, write_in
from me2e_compress.graph.runtime_operators import (
    ADDED,
    has_operator,
    newest_ir,
    newest_opset,
)

# Key of `model.meta` with what was changed on reading, in words
_CHANGES = "me2e.read_as"

# Key of `model.meta` with IR version and opset of a file that is read as another
_ON_DISK = "me2e.on_disk"

_NO_NEWER = "onnxruntime reads no newer"


def fit_runtime(model: ir.Model, path: Path) -> None:
    """Convert a graph to an opset and IR version in which onnxruntime can run it.

    :func:`read_as` says what changed.

    Raises:
        GraphError: the graph is newer than onnxruntime, and its opset is unknown or an
            operator cannot be written in an older one.
    """
    changes, on_disk = [], (model.ir_version, opset_of(model))
    if model.ir_version > newest_ir():
        version = f"IR version {model.ir_version} became {newest_ir()}"
        changes.append(f"{version}: {_NO_NEWER}")
        model.ir_version = newest_ir()
    if change := _fit_opset(model, path):
        changes.append(change)
    if changes:
        note_change(model, ", ".join(changes))
        model.meta[_ON_DISK] = on_disk


def read_as(model: ir.Model) -> str:
    """Return what was changed when a graph was read, and why; empty if nothing was."""
    return str(model.meta.get(_CHANGES, ""))


def note_change(model: ir.Model, words: str) -> None:
    """Note what was changed when a graph was read."""
    model.meta[_CHANGES] = "; ".join(filter(None, [read_as(model), words]))


def on_disk(model: ir.Model) -> tuple[int, int]:
    """Return IR version and opset of the file that a graph was read from."""
    version, opset = model.meta.get(_ON_DISK, (model.ir_version, opset_of(model)))
    return int(version), int(opset)


def _fit_opset(model: ir.Model, path: Path) -> str:
    """Convert a graph to another opset if it needs one; return what changed and why."""
    opset, newest = max(opset for _, opset in bodies(model)), newest_opset()
    lacking, why = _lacking(model, opset, opset), _NO_NEWER
    if opset <= newest and not lacking:
        return ""
    if opset > (known := onnx.defs.onnx_opset_version()):
        raise GraphError(
            f"{path}: opset {opset}: onnxruntime reads up to {newest}, and onnx"
            f" {onnx.__version__} converts from {known} at most"
        )
    if lacking := lacking or [name for name in ADDED if not has_operator(name, opset)]:
        why = f"onnxruntime has no {' and no '.join(lacking)} in {opset}"
    # The nearest older opset that has all operators (onnxruntime has RoiAlign before
    # 22, RMSNormalization from 23 on), else a newer one
    older = range(min(opset, newest), OLDEST_OPSET - 1, -1)
    nearest = (*older, *range(opset + 1, newest + 1))
    able = [other for other in nearest if not _lacking(model, opset, other)]
    refusals = []
    # Operators that did not change stay; others are converted one by one, so that names
    # and metadata stay
    for wanted in able or ([newest] if opset > newest else []):
        _, refusal = write_in(model, opset, wanted, "load", one_by_one=True)
        if not refusal:
            return f"opset {opset} became {wanted}: {why}"
        refusals.append(refusal)
    if opset <= newest:  # what cannot be run may be looked at
        return ""
    raise GraphError(
        f"{path}: opset {opset}: onnxruntime reads up to {newest}, and {refusals[0]}"
    )


def _lacking(model: ir.Model, before: int, wanted: int) -> list[str]:
    """List the operators that onnxruntime has, but not in the opset ``wanted``."""
    opsets = range(OLDEST_OPSET, newest_opset() + 1)
    used = {
        (node.op_type, converted_opset(opset, before, wanted))
        for body, opset in bodies(model)
        for node in body.all_nodes()
        if is_standard(node)
    }
    return [
        op_type
        for op_type, opset in sorted(used)
        if not has_operator(op_type, opset)
        and any(has_operator(op_type, other) for other in opsets)
    ]
