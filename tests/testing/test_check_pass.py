from dataclasses import dataclass
from typing import ClassVar

import onnx_ir as ir
import pytest

from me2e_compress.base.errors import VerificationError
from me2e_compress.base.registry import options_of
from me2e_compress.graph import provenance
from me2e_compress.passes import PASSES, Context, Pass, PassResult
from me2e_compress.passes.ablate_modules import AblateModules
from me2e_compress.testing import check_pass
from tests.manager import passes
from tests.support.nets import parsed

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
m (float[1,4] x) => (float[1,4] y) {
    ["/backbone/a"] a = Neg(x)
    ["/backbone/b"] b = Neg(a)
    ["/backbone/c"] c = Neg(b)
    ["/backbone/y"] y = Neg(c)
}
"""


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


@dataclass(frozen=True)
class Wrong(passes.TurnsTanhIntoSigmoid):
    """Wrong.

    Given:   Tanh
    Result:  Sigmoid
    """


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (DropsOneNegation(), "not idempotent"),
        (
            LeavesWhatIsUnread(),
            r"on its second run, .* claims 1 change but made none; .*remove_dead",
        ),
        (passes.IDLE, "docstring lacks Given: and Result:"),
        (Loose(), "Loose is not a frozen dataclass"),
        (Wrong(), "moved the outputs"),
    ],
)
def test_a_wrong_pass_is_caught(wrong: Pass, message: str, context: Context) -> None:
    tanh = isinstance(wrong, Wrong)
    text = NEGATIONS.replace("c = Neg(b)", "c = Tanh(b)") if tanh else NEGATIONS
    with pytest.raises(VerificationError, match=message):
        check_pass(wrong, parsed(text), context)


SOFTENED = """
m (float[1,4] x) => (float[1,4] y) {
    a = Relu(x)
    y = Neg(a)
}
"""


def test_a_graph_of_no_known_stack_is_one_module() -> None:
    result = check_pass(PASSES.build("fuse-basic", {}), parsed(SOFTENED))
    assert {provenance.module_of(node) for node in result.model.graph} == {"model"}
