"""Dotted paths of nodes and weights, and patterns over them."""

import ast
import dataclasses
import functools
from collections.abc import Callable
from fnmatch import fnmatchcase

import onnx_ir as ir

_SCOPES = "pkg.torch.onnx.name_scopes"
_NAMESPACE = "namespace"


@dataclasses.dataclass(frozen=True)
class PathGlob:
    """A glob over whole components of a dotted path.

    ``pts_bbox_head.transformer.encoder`` matches that path and everything below it;
    ``*`` and ``?`` are wild within a component (``layers.*.norms``, ``pos_mlp*``). A
    pattern that begins with ``*.`` or ``**.`` may match anywhere in the path, not only
    from its root: ``*.cls_branches`` matches ``head.cls_branches.0.weight``. ``**``
    alone matches every path.
    """

    text: str

    @functools.cached_property
    def components(self) -> tuple[str, ...]:
        """The pattern's components, without a leading ``*.``."""
        parts = tuple(self.text.split("."))
        return parts[1:] if self.anywhere else parts

    @functools.cached_property
    def anywhere(self) -> bool:
        """Whether the match may begin below the root."""
        head, dot, _ = self.text.partition(".")
        return head == "**" or (head == "*" and bool(dot))

    @functools.cached_property
    def _is_plain(self) -> bool:
        """Whether it is a literal prefix, the common case, which must be fast."""
        return not self.anywhere and not any(mark in self.text for mark in "*?[")

    def reach(self, path: tuple[str, ...]) -> int | None:
        """Count a path's components up to the end of the deepest match, if any."""
        wanted, count = self.components, len(self.components)
        if self._is_plain:
            return count if path[:count] == wanted else None
        for start in range(len(path) - count if self.anywhere else 0, -1, -1):
            window = path[start : start + count]
            if len(window) == count and all(map(fnmatchcase, window, wanted)):
                return start + count
        return None


def is_malformed(text: str) -> bool:
    """Return whether a text cannot be a pattern: empty, or an empty component."""
    return not text or any(not part for part in text.split("."))


def parameter_path(name: str | None) -> str:
    """Return an initializer's dotted path; empty for names that tools made up.

    The TorchScript exporter's ``onnx::MatMul_123`` and values of nodes
    (``/img_neck/Constant_output_0``) are not parameter names.
    """
    return "" if not name or ":" in name or "/" in name else name


def scope_of(node: ir.Node) -> str:
    """Return the dotted path of the torch module whose forward made a node.

    Read, in this order, from

    1. the dynamo exporter's metadata (``pkg.torch.onnx.name_scopes``: a list of paths,
       each within the one before; or ``namespace``: ``path: class/path: class/...``),
    2. the node's name as the TorchScript exporter writes it:
       ``/img_backbone/layer1/layer1.0/conv1/Conv`` is
       ``img_backbone.layer1.layer1.0.conv1``,
    3. the name of its first output, which tools that rename nodes often keep
       (``/img_neck/Resize_output_0``).

    Empty if there is none: nodes of the outermost forward, or renamed by a tool.
    """
    props = node.metadata_props
    if props:
        # the dynamo exporter's metadata, the node itself left out
        if (scopes := props.get(_SCOPES)) is not None:
            try:
                parsed: object = ast.literal_eval(scopes)
            except (ValueError, SyntaxError):
                parsed = []
            paths = [str(each) for each in parsed] if isinstance(parsed, list) else []
            return _last_path(paths[:-1])
        if (namespace := props.get(_NAMESPACE)) is not None:
            paths = [part.partition(": ")[0] for part in namespace.split("/")]
            return _last_path(paths[:-1])
    # the TorchScript exporter's names
    scope = _from_name(node.name)
    if not scope and node.outputs:
        scope = _from_name(node.outputs[0].name)
    return scope


def leaving(model: ir.Model, holds: Callable[[ir.Node], bool]) -> tuple[ir.Value, ...]:
    """List the values of some nodes that others read or the graph outputs."""
    members = {node: None for node in model.graph if holds(node)}
    return tuple(
        value
        for node in members
        for value in node.outputs
        if value.is_graph_output()
        or any(reader not in members for reader in value.consumers())
    )


def entering(model: ir.Model, holds: Callable[[ir.Node], bool]) -> tuple[ir.Value, ...]:
    """List the values that some nodes read of others or of the inputs, not weights.

    They are in the order in which they are first read.
    """
    members = {node: None for node in model.graph if holds(node)}
    read = dict.fromkeys(value for node in members for value in node.inputs)
    return tuple(
        value
        for value in read
        if value is not None
        and value.producer() not in members
        and (value.producer() is not None or value.is_graph_input())
        and value.const_value is None
    )


def _from_name(name: str | None) -> str:
    if not name or "/" not in name:
        return ""
    parts = [part for part in name.split("/")[:-1] if part]
    return ".".join(parts)


def _last_path(paths: list[str]) -> str:
    return next((path for path in reversed(paths) if path), "")
