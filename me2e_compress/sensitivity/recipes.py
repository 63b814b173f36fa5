"""From what was found to a recipe."""

from pathlib import Path

from me2e_compress.errors import EvaluationError
from me2e_compress.runtime.atomic import write_bytes
from me2e_compress.sensitivity.analysis import Sensitivity
from me2e_compress.sensitivity.trials import Choice, Trials


def advise(
    trials: Trials,
    found: Sensitivity,
    limit: float,
    driving_limit: float | None = None,
) -> Choice:
    """Give the choice that keeps the loss within a limit, and floats little for it.

    Starts with all modules in int8. Until the measured losses are within the limits,
    the costliest module first gives up the nodes that are to blame, then all of them.

    Args:
        trials: judges variants.
        found: what :func:`analyse` found.
        limit: largest loss, in its unit.
        driving_limit: how far the closed-loop score may lie below the float model's,
            asked once the loss is within its limit; None asks for no drive.

    Returns:
        The choice; no module at all where none keeps the limits.

    Raises:
        EvaluationError: a limit of driving, and trials that have no hook for it.
    """
    for choice in _steps(trials, found):
        if not choice.modules:
            return choice
        if trials.score(choice).loss > limit:
            continue
        if driving_limit is None or _driving_loss(trials, choice) <= driving_limit:
            return choice
    return Choice(())


def _driving_loss(trials: Trials, choice: Choice) -> float:
    whole, got = trials.driving(Choice(())), trials.driving(choice)
    if whole is None or got is None:
        raise EvaluationError("a limit of driving needs trials that are driven")
    return whole - got


def _steps(trials: Trials, found: Sensitivity) -> list[Choice]:
    """List choices from all modules to none, the costliest given up first."""
    left = {each.module for each in found.findings}

    def choice(floats: list[str]) -> Choice:
        names = (name for name in trials.modules.names() if name in left)
        return Choice(tuple(names), tuple(floats))

    steps = [choice([])]
    for each in found.findings:
        blamed = [name for group, _ in each.blamed for name in group]
        if blamed and len(blamed) < each.nodes:
            steps.append(choice(blamed))
        left.discard(each.module)
        steps.append(choice([]))
    return steps


def write_recipe(
    path: Path, choice: Choice, passes: tuple[str, ...], rules: str, target: str
) -> Path | None:
    """Write a recipe and, where nodes stay float, the overrides beside it.

    Args:
        path: of the recipe.
        choice: what is int8.
        passes: names of the passes before int8.
        rules: rule set of the plan.
        target: who will run the graph.

    Returns:
        The file of overrides; None where none is needed.
    """
    lines = [f'[[pass]]\nname = "{name}"\n' for name in passes]
    overrides = path.with_name(path.stem + ".overrides.toml")
    if choice.modules:
        options = [
            "[[pass]]",
            'name = "quantize-int8"',
            f"modules = {_array(choice.modules)}",
            f'rules = "{rules}"',
            f'target = "{target}"',
        ]
        if choice.floats:
            options.append(f"overrides = {_string(overrides.name)}")
        lines.append("\n".join(options) + "\n")
    write_bytes(path, "\n".join(lines).encode())
    if not choice.floats or not choice.modules:
        return None
    entries = [
        f"[[override]]\nnodes = {_string(each.nodes or '')}\n"
        f'dtype = "{each.dtype}"\nreason = "{each.reason}"\n'
        for each in choice.overrides().override
    ]
    write_bytes(overrides, "\n".join(entries).encode())
    return overrides


def _array(names: tuple[str, ...]) -> str:
    return f"[{', '.join(_string(name) for name in names)}]"


def _string(text: str) -> str:
    """Write a TOML basic string."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'
