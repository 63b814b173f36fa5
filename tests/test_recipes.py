"""Recipes: as text and files; those that take a module from the driver or UniAD."""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import numpy.typing as npt
import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.base.errors import RecipeError
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.driving.onnx_policy import OnnxPolicy
from me2e_compress.graph import provenance
from me2e_compress.graph.modules.assign import detect
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.manager import PassManager, recipe
from me2e_compress.passes import Context, Pass, PassResult
from me2e_compress.runtime.session import Session, replay, run_once
from tests.support.installed import install
from tests.support.nets import net
from tests.support.stand_in import OUTPUTS, record_driver, write_model


@dataclass(frozen=True)
class Sample(Pass):
    """Does nothing.

    Given:   x
    Result:  x
    """

    name: ClassVar[str] = "sample"
    exact: ClassVar[bool] = True
    drop: tuple[str, ...] = ()
    limit: int = 512
    ratio: float = 0.5
    strict: bool = False
    fill: str = "zeros"
    means: Path | None = None

    def run(self, model: ir.Model, context: Context) -> PassResult:
        return PassResult(model, 0)


@pytest.fixture(autouse=True)
def known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    entry = {"sample": f"{__name__}:Sample"}
    install(monkeypatch, tmp_path, "a-package", "me2e_compress.passes", entry)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "has no .*pass"),
        ("[[pass]]\nname = 3 4\n", "is not TOML"),
        ('pass = ["exact"]\n', "has no .*pass"),
        ("pass = 1\n", "has no .*pass"),
        ('[[pass]]\nname = "nobody"\n', "no pass 'nobody'"),
        ('[[pass]]\ndrop = ["occ"]\n', "no pass ''"),
        ('scheme = "full"\n[[pass]]\nname = "sample"\n', "'scheme' stands beside"),
    ],
)
def test_a_bad_file_names_the_culprit(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "r.toml"
    path.write_text(text)
    with pytest.raises(RecipeError, match=message):
        recipe.load(path)


def test_an_unknown_recipe_lists_the_shipped_ones() -> None:
    with pytest.raises(RecipeError, match=r"no recipe none: .*exact, feature-ext, "):
        recipe.load("none")


@pytest.mark.parametrize("name", recipe.shipped())
def test_every_shipped_recipe_builds(name: str) -> None:
    assert recipe.load(name)


def test_a_file_that_a_recipe_names_lies_beside_the_recipe(tmp_path: Path) -> None:
    (tmp_path / "r.toml").write_text(
        '[[pass]]\nname = "sample"\nmeans = "sub/m.npz"\n'
        '[[pass]]\nname = "sample"\ndrop = ["occ"]\nmeans = "/m.npz"\n'
    )

    beside, absolute = recipe.load(tmp_path / "r.toml")

    assert beside == Sample(means=tmp_path / "sub" / "m.npz")
    assert absolute == Sample(("occ",), means=Path("/m.npz"))
    assert recipe.parse("sample{means=m.npz}") == (Sample(means=Path("m.npz")),)
    assert recipe.to_text([beside]) == f'sample{{means="{tmp_path}/sub/m.npz"}}'


MINUS = {"track": "agents", "map": "lanes", "motion": "motions", "occ": "occupancy"}
"""The output that goes with a module of the driver."""
TOGETHER = (*MINUS, "map-motion", "occ-motion", "occ-map", "occ-map-motion")

Without = Callable[[str, int], tuple[ir.Model, CalibrationSet]]


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_model(tmp_path_factory.mktemp("driver") / "m.onnx")


@pytest.fixture
def without(model: Path, tmp_path: Path) -> Without:
    """Take modules from it by the recipe, after so many frames."""

    def run(modules: str, count: int) -> tuple[ir.Model, CalibrationSet]:
        frames = CalibrationSet(record_driver(tmp_path / "f", count))
        loaded = graph.load(model)
        context = Context(detect(loaded), frames)
        passes = recipe.load(f"minus-{modules}")
        return PassManager(passes).run(loaded, context).model, frames

    return run


@pytest.mark.parametrize("modules", TOGETHER)
def test_modules_are_gone_with_their_outputs(
    model: Path, without: Without, modules: str
) -> None:
    made, _ = without(modules, 3)

    gone = modules.split("-")
    assert not {provenance.module_of(node) for node in made.graph} & {*gone}
    left = OUTPUTS.keys() - {MINUS[module] for module in gone}
    assert [v.name for v in made.graph.outputs] == [n for n in OUTPUTS if n in left]
    assert graph.interface(made)[0] == graph.interface(graph.load(model))[0]


def plans(model: ir.Model | Path, frames: CalibrationSet) -> npt.NDArray[np.float32]:
    answers = replay(Session(model), frames, ["plan"])
    return np.array([each["plan"] for each in answers], np.float32)


@pytest.mark.parametrize(("count", "least", "most"), [(1, 0, 1e-5), (4, 1e-3, 10)])
@pytest.mark.parametrize("module", MINUS)
def test_the_plan_moves_with_the_frames_the_mean_is_taken_over(
    model: Path, without: Without, module: str, count: int, least: float, most: float
) -> None:
    """The mean over one frame is that frame: there nothing moves."""
    made, frames = without(module, count)

    assert least <= np.abs(plans(made, frames) - plans(model, frames)).max() < most


def test_what_is_left_still_drives(without: Without, tmp_path: Path) -> None:
    path = tmp_path / "minus-occ.onnx"
    graph.save(without("occ", 2)[0], path)

    policy = OnnxPolicy.open(path)
    assert policy.recurrent == {
        "prev_bev": "prev_bev_out",
        "prev_memory": "prev_memory_out",
    }


Numbers = npt.NDArray[np.float32]

UNIAD = """
uniad (float[1,5,8] img, float[1,4,5] four, float[1,3,5] three, float[6,8] anchors,
       float[8,8] mix) =>
    (float[1,1,8] sdc_traj, float[1,3,8] lane_query, float[1,4,6,8] trajectories,
     float[1,3,5] occupancy)
<int64[1] one = {1}, int64[1] two = {2}, int64[1] first = {0}, int64[1] last = {3},
 int64 ego = {3}> {
    ["/img_backbone/Tanh"] bev = Tanh(img)
    ["/pts_bbox_head/transformer/decoder/layers.0/MatMul"] track = MatMul(four, bev)
    ["/seg_head/transformer/layers.0/MatMul"] lane_query = MatMul(three, bev)
    ["/motion_head/Unsqueeze"] each = Unsqueeze(track, two)
    ["/motion_head/Add"] asked = Add(each, anchors)
    ["/motion_head/ReduceMax"] seen = ReduceMax <axes = [1], keepdims = 1> (lane_query)
    ["/motion_head/motionformer/map_interaction_layers.0/Add"] m0 = Add(asked, seen)
    ["/motion_head/motionformer/map_interaction_layers.1/Add"] m1 = Add(m0, seen)
    ["/motion_head/motionformer/map_interaction_layers.2/Sin"] m2 = Sin(m1)
    ["/motion_head/Mul"] modes = Mul(asked, m2)
    ["/motion_head/Exp"] trajectories = Exp(modes)
    ["/motion_head/Cos"] pos = Cos(track)
    ["/occ_head/Slice"] some = Slice(modes, first, last, one)
    ["/occ_head/Slice_1"] placed = Slice(pos, first, last, one)
    ["/occ_head/mode_fuser/ReduceMax"]
        fused = ReduceMax <axes = [2], keepdims = 0> (some)
    ["/occ_head/multi_query_fuser/Add"] instances = Add(fused, placed)
    ["/occ_head/Transpose"] turned = Transpose <perm = [0, 2, 1]> (bev)
    ["/occ_head/MatMul"] occupancy = MatMul(instances, turned)
    ["/planning_head/Gather"] mine = Gather <axis = 1> (modes, ego)
    ["/planning_head/Gather_1"] own = Gather <axis = 1> (track, ego)
    ["/planning_head/Unsqueeze"] known = Unsqueeze(own, one)
    ["/planning_head/Add"] told = Add(mine, known)
    ["/planning_head/ReduceMax"] query = ReduceMax <axes = [1]> (told)
    ["/planning_head/bev_adapter/Sigmoid"] memory = Sigmoid(bev)
    ["/planning_head/attn_module/layers.0/Transpose"]
        keys = Transpose <perm = [0, 2, 1]> (memory)
    ["/planning_head/attn_module/layers.0/MatMul"] logits = MatMul(query, keys)
    ["/planning_head/attn_module/layers.0/Softmax"]
        weights = Softmax <axis = -1> (logits)
    ["/planning_head/attn_module/layers.0/MatMul_1"] found = MatMul(weights, memory)
    ["/planning_head/reg_branch/MatMul"] sdc_traj = MatMul(found, mix)
}
"""

SCHEMES = {
    **{1: "occ", 2: "map", 3: "motion"},
    **{4: "map motion", 5: "occ motion", 6: "occ map", 7: "occ map motion"},
}
HEADS = {"map": "lane_query", "motion": "trajectories", "occ": "occupancy"}
IMAGE = np.random.default_rng(1).normal(size=(1, 5, 8)).astype("f")


def weights() -> dict[str, Numbers]:
    noise = np.random.default_rng(0).normal(size=(8, 8)).astype("f")
    return {
        "four": noise[None, :4, :5],
        "three": noise[None, 4:7, :5],
        "anchors": noise[:6],
        "mix": noise,
    }


@functools.cache
def uniad() -> ir.Model:
    model = net(UNIAD, weights())
    for node in model.graph:
        node.metadata_props.clear()  # import-normalize finds the modules itself
    return model


def compressed(name: str) -> tuple[ir.Model, tuple[str, ...]]:
    """Return what a recipe makes, and what its ablation tells."""
    manager = PassManager(recipe.load(name), verify_frames=0)
    report = manager.run(uniad().clone(), Context(ModuleMap.load("uniad")))
    steps = [each for each in report.steps if each.name == "ablate-modules"]
    return report.model, sum((step.notes for step in steps), ())


def plan_of(model: ir.Model) -> Numbers:
    return run_once(model, {"img": IMAGE})["sdc_traj"].astype("f")


def planned(modes: Numbers, more: Numbers | None = None) -> Numbers:
    """The planner in numpy: six modes [6, 8] and the ego's own query to a plan."""
    bev = np.tanh(IMAGE[0])
    cells = 1 / (1 + np.exp(-bev))
    keys = cells if more is None else np.vstack([cells, more])
    logits = (modes + track()[3]).max(0, keepdims=True) @ keys.T
    share = np.exp(logits - logits.max(-1, keepdims=True))
    plan: Numbers = (share / share.sum(-1, keepdims=True)) @ keys @ weights()["mix"]
    return plan


def track() -> Numbers:
    found: Numbers = weights()["four"][0] @ np.tanh(IMAGE[0])
    return found


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_scheme_takes_its_modules_and_their_outputs(scheme: int) -> None:
    made, _ = compressed(f"uniad-scheme-{scheme}")

    gone = SCHEMES[scheme].split()
    assert not {provenance.module_of(node) for node in made.graph} & {*gone}
    assert {str(value.name) for value in made.graph.outputs} == {
        "sdc_traj",
        *(name for module, name in HEADS.items() if module not in gone),
    }


def test_without_occupancy_the_plan_keeps_its_bits() -> None:
    (without, _), (exact, _) = map(compressed, ("uniad-scheme-1", "exact"))
    np.testing.assert_array_equal(plan_of(without), plan_of(exact))


def test_without_the_map_layers_read_zeros() -> None:
    made, notes = compressed("uniad-scheme-2")

    asked = track()[3] + weights()["anchors"]
    np.testing.assert_allclose(plan_of(made)[0], planned(0 * asked), rtol=1e-4)
    assert "*.map_interaction_layers.2 reads as zeros" in notes


@pytest.mark.parametrize("scheme", [3, 4, 5, 7])
def test_without_motion_one_track_query_is_six_modes(scheme: int) -> None:
    made, notes = compressed(f"uniad-scheme-{scheme}")

    modes = np.repeat(track()[3:], 6, axis=0)
    np.testing.assert_allclose(plan_of(made)[0], planned(modes), rtol=1e-4)
    assert "planner reads track [1,4,8] in the place of modes [1,4,6,8]" in notes


def test_without_motion_occupancy_reads_tracks() -> None:
    made, notes = compressed("uniad-scheme-3")

    bev = np.tanh(IMAGE[0])
    found = run_once(made, {"img": IMAGE})["occupancy"][0]
    np.testing.assert_allclose(found, track()[:3] @ bev.T, rtol=1e-4)
    assert "pos reads as zeros" in notes


def test_direct_edges_end_at_the_planner() -> None:
    """Lanes, tracks and occupancy's queries stand behind the cells."""
    made, notes = compressed("uniad-direct-edges")

    bev = np.tanh(IMAGE[0])
    asked = track()[:, None] + weights()["anchors"]
    lanes = weights()["three"][0] @ bev
    modes = asked * np.sin(asked + 2 * lanes.max(0))
    instances = modes[:3].max(1) + np.cos(track()[:3])
    more = np.vstack([lanes, track(), instances])
    np.testing.assert_allclose(plan_of(made)[0], planned(modes[3], more), rtol=1e-4)
    assert len([note for note in notes if note.startswith("*.attn_module reads")]) == 3
