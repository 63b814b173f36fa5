"""Check that a graph is valid: what a file holds, and what passes made of it.

:func:`check_file` is the one defence against malformed files: it runs on the message
that was read, before anything else does. Shape inference, cloning and passes rely on
what is checked there, and check nothing again. ONNX's own checker, which
:func:`refusal` asks, knows neither plugins in the default domain nor weights on disk.
"""

import contextlib
import functools
import graphlib
import math
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence

import onnx
import onnx_ir as ir
from google.protobuf.message import Message
from onnx import TensorProto
from onnx.onnx_cpp2py_export.checker import CheckerContext

from me2e_compress.base.display import error_line
from me2e_compress.base.errors import GraphError
from me2e_compress.graph.nodes import STANDARD, is_plugin, is_standard, nodes_of
from me2e_compress.graph.shapes import without_weights

# Where plugins of the default domain live in our graphs: checker and functions need a
# domain
PLUGIN_DOMAIN = "me2e.plugin"

# Node metadata with the domain that a plugin had in the file it came from
ORIGINAL_DOMAIN = "me2e.domain"

# The first ONNX IR version whose initializers need not be inputs (onnx/docs/IR.md)
PLAIN_INITIALIZERS_SINCE_IR = 4

# Limits of what a file may claim; no memory holds a tensor of more elements
LARGEST_VERSION = 2**31 - 1
LARGEST_ELEMENTS = 2**40
HIGHEST_RANK = 64
# Calls of functions in functions: what walks through them goes as deep
DEEPEST_CALLS = 32
# Nodes of a graph in which every call stands for what its function holds: ONNX's
# inference goes through all of them
MOST_CALLED_NODES = 1_000_000

_ELEMENT_TYPES = frozenset(TensorProto.DataType.values()) - {TensorProto.UNDEFINED}
_ATTRIBUTE_TYPES = frozenset(onnx.AttributeProto.AttributeType.values()) - {0}
# The field of an attribute that has no value of its own where it is left out
_CONTENT_FIELD = {onnx.AttributeProto.TENSOR: "t", onnx.AttributeProto.GRAPH: "g"}

Names = Collection[str]


def check_file(model: onnx.ModelProto) -> bool:
    """Check a model as it was read, without its weights on disk.

    Returns whether every node comes after the makers of its inputs; if not, the nodes
    must be sorted, which finds cycles. A GraphError names what is missing, doubled,
    unknown or of another kind, without the file.
    """
    # Versions
    if not model.opset_import:
        raise GraphError("not an ONNX model (no opset)")
    if not 1 <= model.ir_version <= LARGEST_VERSION:
        raise GraphError(f"IR version {model.ir_version} is none")
    for imports in (model.opset_import, *(f.opset_import for f in model.functions)):
        for entry in imports:
            if not 1 <= entry.version <= LARGEST_VERSION:
                domain = entry.domain or "ai.onnx"
                raise GraphError(f"opset {entry.version} of {domain}")
        if len({entry.domain for entry in imports}) < len(imports):
            raise GraphError("two opsets of one domain")
    if not model.graph.output:
        raise GraphError("not an ONNX model (no outputs)")
    _check_text(model)
    functions = {(f.domain, f.name, f.overload): f for f in model.functions}
    if len(functions) < len(model.functions):
        raise GraphError("two of its functions have one name")
    _check_calls(model.graph, functions)
    # Inputs of the graph have types, other values may
    initializers = {tensor.name for tensor in model.graph.initializer}
    for port in model.graph.input:
        if port.name not in initializers:
            _check_type(port, required=True)
    for port in (*model.graph.output, *model.graph.value_info):
        _check_type(port, required=False)
    # Nodes of the graph, of its bodies and of the functions
    versions = {entry.domain: entry.version for entry in model.opset_import}
    checker = _NodeChecker(versions, functions)
    checker.check_graph("graph", model.graph, frozenset())
    for function in model.functions:
        checker.check_function(function)
    return checker.in_order


def _check_text(message: Message) -> None:
    """Refuse texts that are not UTF-8: protobuf hands them out as bytes."""
    for field, value in message.ListFields():
        if field.type not in (field.TYPE_STRING, field.TYPE_MESSAGE):
            continue
        for item in value if field.is_repeated else (value,):
            if field.type == field.TYPE_MESSAGE:
                _check_text(item)
            elif type(item) is not str:
                where = f"{message.DESCRIPTOR.name}: {field.name}"
                raise GraphError(f"{where} {item!r} is not UTF-8")


def _check_type(port: onnx.ValueInfoProto, *, required: bool) -> None:
    """Check a type: a size below 0 becomes open, an undefined type is removed."""
    kind, about = port.type.WhichOneof("value"), port.type.tensor_type
    # Only tensors, sequences and optionals are supported
    if kind in ("map_type", "sparse_tensor_type") or (kind is None and required):
        raise GraphError(
            f"{port.name!r} is not a tensor: its type is {kind or 'missing'}"
        )
    if kind != "tensor_type":
        return
    if about.elem_type not in _ELEMENT_TYPES:
        if required or about.elem_type != TensorProto.UNDEFINED:
            raise GraphError(
                f"{port.name!r} is of element type {about.elem_type}, which is none"
            )
        port.ClearField("type")
        return
    if len(about.shape.dim) > HIGHEST_RANK:
        raise GraphError(f"{port.name!r} has {len(about.shape.dim)} dimensions")
    for dim in about.shape.dim:
        if dim.dim_value < 0:
            dim.ClearField("dim_value")
        elif dim.dim_value > LARGEST_ELEMENTS:
            raise GraphError(f"{port.name!r} has a dimension of {dim.dim_value}")


def _check_tensor(tensor: TensorProto, what: str) -> None:
    """Check that a tensor has a known type, and as many elements as its shape says."""
    kind, count = tensor.data_type, math.prod(tensor.dims)
    if kind not in _ELEMENT_TYPES:
        raise GraphError(f"{what} is of element type {kind}, which is none")
    if len(tensor.dims) > HIGHEST_RANK or any(dim < 0 for dim in tensor.dims):
        raise GraphError(f"{what} has shape {list(tensor.dims)[:70]}")
    if count > LARGEST_ELEMENTS:
        raise GraphError(f"{what} has shape {list(tensor.dims)}: too many elements")
    if tensor.data_location == TensorProto.EXTERNAL:
        return
    # Elements stand one by one in a field of their type, or as bytes, of which onnx-ir
    # takes too few where elements share one
    try:
        stored = ir.serde.deserialize_tensor(tensor)
        stored.numpy()
    except (ir.serde.SerdeError, ValueError, TypeError) as error:
        line = error_line(error)
        raise GraphError(f"{what} has shape {list(tensor.dims)}: {line}") from error
    if tensor.raw_data and len(tensor.raw_data) != stored.nbytes:
        length = len(tensor.raw_data)
        raise GraphError(f"{what} has {length} bytes, its shape says {stored.nbytes}")


Function = tuple[str, str, str]


def _check_calls(
    graph: onnx.GraphProto, functions: Mapping[Function, onnx.FunctionProto]
) -> None:
    """Refuse functions that cannot be inlined: in a circle, too deep or too many."""

    def size(nodes: Iterable[onnx.NodeProto]) -> int:
        return sum(sizes.get(_called_key(node), 1) for node in _all_nodes(nodes))

    sizes, depths = dict[Function, int](), dict[Function, int]()
    calls = {
        key: functions.keys() & set(map(_called_key, _all_nodes(function.node)))
        for key, function in functions.items()
    }
    try:
        # Those that are called come first
        for key in graphlib.TopologicalSorter(calls).static_order():
            sizes[key] = size(functions[key].node)
            depths[key] = max((depths[called] + 1 for called in calls[key]), default=0)
    except graphlib.CycleError as error:
        name = min(error.args[1])[1]
        raise GraphError(
            f"function {name} calls itself, at once or over others"
        ) from error
    if max(depths.values(), default=0) > DEEPEST_CALLS:
        raise GraphError(f"functions call each other more than {DEEPEST_CALLS} deep")
    if (nodes := size(graph.node)) > MOST_CALLED_NODES:
        raise GraphError(
            f"its functions make {nodes:,} nodes of it, {MOST_CALLED_NODES:,} at most"
            " are read"
        )


class _NodeChecker:
    """Checks the nodes of a model or function, with the names visible to each.

    ``in_order`` tells whether every node comes after the makers of its inputs.
    """

    def __init__(
        self,
        versions: Mapping[str, int],
        functions: Mapping[Function, onnx.FunctionProto],
        in_function: bool = False,
    ) -> None:
        self.versions, self.functions = versions, functions
        self.in_function, self.in_order = in_function, True
        self.opset = versions.get("", versions.get("ai.onnx", 0))

    def check_function(self, function: onnx.FunctionProto) -> None:
        """Check a function of the model."""
        where = f"function {function.name}"
        if not function.name or not function.output or not function.node:
            raise GraphError(f"{where} has no name, no output or no node")
        _check_unique(f"{where}: input", function.input)
        own_versions = {entry.domain: entry.version for entry in function.opset_import}
        checker = _NodeChecker(
            {**self.versions, **own_versions}, self.functions, in_function=True
        )
        known = checker._check_nodes(where, function.node, function.input, frozenset())
        _check_made(f"{where}: output", function.output, known)
        self.in_order = self.in_order and checker.in_order

    def check_graph(self, where: str, graph: onnx.GraphProto, outside: Names) -> None:
        """Check a graph that can read the names ``outside``, of graphs around it."""
        if graph.sparse_initializer:
            name = graph.sparse_initializer[0].values.name
            raise GraphError(f"initializer {name!r} is sparse: write it as a dense one")
        initializers = [tensor.name for tensor in graph.initializer]
        inputs = [port.name for port in graph.input]
        outputs = [port.name for port in graph.output]
        _check_unique(f"{where}: input", inputs)
        _check_unique(f"{where}: initializer", initializers)
        for tensor in graph.initializer:
            _check_tensor(tensor, f"initializer {tensor.name!r}")
        start = tuple(dict.fromkeys((*inputs, *initializers)))
        known = self._check_nodes(where, graph.node, start, outside)
        _check_unique(f"{where}: output", outputs)
        _check_made(f"{where}: output", outputs, known)

    def _check_nodes(
        self,
        where: str,
        nodes: Sequence[onnx.NodeProto],
        start: Sequence[str],
        outside: Names,
    ) -> Names:
        """Check nodes; return the names of their graph, ``start`` among them."""
        # Every name is made once
        makers = dict.fromkeys(start, "an input or initializer")
        for node in nodes:
            label = node.name or f"of {node.op_type}"
            if not node.op_type or not any(node.output):
                raise GraphError(
                    f"{where}: node {label!r} has no operator or no output"
                )
            for name in filter(None, node.output):
                if name in makers:
                    raise GraphError(
                        f"{where}: {name!r} is made twice: by node {label!r} and by"
                        f" {makers[name]}"
                    )
                makers[name] = f"node {label!r}"
        # And read by nodes of this graph, or of graphs within it, alone
        reachable = makers.keys() | outside
        before = {*start, *outside}
        for node in nodes:
            for name in filter(None, node.input):
                if name not in reachable:
                    raise GraphError(
                        f"node {node.name!r} reads {name!r}, which nothing makes"
                    )
                self.in_order = self.in_order and name in before
            self._check_node(node, reachable)
            before.update(node.output)
        return makers.keys()

    def _check_node(self, node: onnx.NodeProto, reachable: Names) -> None:
        """Check attributes, signature, tensors and bodies of a node."""
        _check_attributes(node, in_function=self.in_function)
        # The signature: of the operator, or of the function that is called
        called = self.functions.get(_called_key(node))
        if called is None:
            _check_signature(node, self.opset)
        elif len(node.input) > len(called.input):
            most = len(called.input)
            raise GraphError(f"{_label(node)} has more than {most} inputs")
        elif len(node.output) > len(called.output):
            most = len(called.output)
            raise GraphError(f"{_label(node)} has more than {most} outputs")
        for attribute in node.attribute:
            tensors = (attribute.t,) if attribute.HasField("t") else ()
            for tensor in (*tensors, *attribute.tensors):
                _check_tensor(tensor, f"the tensor of node {node.name!r}")
            for body in _bodies_of(attribute):
                self.check_graph(f"graph {body.name!r}", body, reachable)


def _check_attributes(node: onnx.NodeProto, *, in_function: bool) -> None:
    """Check that each attribute has a name and a value, or refers to a function's."""
    _check_unique(f"{_label(node)}: attribute", (a.name for a in node.attribute))
    for attribute in node.attribute:
        where = f"{_label(node)}: attribute {attribute.name}"
        field = _CONTENT_FIELD.get(attribute.type)
        if attribute.ref_attr_name:
            if not in_function:
                raise GraphError(
                    f"{where} refers to one of a function, and stands in none"
                )
        elif attribute.type not in _ATTRIBUTE_TYPES:
            raise GraphError(f"{where} is of no known type")
        elif field is not None and not attribute.HasField(field):
            raise GraphError(f"{where} has no value")


def _check_signature(node: onnx.NodeProto, version: int) -> None:
    """Check a standard node against its operator's schema, by ONNX's checker."""
    # Unknown operators, as plugins are, and deprecated ones are not checked: runtimes
    # may have them
    if node.domain not in STANDARD or not onnx.defs.has(node.op_type, version, ""):
        return
    if onnx.defs.get_schema(node.op_type, version, "").deprecated:
        return
    try:
        onnx.checker.check_node(_without_contents(node), _context(version))
    except onnx.checker.ValidationError as error:
        reason = " ".join(str(error).split("==> Context")[0].split())
        raise GraphError(f"{_label(node)}: {reason}") from error
    # A permutation that is none crashes what follows it
    for attribute in node.attribute if node.op_type == "Transpose" else ():
        order = list(attribute.ints)
        if attribute.name == "perm" and sorted(order) != list(range(len(order))):
            raise GraphError(f"{_label(node)}: perm {order} is none")


@functools.cache
def _context(version: int) -> CheckerContext:
    context = CheckerContext()
    context.ir_version, context.opset_imports = onnx.IR_VERSION, {"": version}
    return context


def _without_contents(node: onnx.NodeProto) -> onnx.NodeProto:
    """Return a node with empty tensors and graphs, which are checked separately."""
    types = {attribute.type for attribute in node.attribute}
    if not node.domain and _CONTENT_FIELD.keys().isdisjoint(types):
        return node
    bare = onnx.NodeProto(
        name=node.name, op_type=node.op_type, input=node.input, output=node.output
    )
    for attribute in node.attribute:
        if attribute.type not in _CONTENT_FIELD or attribute.ref_attr_name:
            bare.attribute.append(attribute)
            continue
        empty = bare.attribute.add(name=attribute.name, type=attribute.type)
        if attribute.type == onnx.AttributeProto.TENSOR:
            empty.t.CopyFrom(TensorProto(data_type=TensorProto.FLOAT, dims=[0]))
        else:
            empty.g.name = "body"
    return bare


def _label(node: onnx.NodeProto) -> str:
    return f"node {node.name!r} ({node.op_type})"


def _called_key(node: onnx.NodeProto) -> Function:
    return node.domain, node.op_type, node.overload


def _bodies_of(attribute: onnx.AttributeProto) -> Sequence[onnx.GraphProto]:
    return (attribute.g,) if attribute.HasField("g") else attribute.graphs


def _all_nodes(nodes: Iterable[onnx.NodeProto]) -> Iterator[onnx.NodeProto]:
    for node in nodes:
        yield node
        for attribute in node.attribute:
            for body in _bodies_of(attribute):
                yield from _all_nodes(body.node)


def _check_unique(what: str, names: Iterable[str]) -> None:
    counts = Counter(names)
    if "" in counts:
        raise GraphError(f"{what} without a name")
    if doubled := [name for name, count in counts.items() if count > 1]:
        raise GraphError(f"{what} {doubled[0]!r} is there twice")


def _check_made(what: str, names: Iterable[str], known: Names) -> None:
    for name in names:
        if name not in known:
            raise GraphError(f"{what} {name!r}: nothing makes it")


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
    """Give outputs without a shape an empty one while the checker runs."""
    kinds = [value.type for value in written.graph.output]
    tensors = [kind.tensor_type for kind in kinds if kind.HasField("tensor_type")]
    bare = [tensor for tensor in tensors if not tensor.HasField("shape")]
    for tensor in bare:
        tensor.shape.SetInParent()
    # The IR version becomes 4 at least: before, every initializer had to be an input
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
