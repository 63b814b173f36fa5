"""What readers of a dropped module read: zeros, substitutes, means."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.base.errors import FramesError, ModuleMapError, PreconditionError
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.graph import provenance
from me2e_compress.passes.ablate_modules import AblateModules
from me2e_compress.runtime.session import run_once
from tests.passes.ablated import (
    CAMERA,
    NO_AGENTS,
    NO_MAP,
    SIZED,
    STACK,
    context,
    plan_of,
    substitute,
)
from tests.passes.small import ops
from tests.support.frames import record
from tests.support.nets import net


@pytest.fixture
def stack() -> ir.Model:
    return net(STACK, {})


def test_readers_of_a_dropped_module_read_zeros(stack: ir.Model) -> None:
    result = NO_AGENTS.run(stack, context())

    assert "Abs" not in ops(result.model)
    assert plan_of(result.model) == np.exp(np.array([0, 0, -4, -9], "f")).tolist()
    assert "agents reads as zeros" in result.notes
    assert not provenance.missing(result.model)


ZEROS = AblateModules(drop=("map",), fill="zeros", drop_outputs=True)
MEETS = substitute("*.look", "*.meet")


@pytest.mark.parametrize(
    ("chosen", "substitutes", "plan", "note"),
    [
        (NO_MAP, "", [1, 1, 3, 4], "output removed: lanes"),
        (NO_MAP, MEETS, [0, 0, 4, 6], "*.look replaced by *.meet"),
        (NO_MAP, substitute("*.look"), [0, 0, 2, 3], "output removed: lanes"),
        (ZEROS, MEETS, [1, 1, 3, 4], "output removed: lanes"),  # left aside
    ],
)
def test_a_substitute_takes_the_place_of_a_scope(
    stack: ir.Model, chosen: AblateModules, substitutes: str, plan: list[int], note: str
) -> None:
    result = chosen.run(stack, context(substitutes))

    assert [value.name for value in result.model.graph.outputs] == ["plan"]
    assert plan_of(result.model) == plan
    assert note in result.notes


def test_a_substitute_of_the_same_elements_is_reshaped(stack: ir.Model) -> None:
    text = STACK.replace("met = Sqrt(agents)", "met0 = Sqrt(agents)").replace(
        '["/planner/Add"]', '["/planner/meet/Reshape"] met = Reshape(met0, long)\n'
        '["/planner/Add"]'
    )  # fmt: skip
    text = text.replace("int64[2] flat", "int64[3] long = {1, 1, 4}, int64[2] flat")
    text = text.replace("float[1,4] plan", "float[1,1,4] plan")

    result = NO_MAP.run(net(text, {}), context(substitute("*.look", "*.meet")))

    run = run_once(result.model, {"camera": CAMERA})["plan"]
    np.testing.assert_array_equal(run, [[[0, 0, 4, 6]]])


OPEN = STACK.replace("float[1,4] camera", "float[n,4] camera")
NEITHER = replace(NO_MAP, drop=("map", "agents"))


@pytest.mark.parametrize(
    ("chosen", "substitutes", "message"),
    [
        (AblateModules(drop=("map",)), "", r"map makes the outputs lanes: .*true"),
        (replace(NO_MAP, drop=("map", "planner")), "", "every output: plan, lanes"),
        (NO_MAP, substitute("*.nowhere", "*.meet"), r"leaves a scope \*\.nowhere"),
        (NO_MAP, substitute("*.look", "*.nowhere"), r"leaves a scope \*\.nowhere"),
        (NO_MAP, substitute("*.look", "map"), "nothing that leaves map fits ego_map"),
        (NO_MAP, substitute("agents", "*.meet"), "for agents: it reads its result"),
        (NEITHER, substitute("*.look", "agents"), "of module agents, which is dropped"),
    ],
)
def test_what_does_not_fit_the_graph_is_refused(
    stack: ir.Model, chosen: AblateModules, substitutes: str, message: str
) -> None:
    with pytest.raises(PreconditionError, match=message):
        chosen.run(stack, context(substitutes))


@pytest.mark.parametrize(
    ("chosen", "text", "error", "message"),
    [
        (NO_AGENTS, OPEN, PreconditionError, r"agents has shape .*fold-constants"),
        (NO_MAP, SIZED, PreconditionError, "size is arithmetic on shapes"),
        (replace(NO_AGENTS, fill="means"), STACK, FramesError, "needs recorded frame"),
    ],
)
def test_a_value_that_nobody_can_fill_in_is_refused(
    chosen: AblateModules, text: str, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        chosen.run(net(text, {}), context())


def test_a_kept_scope_stays(stack: ir.Model) -> None:
    with pytest.raises(PreconditionError, match="keeps all of planner: nothing is"):
        AblateModules(drop=("planner",), keep=("planner",)).run(stack, context())
    with pytest.raises(PreconditionError, match=r"no value leaves a scope \*\.lane"):
        AblateModules(drop=("agents",), keep=("*.lane",)).run(stack, context())


def test_unknown_and_absent_modules_are_named(stack: ir.Model) -> None:
    with pytest.raises(ModuleMapError, match=r"occ: .*backbone, agents, map, planner"):
        AblateModules(drop=("occ",)).run(stack, context())
    once = NO_AGENTS.run(stack, context()).model
    with pytest.raises(PreconditionError, match=r"module agents; .*backbone, map, pl"):
        NO_AGENTS.run(once, context())


SHARED = STACK.replace(
    '["/map/Neg"] m = Neg(f)',
    '["/map/Cast"] c = Cast <to = 1> (f)\n["/map/Flatten"] g = Flatten(c)\n'
    '["/map/Neg"] m = Neg(g)',
).replace("met = Sqrt(agents)", "met = Add(agents, g)")


def test_a_cast_that_another_module_shares_stays() -> None:
    """The planner reads features through a cast and a reshape in the map's scope."""
    result = NO_MAP.run(net(SHARED, {}), context())

    assert plan_of(result.model) == [1, 1, 9, 19]
    assert {provenance.module_of(node) for node in result.model.graph} == {
        *("backbone", "agents", "planner")
    }
    assert [note for note in result.notes if "g reads" in note] == []
    # lanes is a reshape too, of what the map itself made
    assert "lanes reads as zeros" in NO_MAP.run(net(STACK, {}), context()).notes


@pytest.fixture
def recording(tmp_path: Path) -> CalibrationSet:
    """Two cameras; agents (their magnitude where positive) average 1, 0, 3, 6."""
    cameras = ([[2, 0, 2, 3]], [[-2, 0, 4, 9]])
    frames = [{"camera": np.array(camera, np.float32)} for camera in cameras]
    return CalibrationSet(record(tmp_path / "frames", frames))


def test_readers_read_the_mean_over_the_frames(recording: CalibrationSet) -> None:
    chosen = AblateModules(drop=("agents",), fill="means")

    result = chosen.run(net(STACK, {}), replace(context(), frames=recording))

    met = np.sqrt(np.array([1, 0, 3, 6], "f"))
    alone = np.exp(np.array([0, 0, -4, -9], "f"))
    np.testing.assert_allclose(plan_of(result.model), met + alone, rtol=1e-6)
    assert "agents reads as its mean over 2 frames" in result.notes
    assert "Abs" not in ops(result.model)
    assert not provenance.missing(result.model)


def test_shapes_have_no_mean(recording: CalibrationSet) -> None:
    with pytest.raises(PreconditionError, match="size is arithmetic on shapes"):
        replace(NO_MAP, fill="means").run(
            net(SIZED, {}), replace(context(), frames=recording)
        )
