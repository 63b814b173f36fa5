"""Transactions: what a pass is given, what is checked, and what a report says."""

from pathlib import Path

import numpy as np
import onnx
import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.base.errors import GraphError, PassError, VerificationError
from me2e_compress.graph import provenance, shapes
from me2e_compress.manager import PassManager, Report, attempt
from me2e_compress.passes.base import Context, Pass
from me2e_compress.passes.eliminate_redundant import EliminateRedundant
from me2e_compress.passes.fold_constants import FoldConstants
from me2e_compress.passes.import_normalize import ImportNormalize
from me2e_compress.runtime.frames import Frames
from tests.manager import passes
from tests.support.nets import parsed

CHAIN = """
chain (float[1,8] x) => (float[1,8] y)
<float[8] w = {1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0}> {
    ["/backbone/Mul"] a = Mul(x, w)
    ["/backbone/Sigmoid"] b = Sigmoid(a)
    ["/backbone/Relu"] c = Relu(b)
    ["/occ_head/Neg"] d = Neg(c)
    ["/occ_head/Abs"] e = Abs(d)
    ["/occ_head/Tanh"] f = Tanh(e)
    ["/plan_head/Exp"] g = Exp(f)
    ["/plan_head/Add"] y = Add(g, f)
}
"""


@pytest.fixture
def chain() -> ir.Model:
    return parsed(CHAIN)


def run(
    model: ir.Model, context: Context, *chosen: Pass, folder: Path | None = None
) -> Report:
    return PassManager(chosen, reproducers=folder).run(model, context)


def test_steps_say_what_their_passes_did(chain: ir.Model, context: Context) -> None:
    before = graph.digest(chain)
    report = run(chain, context, passes.DROPS_RELU, passes.IDLE)
    assert graph.digest(chain) == before  # the given model stays as it is
    step = report.steps[1]
    assert (step.name, step.changes) == ("drops-relu-of-sigmoid", 1)
    assert step.after.weight_bytes == 8 * 4
    sizes = [(step.before.nodes, step.after.nodes) for step in report.steps]
    assert sizes == [(8, 8), (8, 7), (7, 7)]
    (check,) = report.verifications
    assert check.errors == {"y": 0.0}
    assert check.inputs == "synthetic"
    modules = [provenance.module_of(node) for node in report.model.graph]
    assert modules == ["backbone"] * 2 + ["occ"] * 3 + ["planner"] * 2


def test_a_pass_finds_the_shapes_of_all_values(
    chain: ir.Model, context: Context
) -> None:
    shapes = set[str]()

    def look(model: ir.Model) -> int:
        values = [value for node in model.graph for value in node.outputs]
        shapes.update(str(value.shape) for value in values)
        return 0

    run(chain, context, passes.DROPS_RELU, passes.Sample("looks", look))
    assert shapes == {"[1,8]"}


def test_import_is_put_in_front_once(chain: ir.Model, context: Context) -> None:
    once = run(chain, context, passes.IDLE)
    again = run(once.model, context, passes.IDLE)
    assert [step.name for step in once.steps] == ["import-normalize", "idle"]
    assert [step.name for step in again.steps] == ["idle"]


def test_a_lossy_pass_starts_a_new_stretch(chain: ir.Model, context: Context) -> None:
    report = run(chain, context, passes.IDLE, passes.HALVES, passes.DROPS_RELU)
    assert [check.passes for check in report.verifications] == [
        ("import-normalize",),
        ("drops-relu-of-sigmoid",),
    ]
    assert all(check.errors == {"y": 0.0} for check in report.verifications)


def test_the_guilty_pass_is_found_among_others(
    chain: ir.Model, context: Context
) -> None:
    suspects = (
        passes.IDLE,
        passes.DROPS_RELU,
        passes.TurnsTanhIntoSigmoid(),
        passes.IDLE,
    )
    with pytest.raises(VerificationError, match=r"^turns-tanh-into-sigmoid promises"):
        run(chain, context, *suspects)


def test_the_reproducer_is_small_and_reproduces(
    chain: ir.Model, context: Context, tmp_path: Path
) -> None:
    with pytest.raises(VerificationError, match=r"reproducer \(1 nodes\)"):
        run(chain, context, passes.TurnsTanhIntoSigmoid(), folder=tmp_path)
    (folder,) = tmp_path.iterdir()
    piece = graph.load(folder / "model.onnx")
    assert [node.op_type for node in piece.graph] == ["Tanh"]
    assert (folder / "pipeline.txt").read_text() == "turns-tanh-into-sigmoid\n"
    with pytest.raises(VerificationError, match="turns-tanh-into-sigmoid"):
        run(piece, context, passes.TurnsTanhIntoSigmoid())


def test_a_broken_pass_is_named_with_its_cause_and_leaves_a_reproducer(
    chain: ir.Model, context: Context, tmp_path: Path
) -> None:
    words = r"breaks broke: KeyError.*reproducer \(1 nodes\)"
    with pytest.raises(PassError, match=words) as caught:
        run(chain, context, passes.BREAKS, folder=tmp_path)
    assert isinstance(caught.value.__cause__, KeyError)
    (folder,) = tmp_path.iterdir()
    assert "KeyError" in (folder / "why.txt").read_text()


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (passes.RENAMES_OUTPUT, "renames-output changed the interface"),
        (passes.CLAIMS_TOO_MUCH, "claims-too-much claims 3 changes but made none"),
        (passes.DENIES_IT, "denies-it changed the graph and denies it"),
        (passes.FORGETS, "forgets lost where 1 nodes come from, /backbone/Mul"),
        (passes.INVALIDATES, "invalidates left an invalid graph"),
        (passes.LEAVES_NO_NAME, "1 nodes that do not name it among their passes"),
        (passes.MAKES_UP_A_PAST, "1 nodes stand for nodes that never were, /backbone"),
    ],
    ids=lambda value: getattr(value, "name", ""),
)
def test_a_breach_of_contract_is_named(
    chain: ir.Model, context: Context, bad: Pass, message: str
) -> None:
    with pytest.raises(VerificationError, match=message):
        run(chain, context, bad)


def test_two_runs_give_the_same_bytes(chain: ir.Model, context: Context) -> None:
    first, second = (
        ir.to_proto(run(chain, context, passes.DROPS_RELU).model) for _ in range(2)
    )
    assert first.SerializeToString() == second.SerializeToString()


def test_progress_counts_the_passes(chain: ir.Model, context: Context) -> None:
    seen: list[tuple[int, int, str]] = []
    PassManager((passes.IDLE,)).run(
        chain, context, lambda done, total, what: seen.append((done, total, what))
    )
    assert seen == [(0, 2, "import-normalize"), (1, 2, "idle"), (2, 2, "verify")]


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_equal_non_numbers_are_equal(value: float, context: Context) -> None:
    literal = "nan" if np.isnan(value) else "inf"
    model = parsed(
        "m (float[2] x) => (float[2] y)\n<float[1] w = {0.0}> {"
        ' ["/backbone/Add"] y = Add(x, w) }'
    )
    data = np.array([value], np.float32)
    model.graph.initializers["w"].const_value = ir.tensor(data, name="w")
    (check,) = run(model, context, passes.IDLE).verifications
    assert check.errors == {"y": 0.0}, literal


def test_a_pass_s_graph_is_written_once_for_checker_and_inference(
    context: Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[ir.Model] = []
    plainly = shapes.without_weights

    def noted(model: ir.Model) -> onnx.ModelProto:
        written.append(model)
        return plainly(model)

    for home in (shapes, attempt):
        monkeypatch.setattr(home, "without_weights", noted)
    monkeypatch.setattr("me2e_compress.graph.validity.without_weights", noted)
    chosen = (passes.DROPS_RELU,)
    PassManager(chosen, verify_frames=0).run(parsed(CHAIN), context)

    assert len(written) == 3  # as given, imported, rewritten


def test_a_graph_that_kills_its_process_is_refused_before_it_is_run(
    context: Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuses(model: ir.Model, name: str, frames: Frames | None) -> None:
        raise GraphError(f"{name} kills {frames}")

    def opens(*_: object, **__: object) -> None:
        raise AssertionError("a session was opened")

    monkeypatch.setattr("me2e_compress.manager.verification_inputs.Session", opens)
    manager = PassManager((passes.DROPS_RELU,), try_first=refuses)
    with pytest.raises(GraphError, match="the graph after drops-relu-of-sigmoid kills"):
        manager.run(parsed(CHAIN), context)


@pytest.mark.parametrize("known", [False, True], ids=["fresh", "with a past"])
@pytest.mark.parametrize(
    "body",
    [
        "a = Relu(x) y = Neg(a)",
        '["/backbone/n"] a = Relu(x) ["/backbone/n"] y = Neg(a)',
        '["/backbone/a"] a = Cast<to = 11>(x) ["/backbone/y"] y = Cast<to = 1>(a)',
        '["/backbone/a"] a = RotateTRT(x) ["/backbone/y"] y = Neg(a)',
    ],
    ids=["no names", "one name twice", "float64", "plugin"],
)
def test_a_graph_is_imported_as_exporters_leave_it(
    body: str, known: bool, context: Context
) -> None:
    model = parsed(
        f'm (float[1,8] x) => (float[1,8] y) {{ ["/backbone/b"] b = Abs(x) {body} }}'
    )
    for node in model.graph if known else ():
        provenance.stamp(node, provenance.Provenance("backbone", (str(node.name),)))
    report = PassManager((ImportNormalize(),)).run(model, context)
    assert report.steps[0].changes > 0


def test_a_graph_may_hold_text(context: Context) -> None:
    model = parsed(
        '<ir_version: 9, opset_import: ["" : 20]>\n'
        "m (string[2] x) => (string[2] y) {"
        ' unit = Constant<value_strings = ["m", "s"]>()'
        ' again = Constant<value_strings = ["m", "s"]>()'
        ' a = StringConcat(x, unit) ["/backbone/y"] y = StringConcat(a, again) }'
    )
    passes = (ImportNormalize(), FoldConstants(), EliminateRedundant())
    report = PassManager(passes).run(model, context)
    assert len(report.model.graph.initializers) == 1


def test_an_output_that_is_a_sequence_is_not_compared(context: Context) -> None:
    model = parsed(
        "m (float[1,8] x) => (seq(float[1,4]) y) <int64[2] parts = {4, 4}> {"
        ' ["/backbone/a"] y = SplitToSequence<axis = 1>(x, parts) }'
    )
    (check,) = PassManager((ImportNormalize(),)).run(model, context).verifications
    assert check.skipped == "output y is no tensor: not compared"
