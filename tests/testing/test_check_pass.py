from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress import rewrite
from me2e_compress.errors import VerificationError
from me2e_compress.graph import provenance
from me2e_compress.passes import PASSES, Context, Pass, PassResult
from me2e_compress.passes.ablate_modules import AblateModules
from me2e_compress.registry import options_of
from me2e_compress.testing import check_pass
from tests.manager import passes

EXACT = [
    cls
    for cls in map(PASSES.get, PASSES.names())
    if cls.exact
    and "onnxsim" not in cls.name
    and all(option.default is not None for option in options_of(cls))
]


@pytest.mark.parametrize("cls", EXACT, ids=lambda cls: cls.name)
def test_our_exact_passes_hold(
    driver: ir.Model, context: Context, cls: type[Pass]
) -> None:
    assert check_pass(cls(), driver, context).model is not driver


def test_ablation_holds(driver: ir.Model, context: Context) -> None:
    assert check_pass(AblateModules(drop=("occ",)), driver, context).changes


@dataclass(frozen=True)
class DropsOneNegation(Pass):
    """Says it is done while there is more to do.

    Given:   x -> Neg -> Neg -> Neg
    Result:  x -> Neg -> Neg
    """

    name: ClassVar[str] = "drops-one-negation"
    exact: ClassVar[bool] = True

    def run(self, model: ir.Model, context: Context) -> PassResult:
        for node in model.graph:
            if node.op_type == "Neg" and not node.outputs[0].is_graph_output():
                node.outputs[0].replace_all_uses_with(node.inputs[0])  # type: ignore[arg-type]
                model.graph.remove(node, safe=True)
                return PassResult(model, 1)
        return PassResult(model, 0)


@dataclass(frozen=True)
class LeavesWhatIsUnread(Pass):
    """Bypass two negations, and leave both behind.

    Given:   x -> Neg -> Neg -> Neg
    Result:  x -> Neg
    """

    name: ClassVar[str] = "leaves-what-is-unread"
    exact: ClassVar[bool] = True

    def run(self, model: ir.Model, context: Context) -> PassResult:
        first, second, *_ = model.graph
        assert first.inputs[0] is not None
        second.outputs[0].replace_all_uses_with(first.inputs[0])
        return PassResult(model, 1)


NEGATIONS = """
<ir_version: 9, opset_import: ["" : 17]>
m (float[1,4] x) => (float[1,4] y) {
    ["/backbone/a"] a = Neg(x)
    ["/backbone/b"] b = Neg(a)
    ["/backbone/c"] c = Neg(b)
    ["/backbone/y"] y = Neg(c)
}
"""


def test_a_pass_that_is_not_idempotent_is_caught(context: Context) -> None:
    with pytest.raises(VerificationError, match="not idempotent"):
        check_pass(DropsOneNegation(), ir.from_onnx_text(NEGATIONS), context)


def test_a_second_run_that_claims_and_changes_nothing_is_explained(
    context: Context,
) -> None:
    words = r"on its second run, .* claims 1 change but made none; .*remove_dead"
    with pytest.raises(VerificationError, match=words):
        check_pass(LeavesWhatIsUnread(), ir.from_onnx_text(NEGATIONS), context)


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (passes.Idle(), "docstring lacks Given: and Result:"),
        (passes.Forgets(), "docstring lacks Given: and Result:"),
    ],
)
def test_a_pass_without_given_and_result_is_caught(
    driver: ir.Model, context: Context, bad: Pass, message: str
) -> None:
    with pytest.raises(VerificationError, match=message):
        check_pass(bad, driver, context)


class Loose(Pass):
    """Has lost its decorator.

    Given:   x
    Result:  x
    """

    name: ClassVar[str] = "loose"
    exact: ClassVar[bool] = True
    limit: int = 3

    def run(self, model: ir.Model, context: Context) -> PassResult:
        return PassResult(model, 0)


def test_a_pass_that_is_not_frozen_is_caught(
    driver: ir.Model, context: Context
) -> None:
    with pytest.raises(VerificationError, match="Loose is not a frozen dataclass"):
        check_pass(Loose(), driver, context)


def test_a_wrong_exact_pass_is_caught(context: Context) -> None:
    @dataclass(frozen=True)
    class Wrong(passes.TurnsTanhIntoSigmoid):
        """Wrong.

        Given:   Tanh
        Result:  Sigmoid
        """

    text = NEGATIONS.replace("c = Neg(b)", "c = Tanh(b)")
    with pytest.raises(VerificationError, match="moved the outputs"):
        check_pass(Wrong(), ir.from_onnx_text(text), context)


SOFTENED = """
<ir_version: 9, opset_import: ["" : 17]>
m (float[1,4] x) => (float[1,4] y) {
    a = Relu(x)
    y = Neg(a)
}
"""


@dataclass(frozen=True)
class ReplacesRelu(Pass):
    """Replaces Relu by Max with 0, and says of the new nodes what it is told to.

    Given:   Relu(x)
    Result:  Max(x, 0)

    Attributes:
        by: the pass that they name.
        origins: the nodes that they stand for; none for the true ones.
    """

    name: ClassVar[str] = "replaces-relu"
    exact: ClassVar[bool] = True
    by: str = "replaces-relu"
    origins: tuple[str, ...] = ()

    def run(self, model: ir.Model, context: Context) -> PassResult:
        found = [node for node in model.graph if node.op_type == "Relu"]
        for node in found:
            zero = rewrite.add_constant(model.graph, np.zeros(1, np.float32), "zero")
            new = rewrite.put(node, "Max", [node.inputs[0], zero], by=self.by)
            past = provenance.read(new)
            if self.origins and past is not None:
                provenance.stamp(new, replace(past, origins=self.origins))
        return PassResult(model, len(found))


def test_a_graph_of_no_known_stack_is_one_module() -> None:
    result = check_pass(ReplacesRelu(), ir.from_onnx_text(SOFTENED))
    assert {provenance.module_of(node) for node in result.model.graph} == {"model"}


def test_new_nodes_that_name_another_pass_are_caught() -> None:
    with pytest.raises(VerificationError, match="1 nodes that do not name it among"):
        check_pass(ReplacesRelu(by="fuse-basic"), ir.from_onnx_text(SOFTENED))


def test_origins_that_never_were_are_caught() -> None:
    with pytest.raises(VerificationError, match="1 nodes stand for nodes that never"):
        check_pass(ReplacesRelu(origins=("/a/Relu",)), ir.from_onnx_text(SOFTENED))
