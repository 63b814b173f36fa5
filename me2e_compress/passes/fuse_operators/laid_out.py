"""Write the operators that bring views of values to the layout of an operand."""

from collections.abc import Sequence

import onnx_ir as ir

from me2e_compress.operators import FusedCall
from me2e_compress.passes.digits import Digit, Layout, flat, runs, sizes, split_like
from me2e_compress.passes.fuse_operators.operand_sources import scaling
from me2e_compress.passes.fuse_operators.views import View


def laid_out(call: FusedCall, view: View, form: Layout) -> ir.Value:
    """Write the operators from a view to a layout, repeating over missing digits."""
    value, (scale, shift) = view.value, scaling(view)
    if scale != 1.0:
        value = call.add("Mul", [value, call.numbers(scale, value)])
    if shift != 0.0:
        value = call.add("Add", [value, call.numbers(shift, value)])
    # Split digits on both sides so that they match
    have, wanted = flat(view.layout), flat(form)
    have, wanted = split_like(have, wanted), split_like(wanted, have)
    present = tuple(digit for digit in wanted if digit in have)
    shape = sizes(view.layout)
    if present != have:
        # Reorder runs of digits by one Transpose
        pieces, order = runs(have, present)
        value = call.transpose(_shaped(call, value, shape, sizes(tuple(pieces))), order)
        shape = tuple(sizes(tuple(pieces))[place] for place in order)
    if len(present) < len(wanted):
        # Repeat along the missing digits
        ones = [digit.size if digit in have else 1 for digit in wanted]
        value = _shaped(call, value, shape, ones)
        return _expanded(call, value, ones, wanted, form)
    return _shaped(call, value, shape, sizes(form))


def combined(
    call: FusedCall, op_type: str, views: Sequence[View], form: Layout
) -> ir.Value:
    """Write an Add or Mul of views in a layout, each repeated by broadcasting."""
    if len(views) == 1:
        return laid_out(call, views[0], form)
    # Group the digits so that a view has or lacks each group as a whole
    digits = [digit for view in views for digit in flat(view.layout)]
    every = split_like(flat(form), digits)
    have = [set(split_like(flat(view.layout), every)) for view in views]
    groups = _groups(form, digits, have)
    # Combine the views by broadcasting
    value: ir.Value | None = None
    for view, mine in zip(views, have, strict=True):
        own = tuple(run if run[0] in mine else () for run in groups)
        part = laid_out(call, view, own)
        value = part if value is None else call.add(op_type, [value, part])
    assert value is not None
    # Expand along digits that no view has
    found = [run if any(run[0] in each for each in have) else () for run in groups]
    shape = sizes(tuple(found))
    if shape != sizes(tuple(groups)):
        wanted = tuple(digit for run in groups for digit in run)
        ones = [
            digit.size if any(digit in each for each in have) else 1 for digit in wanted
        ]
        value = _shaped(call, value, shape, ones)
        return _expanded(call, value, ones, wanted, form)
    return _shaped(call, value, shape, sizes(form))


def _groups(
    form: Layout, digits: Sequence[Digit], have: Sequence[set[Digit]]
) -> list[tuple[Digit, ...]]:
    """Split each dimension into runs that every view has or lacks as a whole."""
    groups: list[tuple[Digit, ...]] = []
    for dimension in form:
        last: tuple[bool, ...] | None = None
        for digit in split_like(dimension, digits):
            who = tuple(digit in each for each in have)
            if who == last:
                groups[-1] = (*groups[-1], digit)
            else:
                groups.append((digit,))
            last = who
    return groups


def _expanded(
    call: FusedCall,
    value: ir.Value,
    ones: Sequence[int],
    wanted: Sequence[Digit],
    form: Layout,
) -> ir.Value:
    full = [digit.size for digit in wanted]
    value = call.add("Expand", [value, call.integers(full)])
    return _shaped(call, value, full, sizes(form))


def _shaped(
    call: FusedCall, value: ir.Value, have: Sequence[int], wanted: Sequence[int]
) -> ir.Value:
    return value if tuple(have) == tuple(wanted) else call.reshape(value, list(wanted))
