"""Single changes of a source that a test of it should notice."""

import ast
import copy
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

_COMPARISONS: dict[type[ast.cmpop], ast.cmpop] = {
    ast.Lt: ast.LtE(),
    ast.LtE: ast.Lt(),
    ast.Gt: ast.GtE(),
    ast.GtE: ast.Gt(),
    ast.Eq: ast.NotEq(),
    ast.NotEq: ast.Eq(),
    ast.Is: ast.IsNot(),
    ast.IsNot: ast.Is(),
    ast.In: ast.NotIn(),
    ast.NotIn: ast.In(),
}
_NEGATED = (ast.Eq, ast.NotEq, ast.Is, ast.IsNot, ast.In, ast.NotIn)
"""Comparisons that the change above negates."""
_ARITHMETIC: dict[type[ast.operator], ast.operator] = {
    ast.Add: ast.Sub(),
    ast.Sub: ast.Add(),
    ast.Mult: ast.Div(),
    ast.Div: ast.Mult(),
}
_SHOWN = 60
"""Characters of a piece of source in a table."""

Node = ast.expr | ast.stmt


@dataclass(frozen=True)
class Mutation:
    """One change of one file.

    Attributes:
        file: relative to the checkout.
        line: where the change begins.
        begin: first byte that goes.
        end: the first behind what goes.
        old: what goes, on one line.
        new: what stands in its place.
    """

    file: Path
    line: int
    begin: int
    end: int
    old: str
    new: str

    def applied(self, source: bytes) -> bytes:
        """Return the changed source; whatever follows stays on its line."""
        lines = "\n" * source[self.begin : self.end].count(b"\n")
        new = f"({self.new}{lines})" if self.new != "pass" else f"pass{lines}"
        return source[: self.begin] + new.encode() + source[self.end :]

    def __str__(self) -> str:
        """Say where it is, what stood there and what stands there now."""
        old, new = (
            each if len(each) <= _SHOWN else f"{each[: _SHOWN - 3]}..."
            for each in (self.old, self.new)
        )
        return f"{self.file}:{self.line}: {old}  ->  {new}"


def mutations(file: Path, source: bytes) -> list[Mutation]:
    """List every single change of a source, from its first line to its last."""
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    found = []
    for node, new in _changes(ast.parse(source)):
        begin = starts[node.lineno - 1] + node.col_offset
        end = starts[(node.end_lineno or 0) - 1] + (node.end_col_offset or 0)
        old = " ".join(source[begin:end].decode().split())
        found.append(Mutation(file, node.lineno, begin, end, old, new))
    return sorted(found, key=lambda each: (each.begin, each.end, each.new))


def _changes(node: ast.AST) -> Iterator[tuple[Node, str]]:
    """Walk a tree; what tells types, asserts or fills in a message is left alone."""
    if isinstance(node, ast.Assert | ast.JoinedStr):
        return
    if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
        return
    if isinstance(node, ast.expr):
        yield from ((node, ast.unparse(new)) for new in _instead(node))
    elif isinstance(node, ast.stmt) and _goes(node):
        yield node, "pass"
    elif isinstance(node, ast.Return) and isinstance(node.value, ast.Tuple):
        parts = [ast.unparse(each) for each in node.value.elts]
        if len(set(parts[:2])) > 1:
            yield node.value, ", ".join((parts[1], parts[0], *parts[2:]))
    yield from ((test, f"not ({ast.unparse(test)})") for test in _conditions(node))
    for name, value in ast.iter_fields(node):
        if name not in ("annotation", "returns", "type_params", "decorator_list"):
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST):
                    yield from _changes(child)


def _instead(node: ast.expr) -> Iterator[ast.expr]:
    """Give what an expression may become."""
    new = copy.deepcopy(node)
    match new:
        case ast.Compare(ops=[op, *_]):
            new.ops[0] = _COMPARISONS[type(op)]
        case ast.BoolOp():
            new.op = ast.Or() if isinstance(new.op, ast.And) else ast.And()
        case ast.BinOp() if type(new.op) in _ARITHMETIC and not _is_text(new):
            new.op = _ARITHMETIC[type(new.op)]
        case ast.Constant(value=bool(value)):
            new.value = not value
        case ast.Constant(value=int() | float() as number):
            new.value = number + 1 if isinstance(number, int) else 2 * number + 1
        case _:
            return
    yield new


def _is_text(node: ast.BinOp) -> bool:
    """Whether a sum or product is of a text, and could only break."""
    sides = (node.left, node.right)
    return any(
        isinstance(each, ast.JoinedStr)
        or (isinstance(each, ast.Constant) and isinstance(each.value, str))
        for each in sides
    )


def _goes(node: ast.stmt) -> bool:
    """Whether the code around a statement can run without it."""
    if isinstance(node, ast.Assign):
        return all(isinstance(e, ast.Attribute | ast.Subscript) for e in node.targets)
    if isinstance(node, ast.Expr):
        return isinstance(node.value, ast.Call)
    if isinstance(node, ast.Return):
        return node.value is None
    return isinstance(
        node, ast.AugAssign | ast.Break | ast.Continue | ast.Delete | ast.Raise
    )


def _conditions(node: ast.AST) -> Iterator[ast.expr]:
    """Give the conditions that a node asks, but those that a comparison negates."""
    asked = [node.test] if isinstance(node, ast.If | ast.IfExp | ast.While) else []
    if isinstance(node, ast.comprehension):
        asked = node.ifs
    for test in asked:
        if not (isinstance(test, ast.Compare) and isinstance(test.ops[0], _NEGATED)):
            yield test
