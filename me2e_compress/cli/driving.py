"""The commands that drive, and that look at what was driven."""

from pathlib import Path

from me2e_compress.base.errors import OptionError
from me2e_compress.base.extras import require_extra
from me2e_compress.cli.commands import WRITING, Output
from me2e_compress.cli.console import listening, printing, say, show, show_call, tell
from me2e_compress.commands.options import (
    EvaluateOptions,
    Joules,
    WorkerOptions,
    WriteOptions,
)
from me2e_compress.metrics import BUDGET_MS

RUNNING = WorkerOptions()


def evaluate(
    policy: str | None = None,
    /,
    *,
    output: Output | None = None,
    check: bool = False,
    options: EvaluateOptions | None = None,
) -> None:
    """Drive a policy over routes of highway-env; run it again to go on.

    Another evaluator takes options of its own; --evaluator and --force alone are
    for all. --check looks at POLICY, --adapter, --map and --provider alone; 1 if it
    could not drive.

    Args:
        policy: M.onnx, highway, onnx{path=M.onnx,...}; see list
        output: the results folder
        check: say what fits and what is missing, drive nothing
    """
    from me2e_compress.commands import evaluate as workflow

    # --check drives nothing, and needs no folder
    if check:
        if policy is None:
            raise OptionError("--check needs a policy: POLICY")
        show_call(workflow.check_model, policy, options)
        return
    if output is None:
        raise OptionError("driving needs -o RESULTS/")
    with listening() as listener:
        result = workflow.evaluate(policy, output, options, listener)
    show(result)
    for file in result.pictures:
        tell(f"wrote {file}")


def score(
    *results: Path,
    metrics: Path | None = None,
    joules: Joules | None = None,
    budget_ms: float = BUDGET_MS,
) -> None:
    """Print driving score, success rate, efficiency, comfort and abilities.

    With --joules also EER_AV, which compares all folders. --metrics is about results of
    real runs in CARLA.

    Args:
        results: folders of results, ours or Bench2Drive's; ROUTES.xml, their set
        metrics: a folder of metric_info.json apart from RESULTS
        joules: NAME=JOULES or NAME=FILE: of an inference; gives EER_AV
        budget_ms: what a decision may take; 20 Hz: 50
    """
    from me2e_compress.commands.score import score as workflow

    if not results:
        raise OptionError("score needs a folder of results: RESULTS")
    with listening() as listener:
        result = workflow(
            *results,
            listener=listener,
            real_metrics=metrics,
            joules=joules,
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
    running: WorkerOptions = RUNNING,
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
    """
    require_extra("highway", "a study")
    from me2e_compress.commands.checks import check_folder
    from me2e_compress.evaluators.highway.engine import engine_named
    from me2e_compress.study import load_study
    from me2e_compress.study.report.page import write_study
    from me2e_compress.study.run import run_study
    from me2e_compress.study.workload import workload
    from me2e_compress.study.workspace import HTML, JSON, MARKDOWN

    # read and check everything that the study needs before it starts
    asked = load_study(definition, routes, provider, trust_code=trust_code)
    if tables is not None:
        asked = asked.of_blocks(tables.split(","))
    inputs = (definition, *asked.inputs())
    check_folder(output, inputs, (JSON, MARKDOWN, HTML))
    ahead = workload(asked, output, running.workers)
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
        engine = engine_named(running.engine, running.workers)
        result = run_study(asked, output, engine, listener, force=writing.force)
        files = write_study(result, output, words, force=writing.force)
    show(result)
    if not printing.json:
        say(f"wrote {files.report}, {files.tables} and {files.record}")
