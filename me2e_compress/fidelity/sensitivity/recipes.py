"""Choose what stays float, and write the choice as a recipe."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from me2e_compress.fidelity.sensitivity.analysis import Sensitivity
from me2e_compress.fidelity.sensitivity.trials import Int8Choice, Trials
from me2e_compress.quantization.plan.overrides import overrides_text
from me2e_compress.registry import drafts, marks
from me2e_compress.registry.documents import toml_string
from me2e_compress.runtime.atomic import write_bytes


def advise(trials: Trials, found: Sensitivity, limit: float) -> Int8Choice:
    """Choose what keeps the loss within a limit, with as little in float as possible.

    It starts with all modules in int8. Until the measured loss is within the limit, the
    costliest module first gives up the blamed nodes, the worst first, then all of its
    nodes. Then each that was given up, the last first, returns to int8 if the loss
    stays within the limit: errors may cancel, or one costly node hide behind another.
    The choice has no module if nothing keeps the limit.
    """

    def fits(given: Sequence[_Sacrifice]) -> bool:
        choice = _without(trials, found, given)
        return not choice.modules or trials.score(choice).loss <= limit

    # give up nodes and modules until the limit is kept
    order, given = _sacrifices(found), list[_Sacrifice]()
    while not fits(given):
        given.append(order[len(given)])
    # take back what turns out not to matter
    for each in reversed(given):
        kept = [other for other in given if other is not each]
        if each.loss <= limit and fits(kept):
            given = kept
    return _without(trials, found, given)


@dataclasses.dataclass(frozen=True, eq=False)
class _Sacrifice:
    """Nodes of a module, or all of it (None), with their loss as the only int8."""

    module: str
    nodes: tuple[str, ...] | None
    loss: float


def _sacrifices(found: Sensitivity) -> list[_Sacrifice]:
    """List everything in the order in which it is given up."""
    order = []
    for each in found.findings:
        name, own = each.module, each.score.loss
        order += [_Sacrifice(name, (node,), loss) for node, loss in each.blamed]
        order.append(_Sacrifice(name, None, own))
    return order


def _without(
    trials: Trials, found: Sensitivity, given: Sequence[_Sacrifice]
) -> Int8Choice:
    """Return the choice of all modules but what was given up."""
    gone = {each.module for each in given if each.nodes is None}
    names = dict[str, list[str]]()
    for each in given:
        if each.module not in gone:
            names.setdefault(each.module, []).extend(each.nodes or ())
    # A module that gave up each of its nodes is given up.
    gone |= {
        each.module
        for each in found.findings
        if len(set(names.get(each.module, ()))) >= each.nodes
    }
    left = {each.module for each in found.findings} - gone
    floats = [name for module in names if module in left for name in names[module]]
    modules = (name for name in trials.modules.names() if name in left)
    return Int8Choice(tuple(modules), tuple(floats))


def write_recipe(
    path: Path,
    choice: Int8Choice,
    passes: Sequence[str],
    rules: str,
    target: str,
) -> Path | None:
    """Write a recipe and, if nodes stay float, the overrides beside it.

    ``passes`` are the names of those before int8. Returns the file of overrides, None
    if none is needed.
    """
    # the exact passes, then int8
    lines = [f"[[pass]]\nname = {toml_string(name)}\n" for name in passes]
    overrides = path.with_name(path.stem + ".overrides.toml")
    if choice.modules:
        options = [
            "[[pass]]",
            'name = "quantize-int8"',
            f"modules = {_array(choice.modules)}",
            f"rules = {toml_string(rules)}",
            f"target = {toml_string(target)}",
        ]
        if choice.floats:
            options.append(f"overrides = {toml_string(overrides.name)}")
        lines.append("\n".join(options) + "\n")
    # recipe and overrides together, or neither
    with drafts.all_or_none():
        write_bytes(path, (marks.IN_TOML + "\n".join(lines)).encode())
        if not choice.floats or not choice.modules:
            return None
        text = marks.IN_TOML + overrides_text(choice.overrides().override)
        write_bytes(overrides, text.encode())
    return overrides


def _array(names: tuple[str, ...]) -> str:
    return f"[{', '.join(toml_string(name) for name in names)}]"
