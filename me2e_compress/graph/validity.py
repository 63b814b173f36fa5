"""Check a graph with ONNX's own checker."""

import contextlib
from collections.abc import Iterator

import onnx
import onnx_ir as ir

from me2e_compress.graph.nodes import is_plugin, is_standard, nodes_of
from me2e_compress.graph.shapes import without_weights

# Where plugins of the default domain live in our graphs: checker and functions need a
# domain.
PLUGIN_DOMAIN = "me2e.plugin"

# Node metadata with the domain that a plugin had in the file it came from
ORIGINAL_DOMAIN = "me2e.domain"

# The first ONNX IR version whose initializers need not be inputs (onnx/docs/IR.md)
PLAIN_INITIALIZERS_SINCE_IR = 4


def refusal(
    model: ir.Model, *, plugins: bool = False, written: onnx.ModelProto | None = None
) -> str | None:
    """Return why ONNX's checker refuses a graph, in one line; None if it does not.

    Outputs without a shape are accepted: exporters leave out unknown shapes, as behind
    plugins, and every runtime accepts that. With ``plugins``, unknown operators of the
    default domain count as plugins, as in TensorRT. ``written`` is this graph by
    :func:`~me2e_compress.graph.shapes.without_weights`; None writes it.
    """
    try:
        if written is None:
            written = without_weights(_apart(model) if plugins else model)
        with _lenient(written):
            onnx.checker.check_model(written)
    except (onnx.checker.ValidationError, ir.serde.SerdeError) as error:
        reason = str(error.__cause__ or error).strip()
        return reason.splitlines()[0] if reason else type(error).__name__
    return None


@contextlib.contextmanager
def _lenient(written: onnx.ModelProto) -> Iterator[None]:
    """Give outputs without a shape an empty one while the checker runs.

    The IR version becomes 4 at least: before, every initializer had to be an input too.
    """
    kinds = [value.type for value in written.graph.output]
    tensors = [kind.tensor_type for kind in kinds if kind.HasField("tensor_type")]
    bare = [tensor for tensor in tensors if not tensor.HasField("shape")]
    for tensor in bare:
        tensor.shape.SetInParent()
    version = written.ir_version
    written.ir_version = max(version, PLAIN_INITIALIZERS_SINCE_IR)
    try:
        yield
    finally:
        written.ir_version = version
        for tensor in bare:
            tensor.ClearField("shape")


def _apart(model: ir.Model) -> ir.Model:
    """Return a graph whose plugins of the default domain have a domain of their own."""
    if not any(is_standard(node) and is_plugin(node) for node in nodes_of(model)):
        return model
    copy = model.clone()
    for node in nodes_of(copy):
        ours = node.op_identifier() in copy.functions
        if is_standard(node) and is_plugin(node) and not ours:
            node.domain = PLUGIN_DOMAIN
    copy.opset_imports.setdefault(PLUGIN_DOMAIN, 1)
    for function in copy.functions.values():
        function.opset_imports.setdefault(PLUGIN_DOMAIN, 1)
    return copy
