"""Check port by port whether a model could drive, before it does."""

import dataclasses
from pathlib import Path

from me2e_compress.display import table
from me2e_compress.driving.adapter.adapter import Adapter
from me2e_compress.driving.adapter.outputs import OutputUses, PortUse, input_uses
from me2e_compress.driving.onnx_policy import OnnxPolicy, recurrent_of
from me2e_compress.driving.policies import opened
from me2e_compress.errors import EvaluationError, FramesError, GraphError
from me2e_compress.evaluators.highway.drivers import OnnxDriver
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.session import Session
from me2e_compress.workflows.checks import try_first
from me2e_compress.workflows.evaluate import driver_of
from me2e_compress.workflows.result import SILENT, Listener, Result, Shown


@dataclasses.dataclass(frozen=True, repr=False)
class ModelCheck(Result):
    """Which ports of a policy fit, and what is missing.

    Attributes:
        drives_by: the kind of its answer, in words; empty where nothing names one.
        inputs: of the graph, in order; empty if the policy is not a graph.
        outputs: of the graph, likewise.
        problems: why it could not drive; one line each.
    """

    policy: str
    drives_by: str
    inputs: tuple[PortUse, ...]
    outputs: tuple[PortUse, ...]
    problems: tuple[str, ...]

    def shown(self) -> Shown:
        """Return every port of the graph, whether it could drive, and by what."""
        ports = [("input", each) for each in self.inputs]
        ports += [("output", each) for each in self.outputs]
        rows = list[tuple[str, ...]]()
        for kind, each in ports:
            shape = str([side or "?" for side in each.shape]).replace("'", "")
            use = each.problem or each.use or "-"
            rows.append((kind, each.name, shape, each.type, use))
        columns = ("", "name", "shape", "type", "fed by, or used as")
        tables = [table(self.policy, columns, rows, words=5)] if rows else []
        if not self.problems:
            return Shown(f"{self.policy} could drive, by {self.drives_by}", tables)
        could_not = f"{self.policy} could not drive"
        error = EvaluationError(f"{could_not}: {self.problems[0]}")
        return Shown(could_not, tables, alerts=self.problems, error=error)


def check_model(
    policy: str | Path,
    adapter: str | Path | None = None,
    provider: Provider = CPU,
    listener: Listener = SILENT,
    module_map: str | Path | None = None,
) -> ModelCheck:
    """Check whether a policy could drive: open it, match its ports, run it on zeros.

    The policy is an ONNX file or any other that :func:`evaluate` drives; an adapter is
    the TOML file that adapts a model to the policy contract, a module map says which
    output is the plan and which are fed back.

    Raises:
        EvaluationError: The policy or adapter does not exist, or the file is no model.
        GraphError: onnxruntime crashes on the graph.
        ProviderError: The provider is not available.
    """
    named = str(policy)
    driver = driver_of(named, adapter, provider, module_map)
    # a policy without a graph has no ports: opening it is the check
    if not isinstance(driver, OnnxDriver):
        opened(driver)
        return ModelCheck(named, "what its code answers", (), (), ())
    # the ports are read without a policy, which would refuse at the first problem
    try_first(driver.path, driver.path.name, listener=listener, provider=provider)
    read = Adapter() if driver.adapter is None else Adapter.load(driver.adapter)
    try:
        session = Session(
            driver.path, threads=1, provider=driver.provider, said=driver.said()
        )
    except (GraphError, FramesError) as error:
        raise EvaluationError(str(error)) from error
    recurrent = recurrent_of(session, read)
    fed, used = input_uses(session, read, recurrent), OutputUses.of(session, read)
    outputs = used.ports(session, recurrent)
    # problems are listed once each; only a model without any is run
    found = [each.problem for each in (*fed, *outputs) if each.problem]
    problems = dict.fromkeys([*found, *used.problems])
    if not problems:
        try:
            OnnxPolicy.of(session, read)  # it runs the model on zeros
        except (GraphError, FramesError, EvaluationError) as error:
            problems[str(error)] = None
    return ModelCheck(named, used.drives_by, fed, outputs, tuple(problems))
