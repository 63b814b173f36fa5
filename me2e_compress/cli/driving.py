"""The commands that drive, and that look at what was driven."""

from pathlib import Path

from me2e_compress.cli.commands import WRITING, Output
from me2e_compress.cli.console import is_json, listening, say, show, show_of, tell
from me2e_compress.errors import OptionError
from me2e_compress.extras import need_extra
from me2e_compress.metrics import BUDGET_MS
from me2e_compress.simulator.scenarios import VARIANTS
from me2e_compress.workflows.options import (
    EerOptions,
    GraphOptions,
    WriteOptions,
    check_count,
)


def evaluate(
    policy: str | None = None,
    /,
    *,
    output: Output | None = None,
    check: bool = False,
    routes: str = "all",
    latency: str = "none",
    seed: int = 0,
    workers: int = 1,
    weather: str = "",
    drive_on: bool = False,
    engine: str = "local",
    render: str | None = None,
    evaluator: str = "highway",
    model: GraphOptions | None = None,
    writing: WriteOptions = WRITING,
) -> None:
    """Drive a policy over routes of highway-env; run it again to go on.

    Another evaluator takes options of its own; --evaluator and --force alone are
    for all. --check looks at POLICY, --adapter, --map and --provider alone; 1 if it
    could not drive.

    Args:
        policy: M.onnx, highway, expert, onnx{path=M.onnx,...}; see list
        output: the results folder
        check: say what fits and what is missing, drive nothing
        routes: routes: all, a number, ID,ID; or a file of routes
        latency: none, fps:F, trace:FILE, measured, or see list
        seed: seed of everything random
        workers: processes at a time
        weather: fog_m=80,night=0.5 ...
        drive_on: go on after a collision, as Bench2Drive
        engine: local, ray, or ray:ADDRESS of a cluster
        render: draw this route as GIF and PNG
        evaluator: who drives it: highway, NAME{option=value}, or see list
    """
    from me2e_compress.workflows import evaluate as workflow

    model = model or GraphOptions()
    adapter, module_map, provider = model.adapter, model.module_map, model.runs_on
    # --check drives nothing, and needs no folder
    if check:
        if policy is None:
            raise OptionError("--check needs a policy: POLICY")
        with listening() as listener:
            checked = workflow.check_model(
                policy, adapter, provider, listener, module_map
            )
        show(checked)
        checked.check()
        return
    if output is None:
        raise OptionError("driving needs -o RESULTS/")
    check_count("--seed", seed)
    check_count("--workers", workers, least=1)
    engine_name, address = engine_and_address(engine)
    options = workflow.EvaluateOptions(
        routes=routes, latency=latency, seed=seed, workers=workers, adapter=adapter,
        module_map=None if module_map is None else str(module_map), weather=weather,
        drive_on=drive_on, engine=engine_name, address=address, render=render,
        provider=provider, force=writing.force, evaluator=evaluator,
    )  # fmt: skip
    with listening() as listener:
        result = workflow.evaluate(policy, output, options, listener)
    show(result)
    for file in result.pictures:
        tell(f"wrote {file}")


def engine_and_address(text: str) -> tuple[str, str | None]:
    """Split ``ray:ADDRESS``; None stands for a cluster of its own, or for none."""
    name, _, address = text.partition(":")
    return name, address or None


def score(
    *results: Path,
    metrics: Path | None = None,
    eer: EerOptions | None = None,
    budget_ms: float = BUDGET_MS,
) -> None:
    """Print driving score, success rate, efficiency, comfort and abilities.

    With --joules also EER_AV, which compares all folders. --metrics is about results of
    real runs in CARLA.

    Args:
        results: folders of results, ours or Bench2Drive's
        metrics: a folder of metric_info.json apart from RESULTS
        budget_ms: what a decision may take; 20 Hz: 50
    """
    from me2e_compress.workflows.score import score as workflow

    if not results:
        raise OptionError("score needs a folder of results: RESULTS")
    with listening() as listener:
        result = workflow(
            *results,
            listener=listener,
            real_metrics=metrics,
            eer=eer,
            budget_ms=budget_ms,
        )
    show(result)


def study(
    definition: Path,
    /,
    *,
    output: Output,
    routes: str | None = None,
    tables: str | None = None,
    dry_run: bool = False,
    provider: str | None = None,
    trust_code: bool = False,
    workers: int = 1,
    engine: str = "local",
    writing: WriteOptions = WRITING,
) -> None:
    """Drive variants under conditions and compare them; run it again to go on.

    Args:
        definition: STUDY.toml
        output: the folder
        routes: routes: all, a number, ID,ID; not the study's
        tables: only these of its blocks: A,B
        dry_run: count drives and hours, drive nothing
        provider: runs the graph: cpu, cuda, ...; not the study's
        trust_code: run Python and libraries that it names
        workers: processes at a time
        engine: local, ray, or ray:ADDRESS of a cluster
    """
    need_extra("highway", "a study")
    from me2e_compress.evaluators.highway.engine import engine_of
    from me2e_compress.study import load_study
    from me2e_compress.study.report.page import write_study
    from me2e_compress.study.run import run_study
    from me2e_compress.study.workload import workload
    from me2e_compress.study.workspace import HTML, JSON, MARKDOWN
    from me2e_compress.workflows.checks import check_folder

    # read and check everything that the study needs before it starts
    asked = load_study(definition, routes, provider, trust_code=trust_code)
    if tables is not None:
        asked = asked.of_blocks(tables.split(","))
    inputs = (definition, *asked.inputs())
    check_folder(output, inputs, (JSON, MARKDOWN, HTML))
    ahead = workload(asked, output, workers)
    if dry_run:
        show(ahead)
        return
    # the report quotes the command that repeats the study
    options: list[tuple[str, str | None]] = [
        ("--routes", routes),
        ("--tables", tables),
        ("--provider", provider),
    ]
    chosen = [str(word) for each in options if each[1] is not None for word in each]
    chosen += ["--trust-code"] * trust_code
    words = ("me2e-compress", "study", str(definition), "-o", str(output), *chosen)
    # drive, or go on, and write the report
    tell(ahead.headline)
    with listening() as listener:
        name, address = engine_and_address(engine)
        chosen_engine = engine_of(name, workers, address)
        found = run_study(asked, output, chosen_engine, listener, force=writing.force)
        files = write_study(found, output, words, force=writing.force)
    show(found)
    if not is_json():
        say(f"wrote {files.report}, {files.tables} and {files.record}")


def routes(
    *,
    output: Output | None = None,
    seed: int = 0,
    variants: int = VARIANTS,
    scenarios: str = "all",
    workers: int = 1,
    examine: Path | None = None,
    writing: WriteOptions = WRITING,
) -> None:
    """Make a fresh set of admitted routes, or examine an existing set again.

    Args:
        output: the manifest to write
        seed: seed of everything random
        variants: routes of each type
        scenarios: scenario types: all, or NAME,NAME
        workers: processes at a time
        examine: examine this manifest instead of making one
    """
    from me2e_compress.workflows import routes as workflow

    if examine is not None:
        show_of(workflow.examine_routes, examine, "all")
        return
    if output is None:
        raise OptionError("a new set needs -o ROUTES.json")
    check_count("--variants", variants, least=1)
    check_count("--workers", workers, least=1)
    options = workflow.RoutesOptions(seed, variants, scenarios, workers, writing.force)
    show_of(workflow.make_routes, output, options)
