"""The provenance of a node: its module, its source nodes, and the passes that made it.

It is stored in the node's ONNX metadata, so that it survives every tool that keeps
metadata. In a file, origins that differ from the node's name are stored compressed in
the model's metadata, a module that all nodes share once, and passes not at all. The
manager refuses a pass that loses it.
"""

import base64
import contextlib
import dataclasses
import json
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator

import onnx_ir as ir

from me2e_compress.base.documents import MalformedError
from me2e_compress.base.errors import GraphError
from me2e_compress.graph.nodes import nodes_in, nodes_of

MODULE, ORIGINS, PASSES = "me2e.module", "me2e.origins", "me2e.passes"
_TRACE = "stack_trace"
# Most bytes of a text that was compressed
_LARGEST = 1 << 28


@dataclasses.dataclass(frozen=True)
class Provenance:
    """The provenance of a node.

    Attributes:
        module: the ME2E module it belongs to, e.g. ``bev_encoder``.
        origins: names of the nodes of the source file it stands for.
        passes: names of the passes that made it, in order; empty if untouched.
    """

    module: str
    origins: tuple[str, ...]
    passes: tuple[str, ...] = ()


def read(node: ir.Node) -> Provenance | None:
    """Read a node's provenance, if it has any; a GraphError of malformed metadata."""
    data = node.metadata_props
    if MODULE not in data or ORIGINS not in data:
        return None
    return Provenance(data[MODULE], _names(node, ORIGINS), _names(node, PASSES))


def _names(node: ir.Node, key: str) -> tuple[str, ...]:
    text = node.metadata_props.get(key, "[]")
    try:
        names = json.loads(text)
    except (ValueError, RecursionError):
        names = None
    if not isinstance(names, list) or not all(type(name) is str for name in names):
        raise GraphError(
            f"node {node.name}: its metadata {key} is {text[:40]!r}, not a name list"
        )
    return tuple(names)


def module_of(node: ir.Node) -> str:
    """Return the module that a node belongs to; empty if that is not known."""
    return node.metadata_props.get(MODULE, "")


def stamp(node: ir.Node, past: Provenance) -> None:
    """Write a node's provenance."""
    node.metadata_props[MODULE] = past.module
    node.metadata_props[ORIGINS] = json.dumps(past.origins)
    if past.passes:
        node.metadata_props[PASSES] = json.dumps(past.passes)


def inherit(node: ir.Node, sources: Iterable[ir.Node], *, by: str) -> None:
    """Write the provenance of a new or changed node: that of the nodes it replaces."""
    pasts = [past for source in sources if (past := read(source)) is not None]
    if not pasts:
        return
    # Origins are united in order; the module is that of the first source
    origins = dict.fromkeys(name for past in pasts for name in past.origins)
    passes = dict.fromkeys(name for past in pasts for name in past.passes)
    passes[by] = None
    stamp(node, Provenance(pasts[0].module, tuple(origins), tuple(passes)))


def drop_traces(model: ir.Model) -> None:
    """Drop an exporter's stack traces: paths of its machine, often half of a file."""
    for node in nodes_of(model):
        node.doc_string = None
        for key in [key for key in node.metadata_props if key.endswith(_TRACE)]:
            del node.metadata_props[key]


def missing(model: ir.Model) -> list[str]:
    """List the nodes of the main graph without provenance."""
    return [
        node.name or node.op_type
        for node in nodes_in(model.graph)
        if MODULE not in node.metadata_props or ORIGINS not in node.metadata_props
    ]


def sign(before: ir.Model, after: ir.Model, by: str) -> None:
    """Add a pass's name to every node that it made or changed, where it is missing."""
    for node in _unsigned(before, after, by):
        inherit(node, [node], by=by)


def unstamped(before: ir.Model, after: ir.Model, by: str) -> list[str]:
    """List the nodes that a pass made or changed without adding its name."""
    # A node is changed if its operator or an attribute differs, but not if it only
    # reads another value
    if missing(before):
        return []
    return [node.name or node.op_type for node in _unsigned(before, after, by)]


def foreign(before: ir.Model, after: ir.Model) -> list[str]:
    """List the nodes whose origins the graph before, if it had any, did not have."""
    if missing(before):
        return []
    texts = {node.metadata_props[ORIGINS] for node in nodes_in(before.graph)}
    names = {name for node in nodes_in(before.graph) for name in _names(node, ORIGINS)}
    return [
        node.name or node.op_type
        for node in nodes_in(after.graph)
        if node.metadata_props[ORIGINS] not in texts
        and not names.issuperset(_names(node, ORIGINS))
    ]


def _unsigned(before: ir.Model, after: ir.Model, by: str) -> list[ir.Node]:
    known: dict[str | None, ir.Node] = {}
    for node in nodes_in(before.graph):
        known.setdefault(node.name, node)  # of two with one name, the first counts
    # A node that names the pass, or is as it was
    return [
        node
        for node in nodes_in(after.graph)
        if f'"{by}"' not in node.metadata_props.get(PASSES, "")
        and not is_same(known.get(node.name), node)
    ]


def is_same(old: ir.Node | None, new: ir.Node) -> bool:
    """Return whether two nodes compute the same from their inputs."""
    if old is None or (old.domain, old.op_type) != (new.domain, new.op_type):
        return False
    if list(old.attributes) != list(new.attributes):
        return False
    pairs = zip(old.attributes.values(), new.attributes.values(), strict=True)
    return all(a is b or a.type in _BODIES or repr(a) == repr(b) for a, b in pairs)


# Types of attributes whose nodes are compared one by one
_BODIES = (ir.AttributeType.GRAPH, ir.AttributeType.GRAPHS)


def compressed(text: str) -> str:
    """Write a long text as metadata of a model: zlib, in base 64."""
    return base64.b64encode(zlib.compress(text.encode())).decode()


def decompressed(text: str) -> str:
    """Read a text of :func:`compressed`, or JSON; a MalformedError of anything else."""
    if text[:1] in ("", "[", "{"):
        return text
    reader = zlib.decompressobj()
    try:
        raw = reader.decompress(base64.b64decode(text, validate=True), _LARGEST)
    except (ValueError, zlib.error) as error:
        raise MalformedError(f"{text[:40]!r} is not a compressed text") from error
    if not reader.eof:
        raise MalformedError(f"{text[:40]!r} is cut short, or too long")
    return raw.decode()


@contextlib.contextmanager
def packed(model: ir.Model) -> Iterator[None]:
    """Move origins from the nodes into one text while a model is written."""
    # Nodes that share a name keep what they have
    nodes = [node for node in nodes_in(model.graph) if ORIGINS in node.metadata_props]
    times = Counter(node.name for node in nodes)
    before = [(node, dict(node.metadata_props)) for node in nodes]
    # A module that all nodes share is written once, by the name ""
    modules = {props.get(MODULE, "") for _, props in before}
    table = {"": min(modules)} if len(modules) == 1 else {}
    moved = (PASSES, MODULE) if table else (PASSES,)
    # Left out are origins that are a node's own name, and passes
    for node in nodes:
        if node.name and times[node.name] == 1:
            origins = node.metadata_props.pop(ORIGINS)
            if origins != json.dumps([node.name]):
                table[node.name] = origins
            for key in moved:
                node.metadata_props.pop(key, None)
    if table:
        text = json.dumps(table, separators=(",", ":"))
        model.metadata_props[ORIGINS] = min(compressed(text), text, key=len)
    try:
        yield
    finally:
        model.metadata_props.pop(ORIGINS, None)
        for node, props in before:
            node.metadata_props.clear()
            node.metadata_props.update(props)


def unpack(model: ir.Model) -> None:
    """Give nodes their modules and origins again; a GraphError of malformed ones."""
    text = model.metadata_props.pop(ORIGINS, "{}")
    try:
        table = dict(json.loads(decompressed(text)))
    except (ValueError, TypeError, RecursionError) as error:
        raise GraphError(f"its metadata {ORIGINS} is not a table of names") from error
    for node in nodes_in(model.graph):
        props = node.metadata_props
        if "" in table:
            props.setdefault(MODULE, str(table[""]))
        if MODULE in props:
            own = json.dumps([node.name])
            props.setdefault(ORIGINS, str(table.get(node.name, own)))
