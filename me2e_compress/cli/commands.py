"""The commands: arguments, options by their dataclass, one function, its result.

What is heavy is imported in the bodies, so that a command explains itself at once.
"""

import time
from pathlib import Path
from typing import Annotated, TypeAlias

from cyclopts import Parameter

from me2e_compress.base.errors import EvaluationError, OptionError, RecipeError
from me2e_compress.base.extras import require_extra
from me2e_compress.cli.console import listening, printing, say, show, show_call, tell
from me2e_compress.commands.options import (
    CalibrateOptions,
    CompareOptions,
    CompressOptions,
    EvaluateOptions,
    FramesOptions,
    InspectOptions,
    Joules,
    LintOptions,
    PlanOptions,
    ProfileOptions,
    SearchOptions,
    SensitivityOptions,
    WorkerOptions,
    WriteOptions,
)
from me2e_compress.commands.result import Result
from me2e_compress.metrics import BUDGET_MS

Output: TypeAlias = Annotated[Path, Parameter(name=["--output", "-o"])]
WRITING, RUNNING = WriteOptions(), WorkerOptions()


def demo(
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o", "--out"])] = Path("out"),
    writing: WriteOptions = WRITING,
) -> None:
    """Run the main job on what ships: compress, verify, compare, drive, report.

    Args:
        output: the folder to write
    """
    require_extra("highway", "driving in the demo")
    from me2e_compress.study.demo import DemoResult, DriverDemo

    steps = DriverDemo(output, writing.force).steps
    # every step prints its result, in a line, as soon as it is done
    output.mkdir(parents=True, exist_ok=True)
    results = dict[str, Result]()
    for name, step in steps.items():
        begun = time.monotonic()
        with listening() as listener:
            results[name] = result = step(listener)
        if not printing.json:
            seconds = time.monotonic() - begun
            text = getattr(result, "size", result.headline)
            say(f"{name:<10}{seconds:4.0f} s   {text}")
            if printing.verbose:
                show(result)
    # with -v every step was shown in full already
    if printing.json or not printing.verbose:
        show(DemoResult(results))


def doctor() -> None:
    """Show what this machine can do, and what to install for the rest."""
    from me2e_compress.commands.listing import doctor as workflow

    show(workflow())


def list_entries(kind: str | None = None, /) -> None:
    """Show what can be named: ours, and what other packages add by entry point.

    Args:
        kind: passes, rules, ...: one kind, and what its options mean
    """
    from me2e_compress.commands.listing import list_entries as workflow

    show(workflow(kind))


def export(stack: str, /, *, output: Output, writing: WriteOptions = WRITING) -> None:
    """Write a trained driver that ships.

    Args:
        stack: highway
        output: the ONNX file
    """
    from me2e_compress.commands.files import export_stack

    show(export_stack(stack, output, force=writing.force))


def inspect(model: str, /, *, options: InspectOptions | None = None) -> None:
    """Show what a graph holds: interface, and nodes, parameters, MACs by module.

    Args:
        model: the ONNX file, or highway; not changed
    """
    from me2e_compress.commands.inspect import inspect as workflow

    show(workflow(model, options))


def join(stack: Path, /, *, output: Output, writing: WriteOptions = WRITING) -> None:
    """Join the files of a model into one graph, which all commands take.

    Args:
        stack: the TOML file that names the files
        output: the joined graph
    """
    from me2e_compress.commands.files import join as workflow

    show(workflow(stack, output, force=writing.force))


def split(
    model: str, stack: Path, /, *, output: Output, writing: WriteOptions = WRITING
) -> None:
    """Cut a graph that was joined, and made smaller, into its files again.

    Args:
        model: the ONNX file, or highway; not changed
        stack: the TOML file that names the files
        output: the folder of the files
    """
    from me2e_compress.commands.files import split as workflow

    show(workflow(model, stack, output, force=writing.force))


def frames(
    stack: str, /, *, output: Output, options: FramesOptions | None = None
) -> None:
    """Write calibration frames, coherent in time, seen by six cameras.

    The driver that ships drives fresh routes, and the model looks on: highway, or any
    ONNX file that keeps the policy contract (--adapter). With --from, recorded driving
    is laid out as the file takes it: docs/writing-logs.md in the repository.

    Args:
        stack: highway, or M.onnx
        output: the folder
    """
    from me2e_compress.commands.frames import FramesResult, record_frames

    with listening() as listener:
        record_frames(stack, output, options, listener)
    show(FramesResult.of(stack, output, options or FramesOptions()))


def plan(
    model: str, /, *, output: Output | None = None, options: PlanOptions | None = None
) -> None:
    """Show which nodes become int8, which stay float, by which rule, and why.

    With -v a row a node that could be int8.

    Args:
        model: the ONNX file, or highway; float or with a plan
        output: the plan as JSON
    """
    from me2e_compress.commands.plan import plan as workflow

    result = workflow(model, output, options)
    show(result, result.view(every=printing.verbose).tables)


def calibrate(
    model: str,
    frames: Path | None = None,
    /,
    *,
    output: Output = Path("ranges.json"),
    options: CalibrateOptions | None = None,
) -> None:
    """Measure the ranges of every tensor that any scheme, rule set or target needs.

    Frames are taken in whole scenes; of a recipe, the passes before int8 are run.
    A run that was killed goes on from OUTPUT.checkpoint; compress takes what is
    measured by --ranges.

    Args:
        model: the ONNX file, or highway; not changed
        frames: the recorded FRAMES; --import needs none
        output: the ranges as JSON
    """
    from me2e_compress.commands.calibrate import calibrate as workflow

    show_call(workflow, model, frames, output, options)


def compress(
    model: str,
    /,
    *,
    output: Output,
    recipe: Annotated[str | None, Parameter(name=["--recipe", "-r"])] = None,
    passes: str | None = None,
    frames: Path | None = None,
    options: CompressOptions | None = None,
) -> None:
    """Apply passes to a graph, check each, and write the smaller graph and a report.

    A pipeline names passes in order: fuse-basic,fold-constants{bytes_per_node=0}

    Args:
        model: the ONNX file, or highway; not changed
        output: the smaller graph
        recipe: a TOML file, or a shipped recipe's name
        passes: a pipeline, as text; see above
        frames: the recorded FRAMES
    """
    from me2e_compress.commands.compress import compress as workflow
    from me2e_compress.manager.recipe import parse

    if recipe is not None and passes is not None:
        raise RecipeError("give a recipe (-r) or a pipeline (--passes), not both")
    wanted = recipe if passes is None else parse(passes)
    show_call(workflow, model, output, wanted, frames, options)


def lint(model: str, /, *, options: LintOptions | None = None) -> None:
    """Check a graph for the runtime that will run it; exit code 1 if it refuses.

    Args:
        model: the ONNX file, or highway; not changed
    """
    from me2e_compress.commands.lint import lint as workflow

    with listening() as listener:
        result = workflow(model, options, listener)
    show(result, result.view(every=printing.verbose).tables)
    result.check()


def sensitivity(
    model: str,
    frames: Path,
    /,
    *,
    output: Output,
    options: SensitivityOptions | None = None,
) -> None:
    """Measure what int8 costs module by module, and write a recipe within a limit.

    Halves of the worst module's nodes are tried next, to find those to blame.
    The loss is how far the plan moves, metres, mean over the frames; of a model
    whose plan is not known, the noise of its worst output relative to the signal.

    Args:
        model: the ONNX file, or highway; float
        frames: the recorded FRAMES
        output: the RECIPE.toml
    """
    from me2e_compress.commands.search import measure_sensitivity

    show_call(measure_sensitivity, model, frames, output, options)


def search(
    model: str, frames: Path, /, *, output: Output, options: SearchOptions | None = None
) -> None:
    """Find the scheme within the budgets that costs the plan least.

    Args:
        model: the ONNX file, or highway; float
        frames: the recorded FRAMES
        output: the RECIPE.toml
    """
    from me2e_compress.commands.search import search as workflow

    show_call(workflow, model, frames, output, options or SearchOptions())


def compare(
    reference: str,
    candidate: str,
    frames: Path | None = None,
    /,
    *,
    outputs: Path | None = None,
    float_graph: Annotated[str | None, Parameter(name="--float")] = None,
    first_difference: bool = False,
    options: CompareOptions | None = None,
) -> None:
    """Run two graphs over frames: SQNR of every output, plan displacement in metres.

    Exit code 1 if an output of the second hardly moves any more.

    Args:
        reference: graph to be true to
        candidate: the graph that is judged; not with --outputs
        frames: the recorded FRAMES
        outputs: what an engine of the graph answered: DUMP/
        float_graph: the graph's float source, with --outputs
        first_difference: name the first module after which the second differs
    """
    from me2e_compress.commands import compare as between
    from me2e_compress.commands import compare_dump as against_engine

    # Options that do not go together
    options = options or CompareOptions()
    if first_difference and (options.as_it_stands or outputs is not None):
        raise RecipeError(
            "--first-difference holds two graphs together, all nodes as they stand:"
            " leave out --reference and --outputs"
        )
    if float_graph is not None and outputs is None:
        raise RecipeError("--float is for --outputs, which is not given")
    # Against what an engine answered, or graph against graph
    if outputs is not None and frames is None:
        workflow = against_engine.compare_dump
        show_call(workflow, reference, outputs, candidate, float_graph, options)
    elif outputs is not None or frames is None:
        words = "M.onnx FRAMES --outputs DUMP" if frames else "A.onnx B.onnx FRAMES"
        raise OptionError(f"expected {words}")
    elif first_difference:
        show_call(between.first_difference, reference, candidate, frames, options)
    else:
        show_call(between.compare, reference, candidate, frames, options)


def profile(
    model: str,
    frames: Path | None = None,
    /,
    *,
    output: Output,
    imported: Annotated[Path | None, Parameter(name="--import")] = None,
    options: ProfileOptions | None = None,
) -> None:
    """Measure a model alone and warm, and write its latencies as a trace.

    With --import nothing is run: the latencies are those that another tool measured.

    Args:
        model: the ONNX file, or highway; not changed
        frames: the recorded FRAMES; none for --import
        output: the trace
        imported: what another tool measured
    """
    from me2e_compress.commands import profile as workflow
    from me2e_compress.commands.profile import check_import, import_profile

    # Read what another tool measured, or measure here
    options = options or ProfileOptions()
    with listening() as listener:
        if imported is not None:
            check_import(frames, options)
            budget_ms, force = options.budget_ms, options.force
            result = import_profile(
                model, imported, output, budget_ms=budget_ms, force=force
            )
        elif frames is None:
            raise EvaluationError("profile: give recorded FRAMES, or --import FILE")
        else:
            result = workflow.profile(model, frames, output, options, listener)
    show(result)
    # the file besides the trace is named on stderr
    if result.energy_output is not None:
        tell(f"wrote {result.energy_output}")


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
        provider: runs the graph: cpu, cuda, ...; not the study's
        trust_code: run Python and libraries that it names
    """
    require_extra("highway", "a study")
    from me2e_compress.commands.checks import check_folder
    from me2e_compress.evaluators.highway.engine import engine_named
    from me2e_compress.study import load_study
    from me2e_compress.study.report.page import write_study
    from me2e_compress.study.run import run_study
    from me2e_compress.study.workspace import HTML, JSON, MARKDOWN

    # read and check everything that the study needs before it starts
    asked = load_study(definition, routes, provider, trust_code=trust_code)
    inputs = (definition, *asked.inputs())
    check_folder(output, inputs, (JSON, MARKDOWN, HTML))
    # the report quotes the command that repeats the study
    words = ["me2e-compress", "study", str(definition), "-o", str(output)]
    flags = {"--routes": routes, "--provider": provider}
    for flag, value in flags.items():
        words += [] if value is None else [flag, value]
    words += ["--trust-code"] * trust_code
    # drive, or go on, and write the report
    with listening() as listener:
        engine = engine_named(running.engine, running.workers)
        result = run_study(asked, output, engine, listener, force=writing.force)
        files = write_study(result, output, words, force=writing.force)
    show(result)
    if not printing.json:
        say(f"wrote {files.report}, {files.tables} and {files.record}")
