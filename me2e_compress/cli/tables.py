"""Tables that several commands show."""

from collections.abc import Iterable

from rich.markup import escape
from rich.table import Table

from me2e_compress.cli.console import megabytes, number, table
from me2e_compress.fidelity.compare import Fidelity
from me2e_compress.manager import Step, Verification
from me2e_compress.modules import Item


def steps_table(steps: Iterable[Step]) -> Table:
    """Show pass by pass what changed and what it cost."""
    shown = table(
        "Pass by pass", "pass", "changes", "nodes", "weights MB", "GMACs", "CPU s"
    )
    for step in steps:
        shown.add_row(
            step.name,
            str(step.changes),
            f"{step.before.nodes} → {step.after.nodes}",
            f"{megabytes(step.before.weight_bytes)} →"
            f" {megabytes(step.after.weight_bytes)}",
            _giga(step.after.macs),
            f"{step.seconds:.2f}",
        )
    return shown


def notes(steps: Iterable[Step]) -> str:
    """Give what the passes have to say, a line each."""
    return "\n".join(
        f"[dim]{step.name}: {escape(note)}[/dim]"
        for step in steps
        for note in step.notes
    )


def verification_table(verifications: Iterable[Verification]) -> Table:
    """Show how far exact passes moved the outputs."""
    shown = table(
        "Exact passes, checked by running both graphs",
        "passes",
        "inputs",
        "worst output",
        "max|a-b|/max|a|",
        "allowed",
        left=3,
    )
    for check in verifications:
        names = ", ".join(check.passes)
        if check.skipped is not None:
            shown.add_row(names, f"not measured: {check.skipped}")
            continue
        judged = [name for name in check.errors if name not in check.unsteady]
        for worst in sorted(judged, key=lambda name: -check.errors[name])[:1]:
            error, allowed = check.errors[worst], check.tolerances[worst]
            shown.add_row(names, check.inputs, worst, f"{error:.1e}", f"{allowed:.0e}")
        if check.unsteady:
            shown.add_row(names, check.inputs, ", ".join(check.unsteady), "not judged")
            shown.caption = (
                "not judged: on these inputs rounding alone moves the output as far; "
                "recorded frames (--frames) tell more"
            )
    return shown


def modules_table(before: Iterable[Item], after: Iterable[Item]) -> Table:
    """Show module by module what a graph held and holds."""
    shown = table(
        "Module by module", "module", "nodes", "parameters", "weights MB", "GMACs"
    )
    held = {item.module: item for item in after}
    for item in before:
        now = held.get(item.module)
        shown.add_row(
            item.module,
            f"{item.nodes} → {now.nodes if now else 0}",
            number(item.parameters),
            f"{megabytes(item.weight_bytes)} →"
            f" {megabytes(now.weight_bytes if now else 0)}",
            f"{_giga(item.macs)} → {_giga(now.macs if now else 0)}",
        )
    shown.caption = "before: once imported, its shape arithmetic done"
    shown.caption_justify = "left"
    return shown


def fidelity_table(fidelity: Fidelity) -> Table:
    """Show how close the outputs of two graphs are."""
    shown = table(
        f"Fidelity over {fidelity.frames} frames",
        "output",
        "SQNR dB",
        "max|a-b|/max|a|",
    )
    for item in fidelity.outputs:
        shown.add_row(item.name, f"{item.sqnr_db:.1f}", f"{item.error:.1e}")
    for name in fidelity.missing:
        shown.add_row(name, "removed", "")
    return shown


def plan_line(fidelity: Fidelity) -> str:
    """Say in one line how far the plan moved."""
    if fidelity.plan is None:
        return f"plan displacement: not measured ({fidelity.plan_reason})"
    moved = fidelity.plan
    return (
        f"plan displacement: mean {moved.mean_m:.4f} m, largest {moved.max_m:.4f} m"
        f" over {fidelity.frames} frames"
    )


def _giga(count: int | None) -> str:
    return number(None if count is None else count / 1e9, ".2f")
