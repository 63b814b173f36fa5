"""Check once, when a file is read, that it is a valid graph.

ONNX's own checker knows neither plugins in the default domain nor weights on disk.
Shape inference, cloning and passes rely on what is checked here, and check nothing
again.
"""

import functools
import itertools
import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence

import onnx
import onnx_ir as ir
from onnx import TensorProto
from onnx.onnx_cpp2py_export.checker import CheckerContext

from me2e_compress.base.errors import GraphError
from me2e_compress.graph.nodes import STANDARD

# Elements of one tensor: no memory holds more.
LARGEST_ELEMENTS = 2**40
HIGHEST_RANK = 64

_TYPES = frozenset(TensorProto.DataType.values()) - {TensorProto.UNDEFINED}
_FIELDS = (
    "float_data", "int32_data", "string_data", "int64_data", "double_data",
    "uint64_data",
)  # fmt: skip


def _check_text(where: str, texts: Iterable[str]) -> None:
    """Refuse names that are not UTF-8: protobuf hands them out as bytes."""
    for text in texts:
        if type(text) is not str:
            raise GraphError(f"{where}: {text!r} is not UTF-8")


def _check_port(port: onnx.ValueInfoProto, *, typed: bool) -> None:
    """Check a type: a size below 0 becomes open, an undefined type is removed.

    ``typed`` ports must have a type, as inputs of a graph must. Only tensors, sequences
    and optionals are supported.
    """
    kind, about = port.type.WhichOneof("value"), port.type.tensor_type
    if kind in ("map_type", "sparse_tensor_type") or (kind is None and typed):
        raise GraphError(
            f"{port.name!r} is not a tensor: its type is {kind or 'missing'}"
        )
    if kind != "tensor_type":
        return
    if about.elem_type not in _TYPES:
        if typed or about.elem_type != TensorProto.UNDEFINED:
            raise GraphError(
                f"{port.name!r} is of element type {about.elem_type}, which is none"
            )
        port.ClearField("type")
        return
    if len(about.shape.dim) > HIGHEST_RANK:
        raise GraphError(f"{port.name!r} has {len(about.shape.dim)} dimensions")
    for dim in about.shape.dim:
        if dim.WhichOneof("value") == "dim_param":
            _check_text(f"{port.name!r}: a dimension", (dim.dim_param,))
        elif dim.dim_value < 0:
            dim.ClearField("dim_value")
        elif dim.dim_value > LARGEST_ELEMENTS:
            raise GraphError(f"{port.name!r} has a dimension of {dim.dim_value}")


def _check_tensor(tensor: TensorProto, what: str) -> None:
    """Check that a tensor has a known type, and as many elements as its shape says."""
    kind, count = tensor.data_type, math.prod(tensor.dims)
    if kind not in _TYPES:
        raise GraphError(f"{what} is of element type {kind}, which is none")
    if len(tensor.dims) > HIGHEST_RANK or any(dim < 0 for dim in tensor.dims):
        raise GraphError(f"{what} has shape {list(tensor.dims)[:70]}")
    if count > LARGEST_ELEMENTS:
        raise GraphError(f"{what} has shape {list(tensor.dims)}: too many elements")
    if tensor.data_location == TensorProto.EXTERNAL:
        return
    filled = [name for name in _FIELDS if getattr(tensor, name)]
    if filled and (len(filled) > 1 or tensor.raw_data):
        raise GraphError(f"{what} holds its data twice")
    bits = ir.DataType(kind).bitwidth if kind != TensorProto.STRING else None
    if bits is not None and not filled:
        wanted, length = -(-count * bits // 8), len(tensor.raw_data)
        if wanted != length:
            raise GraphError(f"{what} has {length} bytes, its shape says {wanted}")
        return
    # The elements stand one by one in a field of their type
    if kind in (TensorProto.COMPLEX64, TensorProto.COMPLEX128):
        count *= 2  # real and imaginary part
    elif bits in (2, 4):
        count = -(-count * bits // 8)  # several in a byte
    length = len(getattr(tensor, onnx.helper.tensor_dtype_to_field(kind)))
    if count != length:
        raise GraphError(f"{what} has {length} values, its shape says {count}")


def _check_signature(node: onnx.NodeProto, version: int) -> None:
    """Check a standard node against its operator's schema, by ONNX's checker.

    Unknown operators, as plugins are, and deprecated ones are not checked: runtimes may
    have them.
    """
    if node.domain not in STANDARD or not onnx.defs.has(node.op_type, version, ""):
        return
    if onnx.defs.get_schema(node.op_type, version, "").deprecated:
        return
    try:
        onnx.checker.check_node(_without_contents(node), _context(version))
    except onnx.checker.ValidationError as error:
        reason = " ".join(str(error).split("==> Context")[0].split())
        raise GraphError(f"{_label(node)}: {reason}") from error
    for each in node.attribute if node.op_type == "Transpose" else ():
        if each.name == "perm" and sorted(each.ints) != list(range(len(each.ints))):
            raise GraphError(f"{_label(node)}: perm {list(each.ints)} is none")


@functools.cache
def _context(version: int) -> CheckerContext:
    context = CheckerContext()
    context.ir_version, context.opset_imports = onnx.IR_VERSION, {"": version}
    return context


def _without_contents(node: onnx.NodeProto) -> onnx.NodeProto:
    """Return a node with empty tensors and graphs, which are checked separately."""
    contents = {onnx.AttributeProto.TENSOR, onnx.AttributeProto.GRAPH}
    if not node.domain and contents.isdisjoint(
        attribute.type for attribute in node.attribute
    ):
        return node
    bare = onnx.NodeProto(
        name=node.name, op_type=node.op_type, input=node.input, output=node.output
    )
    for attribute in node.attribute:
        if attribute.type not in contents or attribute.ref_attr_name:
            bare.attribute.append(attribute)
            continue
        empty = bare.attribute.add(name=attribute.name, type=attribute.type)
        if attribute.type == onnx.AttributeProto.TENSOR:
            empty.t.CopyFrom(TensorProto(data_type=TensorProto.FLOAT, dims=[0]))
        else:
            empty.g.name = "body"
    return bare


def _check_attributes(node: onnx.NodeProto, *, in_function: bool) -> None:
    """Check that each attribute has a name and a value, or refers to a function's."""
    names = set[str]()
    for attribute in node.attribute:
        name, where = attribute.name, f"{_label(node)}: attribute {attribute.name}"
        if type(name) is not str or not name or name in names:
            raise GraphError(f"{_label(node)}: attribute {name!r} twice, or nameless")
        names.add(name)
        field = _FIELD.get(attribute.type)
        if attribute.ref_attr_name:
            if not in_function:
                raise GraphError(
                    f"{where} refers to one of a function, and stands in none"
                )
        elif attribute.type not in _ATTRIBUTE_TYPES:
            raise GraphError(f"{where} is of no known type")
        elif field is not None and not attribute.HasField(field):
            raise GraphError(f"{where} has no value")


_ATTRIBUTE_TYPES = frozenset(onnx.AttributeProto.AttributeType.values()) - {0}
# The field of an attribute that has no value of its own where it is left out
_FIELD = {onnx.AttributeProto.TENSOR: "t", onnx.AttributeProto.GRAPH: "g"}


def _label(node: onnx.NodeProto) -> str:
    return f"node {node.name!r} ({node.op_type})"


LARGEST_VERSION = 2**31 - 1
# Graphs in nodes of graphs: protobuf itself ends at about thirty. Calls of functions in
# functions likewise: what walks through them goes as deep.
DEEPEST = 32
# Nodes of a graph in which every call stands for what its function holds: ONNX's
# inference goes through all of them.
MOST_CALLED_NODES = 1_000_000

Names = Collection[str]


def check(model: onnx.ModelProto) -> bool:
    """Check a model as it was read, without its weights on disk.

    Returns:
        Whether every node comes after the makers of its inputs; if not, the nodes must
        be sorted, which finds cycles.

    Raises:
        GraphError: names what is missing, doubled, unknown or of another kind, without
            the file.
    """
    # Versions
    if not model.opset_import:
        raise GraphError("not an ONNX model (no opset)")
    if not 1 <= model.ir_version <= LARGEST_VERSION:
        raise GraphError(f"IR version {model.ir_version} is none")
    for imports in (model.opset_import, *(f.opset_import for f in model.functions)):
        _check_text("opset", (entry.domain for entry in imports))
        for entry in imports:
            if not 1 <= entry.version <= LARGEST_VERSION:
                raise GraphError(
                    f"opset {entry.version} of {entry.domain or 'ai.onnx'}"
                )
        if len({entry.domain for entry in imports}) < len(imports):
            raise GraphError("two opsets of one domain")
    # What the model says of itself
    if not model.graph.output:
        raise GraphError("not an ONNX model (no outputs)")
    _check_text("metadata", (p for e in model.metadata_props for p in (e.key, e.value)))
    _check_text("model", (model.producer_name, model.doc_string, model.domain))
    # Graph and functions
    functions = {(f.domain, f.name, f.overload): f for f in model.functions}
    if len(functions) < len(model.functions):
        raise GraphError("two of its functions have one name")
    _check_calls(model.graph, functions)
    versions = {imported.domain: imported.version for imported in model.opset_import}
    walk = _Walk(versions, functions)
    walk.check_main_graph(model.graph)
    for function in model.functions:
        walk.check_function(function)
    return walk.in_order


Function = tuple[str, str, str]


def _check_calls(
    graph: onnx.GraphProto, functions: dict[Function, onnx.FunctionProto]
) -> None:
    """Refuse functions that cannot be inlined: in a circle, too deep or too many."""

    def size(nodes: Iterable[onnx.NodeProto]) -> int:
        return sum(sizes.get(_key(node), 1) for node in _all_nodes(nodes))

    sizes: dict[Function, int] = {}
    calls = {
        name: functions.keys() & set(map(_key, _all_nodes(function.node)))
        for name, function in functions.items()
    }
    for depth in itertools.count():
        leaves = [name for name, called in calls.items() if not called & calls.keys()]
        if not leaves:
            break
        if depth > DEEPEST:
            raise GraphError(f"functions call each other more than {DEEPEST} deep")
        for name in leaves:
            del calls[name]
            sizes[name] = size(functions[name].node)
    if calls:
        first = min(calls)[1]
        raise GraphError(f"function {first} calls itself, at once or over others")
    if (nodes := size(graph.node)) > MOST_CALLED_NODES:
        raise GraphError(
            f"its functions make {nodes:,} nodes of it, {MOST_CALLED_NODES:,} at most"
            " are read"
        )


def _key(node: onnx.NodeProto) -> Function:
    return node.domain, node.op_type, node.overload


def _all_nodes(nodes: Iterable[onnx.NodeProto]) -> Iterable[onnx.NodeProto]:
    for node in nodes:
        yield node
        for attribute in node.attribute:
            for body in (attribute.g, *attribute.graphs):
                yield from _all_nodes(body.node)


class _Walk:
    """Checks the graphs of a model or function, with the names visible in each."""

    def __init__(
        self,
        versions: Mapping[str, int],
        functions: Mapping[Function, onnx.FunctionProto],
        in_function: bool = False,
    ) -> None:
        self.versions, self.functions = versions, functions
        self.in_function, self.in_order = in_function, True
        self.opset = versions.get("", versions.get("ai.onnx", 0))

    def check_main_graph(self, body: onnx.GraphProto) -> None:
        """Check the graph of a model, whose inputs must have types."""
        given = {tensor.name for tensor in body.initializer}
        for port in body.input:
            if port.name not in given:
                _check_port(port, typed=True)
        for each in (*body.output, *body.value_info):
            _check_port(each, typed=False)
        self._check_graph(body, frozenset(), 0)

    def check_function(self, function: onnx.FunctionProto) -> None:
        """Check a function."""
        where = f"function {function.name}"
        _check_text("function", (function.name, function.domain, function.doc_string))
        if not function.name or not function.output or not function.node:
            raise GraphError(f"{where} has no name, no output or no node")
        _check_unique(f"{where}: input", function.input)
        local = {
            imported.domain: imported.version for imported in function.opset_import
        }
        inside = _Walk({**self.versions, **local}, self.functions, in_function=True)
        none = frozenset[str]()
        known = inside._check_nodes(where, function.node, function.input, none, 0)
        _check_made(f"{where}: output", function.output, known)
        self.in_order = self.in_order and inside.in_order

    def _check_graph(self, body: onnx.GraphProto, outside: Names, depth: int) -> None:
        """Check a graph that can read the names of the graphs around it."""
        if depth > DEEPEST:
            raise GraphError(f"graphs are nested more than {DEEPEST} deep")
        where = f"graph {body.name!r}" if depth else "graph"
        if body.sparse_initializer:
            name = body.sparse_initializer[0].values.name
            raise GraphError(f"initializer {name!r} is sparse: write it as a dense one")
        _check_text(where, (body.name, body.doc_string))
        names = [tensor.name for tensor in body.initializer]
        ports = [port.name for port in body.input]
        outputs = [port.name for port in body.output]
        _check_unique(f"{where}: input", ports)
        _check_unique(f"{where}: initializer", names)
        for tensor in body.initializer:
            _check_tensor(tensor, f"initializer {tensor.name!r}")
        begin = tuple(dict.fromkeys((*ports, *names)))
        known = self._check_nodes(where, body.node, begin, outside, depth)
        _check_unique(f"{where}: output", outputs)
        _check_made(f"{where}: output", outputs, known)

    def _check_nodes(
        self,
        where: str,
        nodes: Sequence[onnx.NodeProto],
        begin: Sequence[str],
        outside: Names,
        depth: int,
    ) -> Names:
        """Check nodes; return every name that is known after the last."""
        made = dict.fromkeys(begin, "an input or initializer")
        for node in nodes:
            _check_text("node", (node.name, node.op_type, node.domain, node.doc_string))
            label = node.name or f"of {node.op_type}"
            if not node.op_type or not any(node.output):
                raise GraphError(
                    f"{where}: node {label!r} has no operator or no output"
                )
            for name in filter(None, node.output):
                if name in made:
                    raise GraphError(
                        f"{where}: {name!r} is made twice: by node {label!r} and by"
                        f" {made[name]}"
                    )
                made[name] = f"node {label!r}"
        reachable = made.keys() | outside
        before = {*begin, *outside}
        for node in nodes:
            self._check_node(node, reachable, before, depth)
            before.update(node.output)
        return made.keys()

    def _check_node(
        self, node: onnx.NodeProto, reachable: Names, before: Names, depth: int
    ) -> None:
        for name in filter(None, node.input):
            if name not in reachable:
                raise GraphError(
                    f"node {node.name!r} reads {name!r}, which nothing makes"
                )
            self.in_order = self.in_order and name in before
        _check_attributes(node, in_function=self.in_function)
        # By its operator, or the function that it calls
        called = self.functions.get(_key(node))
        if called is None:
            _check_signature(node, self.opset)
        else:
            pairs = (node.input, called.input), (node.output, called.output)
            for what, (given, most) in zip(("inputs", "outputs"), pairs, strict=True):
                if len(given) > len(most):
                    raise GraphError(
                        f"{_label(node)} has {len(given)} {what}, at most {len(most)}"
                        " may be"
                    )
        # Metadata, tensors and bodies
        for entry in node.metadata_props:
            _check_text("metadata of a node", (entry.key, entry.value))
        for attribute in node.attribute:
            tensors = (attribute.t,) if attribute.HasField("t") else ()
            for tensor in (*tensors, *attribute.tensors):
                _check_tensor(tensor, f"the tensor of node {node.name!r}")
            bodies = (attribute.g,) if attribute.HasField("g") else ()
            for body in (*bodies, *attribute.graphs):
                self._check_graph(body, reachable, depth + 1)


def _check_unique(what: str, names: Iterable[str]) -> None:
    listed = list(names)
    _check_text(what, listed)
    if "" in listed:
        raise GraphError(f"{what} without a name")
    if len(set(listed)) < len(listed):
        twice = next(name for name, count in Counter(listed).items() if count > 1)
        raise GraphError(f"{what} {twice!r} is there twice")


def _check_made(what: str, names: Iterable[str], known: Names) -> None:
    for name in names:
        if name not in known:
            raise GraphError(f"{what} {name!r}: nothing makes it")
