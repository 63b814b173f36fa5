"""Drive a policy over routes of highway-env, and score it."""

import dataclasses
from pathlib import Path

from me2e_compress import graph
from me2e_compress.display import Table, number
from me2e_compress.driving.policies import POLICIES, Driver, driver_named
from me2e_compress.errors import EvaluationError, GraphError
from me2e_compress.evaluators.highway.drivers import OnnxDriver
from me2e_compress.evaluators.highway.evaluator import DrivingOptions, DrivingProgress
from me2e_compress.evaluators.highway.results import MANIFEST, log_beside
from me2e_compress.evaluators.highway.worker import Job
from me2e_compress.extras import need_extra
from me2e_compress.metrics.deadlines import Deadlines, charged, deadlines_table
from me2e_compress.metrics.scores import Scores
from me2e_compress.metrics.scores import score as score_episodes
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.shipped.drivers import SHIPPED
from me2e_compress.simulator.routes import Route, pick_routes
from me2e_compress.targets.onnxruntime import slow_here
from me2e_compress.workflows.checks import check_folder, model_path, try_first, writing
from me2e_compress.workflows.other_evaluators import (
    HIGHWAY,
    driven_episodes,
    evaluator_named,
    expected_of,
    files_of,
    is_highway,
    keep,
)
from me2e_compress.workflows.result import SILENT, Listener, Result
from me2e_compress.workflows.score import driving_score, scores_table

_FLAGS = {"module_map": "map"}
"""Command-line names of options that differ from their Python names."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class EvaluateOptions(DrivingOptions):
    """Which routes are driven, under which conditions, and what is made of them.

    Attributes:
        module_map: preset or TOML file that says plan and state of the model; None
            leaves them to its metadata.
        render: draw these routes as GIF and PNG; chosen as ``routes`` is.
        force: replace outputs that we did not write, too.
        evaluator: ``highway``, whose options are those above; or another by name,
            ``name{option=value}``, which gets the policy as its option ``policy``.
    """

    module_map: str | None = None
    render: str | None = None
    force: bool = False
    evaluator: str = HIGHWAY

    def check_for_others(self) -> None:
        """Raise EvaluationError if an option of highway alone is not at its default."""
        for field in dataclasses.fields(self):
            known = field.name in ("evaluator", "force")
            if not known and getattr(self, field.name) != field.default:
                option = _FLAGS.get(field.name, field.name.replace("_", "-"))
                raise EvaluationError(
                    f"--{option} is highway's: give {self.evaluator} options of its "
                    "own, name{option=value}; `list evaluators` names them"
                )


@dataclasses.dataclass(frozen=True, repr=False)
class EvaluateResult(Result):
    """How a policy drives.

    Attributes:
        policy: the policy as named, or the evaluator where that drives none.
        late: latencies charged to decisions, against the frame time; None if none were.
        slow_here: why the policy's file is slow on this CPU, whose form is not its own.
    """

    policy: str
    output: Path
    scores: Scores
    pictures: tuple[Path, ...] = ()
    late: Deadlines | None = None
    slow_here: str | None = None

    @property
    def headline(self) -> str:
        """The policy, its driving score and the routes."""
        return f"{self.policy}: {driving_score(self.scores)}"

    def lines(self) -> tuple[str, ...]:
        """Return no line: the table says everything."""
        return ()

    def alerts(self) -> tuple[str, ...]:
        """Return the routes that ended by a failure, and a form that is slow here."""
        slow = self.slow_here and f"{self.policy}: {self.slow_here}"
        return tuple(filter(None, [self.scores.failed, slow]))

    def tables(self) -> tuple[Table, ...]:
        """Return every score with its interval, and the latencies charged."""
        late = None if self.late is None else deadlines_table(self.policy, self.late)
        scores = scores_table(self.policy, self.scores)
        return (scores,) if late is None else (scores, late)

    def to_json(self) -> object:
        """Return the scores, and the latencies charged to decisions."""
        late = None if self.late is None else self.late.to_json()
        slow = self.slow_here
        return {**self.scores.to_json(), "deadlines": late, "slow_here": slow}


def evaluate(
    policy: str | Path | None,
    output: str | Path,
    options: EvaluateOptions | None = None,
    listener: Listener = SILENT,
) -> EvaluateResult:
    """Drive a policy over routes of highway-env; run again, it goes on.

    The policy is an ONNX file, the name of a model that ships, ``expert``, ``blind`` or
    ``blind:MPS``; None for an evaluator that drives none. Another evaluator than
    highway is asked for all of its episodes, which are then kept in the same form.

    Raises:
        EvaluationError: A policy, evaluator or option does not exist or fit, the policy
            cannot drive, or the folder belongs to another evaluation.
        GraphError: The folder is a file or an input.
        ProviderError: The provider is not available.
        MissingExtraError: Driving in highway-env needs the extra ``highway``.
    """
    options, output = options or EvaluateOptions(), Path(output)
    named = None if policy is None else str(policy)
    if not is_highway(options.evaluator):
        return _by_another(named, output, options)
    if named is None:
        raise EvaluationError("highway drives a policy: name one, M.onnx or highway")
    policy = named
    # a trace that is no file is harmless here
    trace = options.latency.removeprefix("trace:")
    read = (policy, options.routes, trace, options.adapter, options.module_map)
    check_folder(output, read, (MANIFEST,))
    logs = [log_beside(output)]
    with writing(logs, folders=[output], force=options.force):
        return _evaluated(policy, output, options, listener)


def _by_another(
    policy: str | None, output: Path, options: EvaluateOptions
) -> EvaluateResult:
    options.check_for_others()
    if policy in SHIPPED:
        policy = str(model_path(policy))
    evaluator = evaluator_named(options.evaluator, policy)
    check_folder(output, (policy, *files_of(evaluator)), (MANIFEST,))
    with writing(folders=[output], force=options.force):
        episodes = driven_episodes(evaluator)
        keep(evaluator, episodes, output, policy or "")
    scores = score_episodes(episodes, expected_of(evaluator, episodes))
    late = charged(episodes)
    return EvaluateResult(policy or evaluator.name, output, scores, late=late)


def _evaluated(
    policy: str, output: Path, options: EvaluateOptions, listener: Listener
) -> EvaluateResult:
    need_extra("highway", "driving")
    routes, set_size = options.picked
    shown = () if options.render is None else pick_routes(routes, options.render)
    # find the driver, and open its graph in a process of its own first
    driver = driver_of(policy, options.adapter, options.provider, options.module_map)
    if isinstance(driver, OnnxDriver):
        file, provider = driver.path, options.provider
        try_first(file, file.name, listener=listener, provider=provider)

    def on_progress(now: DrivingProgress) -> None:
        running = f"DS {number(now.driving_score, '.1f')}"
        running += f" SR {number(now.success_rate, '.1f')} %"
        listener.on_progress("evaluate", now.done, now.total, running)

    # drive, or go on where an earlier run stopped
    evaluator = options.driven_by(driver, output, on_progress, listener.on_warning)
    episodes = tuple(evaluator.episodes())
    # score over the whole set, though only a part of it was asked for
    scores = score_episodes(episodes, set_size)
    pictures = _pictures(evaluator.job, shown, output)
    late = charged(episodes, measured=options.source.measured)
    model = graph.load(driver.path) if isinstance(driver, OnnxDriver) else None
    slow = None if model is None else slow_here(model, options.provider)
    return EvaluateResult(policy, output, scores, pictures, late, slow)


def _pictures(job: Job, routes: tuple[Route, ...], folder: Path) -> tuple[Path, ...]:
    if not routes:
        return ()
    from me2e_compress.evaluators.highway.render import render  # imports highway-env

    return tuple(file for route in routes for file in render(job, route, folder))


def driver_of(
    text: str,
    adapter: str | Path | None = None,
    provider: Provider = CPU,
    module_map: str | Path | None = None,
) -> Driver:
    """Return the driver of a policy name, a path or a shipped model's name.

    Policies other than graphs ignore the provider.
    """
    if text in SHIPPED:  # by its path, which a file of that name may be instead
        text = str(model_path(text))
    driver = driver_named(text, adapter, module_map)
    if not isinstance(driver, OnnxDriver):
        return driver
    try:
        path = model_path(driver.path)
        return dataclasses.replace(driver, path=path, provider=provider)
    except GraphError as error:
        policies = ", ".join(POLICIES.names())
        raise EvaluationError(f"{error}; policies: {policies}") from error
