"""The last lines of a compression: size, int8, how far outputs and plan moved, time."""

from collections.abc import Iterator

from me2e_compress.fidelity.compare import Fidelity
from me2e_compress.fidelity.floor import Shortfall, shown
from me2e_compress.manager import Report
from me2e_compress.workflows.compress_fidelity import NOT_ASKED, MeasuredLoss
from me2e_compress.workflows.int8_outcome import Int8Outcome
from me2e_compress.workflows.result import Table, counted, megabytes, table

LEAST_SHOWN = 10_000
"""Bytes of float weights from which on a rule is listed."""

LISTED_WEIGHTS = 5
"""Number of float weights that a table shows."""


def verdict(
    report: Report, int8: Int8Outcome | None, loss: MeasuredLoss | None
) -> Iterator[str]:
    """Yield lines on what became int8 and how far the outputs moved."""
    if int8 is not None:
        yield _int8_line(int8)
    yield from _proof(report)
    if loss is None or (loss.fidelity is None and loss.on == NOT_ASKED):
        return
    if loss.fidelity is None:
        yield f"fidelity: not measured ({loss.on})"
    else:
        yield fidelity_line(loss.fidelity, loss)
    if loss.unsteady:
        yield (
            f"not judged: {', '.join(loss.unsteady)}: the graph itself, uncompressed,"
            f" falls to {_figures(loss)} when only its largest input is rounded to"
            " int8; it chooses between near-equal candidates, and the road tells what"
            " that means"
        )


def alerts(int8: Int8Outcome | None, loss: MeasuredLoss | None) -> Iterator[str]:
    """Yield warnings: nothing became int8, or quality is below the floor."""
    if int8 is not None and int8.empty:
        yield int8.empty
    if loss is not None and loss.incomparable:
        yield f"the outputs cannot be compared: {loss.on}"
    if loss is None or not loss.shortfalls:
        return
    yield (
        f"below the floor ({loss.floor}): {', '.join(map(str, loss.shortfalls))};"
        f" lost in {', '.join(loss.guilty)}"
    )
    if loss.remedy is not None:
        yield from _cure(loss)


def _cure(loss: MeasuredLoss) -> Iterator[str]:
    assert loss.remedy is not None
    remedy, worst = loss.remedy, loss.shortfalls[0].output
    runs = f"{counted(remedy.trials, 'variant')} run on {_frames(remedy.fidelity)}"
    # name the nodes to blame, or say that none can be
    found = [
        *map(str, remedy.nodes),
        *(f"many nodes of module {name}" for name in remedy.modules),
    ]
    if not found:
        yield f"no single node or module is to blame ({runs})"
        return
    yield f"lost at {'; '.join(found)}"
    # show the overrides with what they achieve
    after = ", ".join(map(str, remedy.shortfalls)) or _figure(remedy.fidelity, worst)
    left = "" if remedy.cures else ", still below the floor"
    yield f"with --overrides of these lines: {after}{left} ({runs})"
    yield remedy.overrides().rstrip()


def _int8_line(int8: Int8Outcome) -> str:
    said = f"int8: {counted(int8.nodes, 'node')}"
    if int8.float_bytes:
        rules = ", ".join(
            f"{rule} {megabytes(count)}"
            for rule, count in int8.float_bytes.items()
            if count >= LEAST_SHOWN
        )
        total = megabytes(sum(int8.float_bytes.values()))
        said += f"; {total} MB of weights stay float, by rule: {rules}"
    if int8.weight_only_bytes:
        saved = megabytes(int8.weight_only_bytes)
        said += f"; --weight-only-gemv would save {saved} MB"
    return said


def _proof(report: Report) -> Iterator[str]:
    """Say how far exact passes moved the outputs, and what is not proven."""
    judged = [
        (check.errors[name], check.fed)
        for check in report.verifications
        for name in check.judged
    ]
    # with lossy passes in the pipeline, sameness is not the claim
    if judged and not report.lossy:
        worst, inputs = max(judged)
        near = f" to within {worst:.1e} of its largest value" if worst else ""
        yield f"every output is the same{near} ({inputs})"
    if not any(step.changes for step in report.steps):
        yield "every output is the same: no pass changed anything"
    # what could not be proven is said too
    for check in report.verifications:
        if check.unproven is not None:
            yield f"not proven: {', '.join(check.passes)}: {check.unproven}"
        elif check.left_out:
            yield f"not proven of every output: {check.left_out}"
        yield from check.remarks


def fidelity_line(found: Fidelity, loss: MeasuredLoss) -> str:
    """Return how far the plan moved, and which output is the noisiest."""
    where = f"on {_frames(found)} {loss.on}"
    said = []
    if found.plan is not None:
        said.append(
            f"the plan moves {found.plan.mean_m:.3f} m on average,"
            f" {found.plan.max_m:.2f} m at most"
        )
    others = [each for each in found.outputs if each.name != found.plan_output]
    judged = [e for e in others if not e.discrete and e.name not in loss.unsteady]
    if judged:
        worst = min(judged, key=lambda each: each.sqnr_db)
        said.append(
            f"the noisiest output is {worst.name}, {shown(worst.sqnr_db, 'dB')}"
        )
    return f"{'; '.join(said) or 'no output could be judged'} ({where})"


def _figures(loss: MeasuredLoss) -> str:
    found = loss.fidelity
    plan = found.plan_output if found is not None and found.plan is not None else ""
    return ", ".join(
        shown(value, "m" if name == plan else "dB")
        for name, value in loss.unsteady.items()
    )


def _figure(found: Fidelity, output: str) -> str:
    if found.plan is not None and output == found.plan_output:
        return str(Shortfall(output, found.plan.mean_m, "m", 0.0))
    (value,) = (each.sqnr_db for each in found.outputs if each.name == output)
    return str(Shortfall(output, value, "dB", 0.0))


def _frames(found: Fidelity) -> str:
    return f"{found.frames} frame{'s' * (found.frames > 1)}"


def fidelity_table(loss: MeasuredLoss) -> Table | None:
    """Return the SQNR and largest error of every output; None if not measured."""
    found = loss.fidelity
    if found is None:
        return None
    below = {each.output for each in loss.shortfalls}
    rows = [
        (
            each.name,
            f"{each.sqnr_db:z.1f}",
            f"{each.error:.1e}",
            "below" if each.name in below else _judged(each.name, each.discrete, loss),
        )
        for each in found.outputs
    ]
    rows += [(name, "removed", "", "") for name in found.missing]
    title = f"Fidelity on {_frames(found)} {loss.on}"
    return table(title, ("output", "SQNR dB", "max|a-b|/max|a|", "floor"), rows)


def _judged(name: str, discrete: bool, loss: MeasuredLoss) -> str:
    return "not judged" if discrete or name in loss.unsteady else "above"


def weights_table(int8: Int8Outcome) -> Table | None:
    """Return the largest weights that stayed float, and why; None if there are none."""
    if not int8.weights:
        return None
    return table(
        "Largest weights that stay float",
        ("weight", "read by", "rule", "MB"),
        [
            (each.name, each.op, f"{each.rule}: {each.reason}", megabytes(each.bytes))
            for each in int8.weights[:LISTED_WEIGHTS]
        ],
        words=3,
    )
