"""Drive a policy over routes of an evaluator, and score it; or check that it could."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import cast

from me2e_compress import graph
from me2e_compress.base.display import table
from me2e_compress.base.errors import EvaluationError, FramesError, GraphError
from me2e_compress.base.listener import SILENT, Listener
from me2e_compress.base.registry import options_of
from me2e_compress.commands.checks import check_folder, model_path, try_first, writing
from me2e_compress.commands.options import EvaluateOptions, GraphOptions
from me2e_compress.commands.result import Result, View
from me2e_compress.commands.score import driving_score, scores_table
from me2e_compress.driving.adapter.adapter import Adapter
from me2e_compress.driving.adapter.outputs import PortUse, input_uses, output_uses
from me2e_compress.driving.contract import RouteInfo
from me2e_compress.driving.latency import parse_latency
from me2e_compress.driving.onnx_policy import OnnxPolicy, recurrent_of
from me2e_compress.driving.policies import POLICIES, Driver, driver_named, opened
from me2e_compress.evaluators.contract import Drive, Evaluator, evaluator_named
from me2e_compress.evaluators.highway.drivers import OnnxDriver
from me2e_compress.evaluators.highway.engine import engine_named
from me2e_compress.evaluators.results import MANIFEST, drive_routes, log_beside
from me2e_compress.metrics.deadlines import (
    Deadlines,
    charged_deadlines,
    deadlines_table,
)
from me2e_compress.metrics.scores import Scores
from me2e_compress.metrics.scores import score as score_episodes
from me2e_compress.runtime.providers import CPU
from me2e_compress.runtime.session import Session
from me2e_compress.shipped.drivers import SHIPPED
from me2e_compress.simulator.routes import Route, pick_routes
from me2e_compress.targets.onnxruntime.convert import slow_here

# Command-line names of options that differ from their Python names
_FLAGS = {"module_map": "map"}
# What an evaluator must take for an option, where that has another name
_ABILITIES = {"seed": "latency", "workers": "engine"}
_FOR_ALL = ("evaluator", "force")


def drive_of(options: EvaluateOptions, evaluator: Evaluator) -> Drive:
    """Parse options into a drive, for an evaluator that must take them.

    Raises:
        EvaluationError: An option is invalid, or not the evaluator's.
    """
    # Options that differ from the defaults must be the evaluator's
    defaults, provider = EvaluateOptions(), options.runs_on
    for field in dataclasses.fields(options):
        name = field.name
        asked = getattr(options, name) != getattr(defaults, name)
        if name == "provider":
            asked = provider != CPU
        if asked and name not in _FOR_ALL:
            flag = _FLAGS.get(name, name.replace("_", "-"))
            evaluator.check_takes([_ABILITIES.get(name, name)], f"--{flag}: ")
    # Routes, weather, latency and workers
    routes: Sequence[RouteInfo] = ()
    set_size = 0
    if "routes" in evaluator.takes:
        try:
            routes, set_size = evaluator.routes(str(options.routes))  # a number, too
        except ValueError as error:
            raise EvaluationError(f"--routes {options.routes}: {error}") from error
    conditions = Drive.of_words(options.latency_model, options.dt_ms, options.weather)
    return dataclasses.replace(
        conditions,
        latency=parse_latency(options.latency, seed=options.seed),
        routes=routes,
        set_size=set_size,
        engine=engine_named(options.engine, options.workers),
    )


@dataclasses.dataclass(frozen=True, repr=False)
class EvaluateResult(Result):
    """How a policy drives."""

    keys = ("*scores", "deadlines", "slow_here")
    policy: str  # its name, or the evaluator where that drives none
    output: Path
    scores: Scores
    pictures: tuple[Path, ...] = ()
    # latencies charged to decisions, against the frame time; None if none
    deadlines: Deadlines | None = None
    # why the policy's file is slow on this CPU, whose form is not its own
    slow_here: str | None = None

    def view(self) -> View:
        """Return scores and latencies; alerts are failures, and a form slow here."""
        tables = [scores_table(self.policy, self.scores)]
        if self.deadlines is not None:
            tables.append(deadlines_table(self.policy, self.deadlines))
        slow = self.slow_here and f"{self.policy}: {self.slow_here}"
        return View(
            f"{self.policy}: {driving_score(self.scores)}",
            tables,
            lines=(),  # the tables say everything
            alerts=filter(None, [self.scores.failed, slow]),
        )


def evaluate(
    policy: str | Path | None,
    output: str | Path,
    options: EvaluateOptions | None = None,
    listener: Listener = SILENT,
) -> EvaluateResult:
    """Drive a policy over routes of an evaluator; run again, it goes on.

    The policy is an ONNX file, the name of a model that ships, or another
    policy; None for an evaluator that drives none.

    Raises:
        EvaluationError: A policy, evaluator or option does not exist or fit, the policy
            cannot drive, or the folder belongs to another evaluation.
        GraphError: The folder is a file or an input.
        ProviderError: The provider is not available.
        MissingExtraError: Driving in highway-env needs the extra ``highway``.
    """
    options, output = options or EvaluateOptions(), Path(output)
    # Every option is parsed before anything is written
    evaluator = evaluator_named(options.evaluator)
    drives = "policy" in evaluator.takes
    if policy is None and drives:
        raise EvaluationError(
            f"{evaluator.name} drives a policy: name one, M.onnx or highway"
        )
    if policy is not None and not drives:
        raise EvaluationError(f"{evaluator.name} drives no policy: leave out {policy}")
    # The folder must be none of the inputs; a trace that is no file is harmless
    trace = options.latency.removeprefix("trace:")
    read = (policy, str(options.routes), trace, options.adapter, options.module_map)
    own = [getattr(evaluator, option.name) for option in options_of(type(evaluator))]
    files = [value for value in own if isinstance(value, Path)]
    check_folder(output, (*read, *files), (MANIFEST,))
    with writing([log_beside(output)], folders=[output], force=options.force):
        drive = drive_of(options, evaluator)
        pictured: Sequence[RouteInfo] = ()
        if options.render is not None:  # of those that are driven, by their ids
            known = cast("Sequence[Route]", drive.routes)
            pictured = pick_routes(known, options.render)
        # Find the driver, and open its graph in a process of its own first
        driver, slow = None, None
        if policy is not None:
            driver = driver_of(str(policy), options)
        if isinstance(driver, OnnxDriver):
            provider, file = options.runs_on, driver.path
            try_first(file, file.name, listener=listener, provider=provider)
        # Drive, or go on where an earlier run stopped
        episodes = drive_routes(evaluator, driver, drive, output, listener)
        # Score over the whole set, though only a part of it was asked for
        set_size = max(drive.set_size or evaluator.set_size, len(episodes))
        scores = score_episodes(episodes, set_size)
        pictures = tuple(
            file
            for route in pictured
            if driver is not None
            for file in evaluator.render(driver, drive, route, output)
        )
        late = charged_deadlines(episodes, measured=drive.latency.measured)
        if isinstance(driver, OnnxDriver):
            slow = slow_here(graph.load(driver.path), options.runs_on)
    name = evaluator.name if policy is None else str(policy)
    return EvaluateResult(name, output, scores, pictures, late, slow)


def driver_of(text: str, options: GraphOptions) -> Driver:
    """Return the driver of a policy's name, a path or a shipped model's name."""
    if text in SHIPPED:  # by its path, which a file of that name may be instead
        text = str(model_path(text))
    driver = driver_named(text, options.adapter, options.module_map)
    if not isinstance(driver, OnnxDriver):
        return driver
    try:
        path = model_path(driver.path)
        return dataclasses.replace(driver, path=path, provider=options.runs_on)
    except GraphError as error:
        policies = ", ".join(POLICIES.names())
        raise EvaluationError(f"{error}; policies: {policies}") from error


@dataclasses.dataclass(frozen=True, repr=False)
class ModelCheck(Result):
    """Which ports of a policy fit, and what is missing.

    Attributes:
        inputs: of the graph, in order; empty if the policy is not a graph.
        outputs: of the graph, likewise.
        problems: why it could not drive; one line each.
    """

    policy: str
    inputs: tuple[PortUse, ...]
    outputs: tuple[PortUse, ...]
    problems: tuple[str, ...]

    def view(self) -> View:
        """Return every port of the graph, and whether it could drive."""
        rows = list[tuple[str, ...]]()
        for kind, ports in (("input", self.inputs), ("output", self.outputs)):
            for port in ports:
                shape = str([side or "?" for side in port.shape]).replace("'", "")
                use = port.problem or port.use or "-"
                rows.append((kind, port.name, shape, port.type, use))
        columns = ("", "name", "shape", "type", "fed by, or used as")
        tables = [table(self.policy, columns, rows, words=5)] if rows else []
        if not self.problems:
            return View(f"{self.policy} could drive", tables)
        could_not = f"{self.policy} could not drive"
        error = EvaluationError(f"{could_not}: {self.problems[0]}")
        return View(could_not, tables, alerts=self.problems, error=error)


def check_model(
    policy: str | Path, options: GraphOptions | None = None, listener: Listener = SILENT
) -> ModelCheck:
    """Check whether a policy could drive: open it, match its ports, run it on zeros.

    The policy is an ONNX file or any other that :func:`evaluate` drives; the options'
    adapter is the TOML file that adapts a model to the policy contract, the module map
    says which output is the plan and which are fed back.

    Raises:
        EvaluationError: The policy or adapter does not exist, or the file is no model.
        GraphError: onnxruntime crashes on the graph.
        ProviderError: The provider is not available.
    """
    named = str(policy)
    options = options or GraphOptions()
    driver = driver_of(named, options)
    # a policy without a graph has no ports: opening it is the check
    if not isinstance(driver, OnnxDriver):
        opened(driver)
        return ModelCheck(named, (), (), ())
    # the ports are read without a policy, which would refuse at the first problem
    try_first(
        driver.path, driver.path.name, listener=listener, provider=options.runs_on
    )
    read = Adapter() if driver.adapter is None else Adapter.load(driver.adapter)
    try:
        session = Session(
            driver.path, threads=1, provider=driver.provider, metadata=driver.metadata()
        )
    except (GraphError, FramesError) as error:
        raise EvaluationError(str(error)) from error
    recurrent = recurrent_of(session, read)
    inputs = input_uses(session, read, recurrent)
    outputs, unread = output_uses(session, read, recurrent)
    # Problems are listed once each; only a model without any is run
    texts = [*(port.problem for port in inputs), unread]
    problems = dict.fromkeys(filter(None, texts))
    if not problems:
        try:
            OnnxPolicy.of(session, read)  # it runs the model on zeros
        except (GraphError, FramesError, EvaluationError) as error:
            problems[str(error)] = None
    return ModelCheck(named, inputs, outputs, tuple(problems))
