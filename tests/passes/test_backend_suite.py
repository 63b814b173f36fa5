"""ONNX's own single-operator models, before and after the exact passes.

All of them run before; passes take one of each kind, and all of them where it is slow.
"""

import dataclasses

import onnx_ir as ir
import pytest

from me2e_compress.base.errors import Me2eError
from me2e_compress.graph import provenance
from me2e_compress.manager import PassManager, recipe
from me2e_compress.passes.fold_constants import FoldConstants
from me2e_compress.runtime.session import REFUSALS
from tests.passes import onnx_cases
from tests.passes.onnx_cases import Case
from tests.passes.small import NO_MODULES

pytestmark = pytest.mark.xdist_group("onnx-suite")

UNLIMITED = {"fold-constants": FoldConstants(bytes_per_node=1 << 40)}
PASSES = tuple(UNLIMITED.get(each.name, each) for each in recipe.load("exact"))
EXACT = PassManager(PASSES, verify_frames=0)
"""The recipe, folding whatever it costs; the cases bring inputs of their own."""

FAILURES: tuple[type[Exception], ...]
FAILURES = (*REFUSALS, Me2eError, RuntimeError, TypeError, ValueError)


Kind = tuple[tuple[object, ...], ...]
"""Node by node: operator, names of attributes, which inputs are given, outputs; and
the element types of the inputs."""


def kind_of(case: Case) -> Kind:
    """Say what a model is made of, whatever its numbers and shapes."""
    nodes = (
        (
            node.op_type,
            tuple(sorted(each.name for each in node.attribute)),
            tuple(map(bool, node.input)),
            len(node.output),
        )
        for node in case.model.graph.node
    )
    ports = [port.type for port in case.model.graph.input]
    types = tuple((p.WhichOneof("value"), p.tensor_type.elem_type) for p in ports)
    return (*nodes, types)


@dataclasses.dataclass
class Suite:
    """What came of the cases that onnxruntime runs, their inputs made constants.

    Attributes:
        ran: how many went through the passes.
        folded: those in which fold-constants found something.
        failed: what the passes broke.
        kinds: of which one has been through the passes; None if every case goes.
    """

    ran: int = 0
    folded: int = 0
    failed: list[str] = dataclasses.field(default_factory=list)
    kinds: set[Kind] | None = None

    def check(self, case: Case) -> None:
        try:
            before = onnx_cases.run(case)
        except REFUSALS:
            return
        if case.relabelled and onnx_cases.differs(case, before):
            return  # it means something else under the older opset
        if self.kinds is not None:
            if (kind := kind_of(case)) in self.kinds:
                return
            self.kinds.add(kind)
        self.ran += 1
        self.run_passes(onnx_cases.bake(dataclasses.replace(case, outputs=before)))

    def run_passes(self, case: Case) -> None:
        """Run the passes, then the graph that they leave."""
        model = ir.from_proto(case.model)
        for index, node in enumerate(model.graph.all_nodes()):
            # Nodes that say their module need no module map.
            node.name = node.name or f"n{index}"
            provenance.stamp(node, provenance.Provenance("all", (node.name,)))
        try:
            report = EXACT.run(model, NO_MODULES)
            steps = {step.name: step.changes for step in report.steps}
            self.folded += bool(steps["fold-constants"])
            after = ir.to_proto(report.model)
            result = onnx_cases.run(dataclasses.replace(case, model=after))
            fault = onnx_cases.differs(case, result) or onnx_cases.moved(case, result)
        except FAILURES as error:
            fault = f"{type(error).__name__} {str(error).splitlines()[0][:160]}"
        if fault is not None:
            self.failed.append(f"{case.name}: {fault}")


@pytest.fixture(
    scope="module", params=["kinds", pytest.param("cases", marks=pytest.mark.slow)]
)
def suite(request: pytest.FixtureRequest) -> Suite:
    result = Suite(kinds=set() if request.param == "kinds" else None)
    for case in filter(onnx_cases.has_numpys_types, onnx_cases.load()):
        result.check(case)
    return result


def test_every_case_goes_through_the_passes(suite: Suite) -> None:
    """Counted with onnx 1.23 and onnxruntime 1.31."""
    assert suite.failed == []
    assert suite.ran > (1500 if suite.kinds is None else 750)
    assert suite.folded >= (1400 if suite.kinds is None else 640)
