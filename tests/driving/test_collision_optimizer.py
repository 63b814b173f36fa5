from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from scipy.optimize import check_grad

from me2e_compress.base.errors import EvaluationError
from me2e_compress.driving.host_stage import HOST_STAGES, CollisionOptimizer, cost
from me2e_compress.driving.latency import parse_latency
from me2e_compress.driving.policies import driver_named
from me2e_compress.evaluators import Drive
from me2e_compress.evaluators.highway.drivers import OnnxDriver
from me2e_compress.evaluators.highway.runner import drive
from me2e_compress.testing import check_form
from tests.evaluators.highway.drivers import PARKED, straight_on

Floats = npt.NDArray[np.float64]

PLAN: Floats = np.array([(4.0 * step, 0.0) for step in range(1, 7)])


def taken(*cells: tuple[int, float, float]) -> dict[str, Floats]:
    """Give occupancy with cells taken: waypoint, x and y of the centre."""
    occupancy = np.zeros((1, 6, 64, 48))
    for step, x, y in cells:
        occupancy[0, step, int(47.5 - x), int(23.5 - y)] = 0.9
    return {"occupancy": occupancy}


def test_only_cells_near_the_waypoint_of_their_time_count() -> None:
    free = CollisionOptimizer().work(PLAN, taken())
    assert free.plan is PLAN
    assert (free.iterations, free.cells) == (0, 0)
    beside, late, far = (1, 8.5, 1.5), (5, 8.5, 1.5), (1, 8.5, 6.5)
    work = CollisionOptimizer().work(PLAN, taken(beside, late, far))

    assert work.cells == 1
    assert work.iterations > 0
    assert work.plan[[0, 2, 3, 4, 5]] == pytest.approx(PLAN[[0, 2, 3, 4, 5]], abs=1e-3)
    assert work.plan[1, 1] < -0.5, "the waypoint moves off, to the other side"


@pytest.mark.parametrize("solver", ["SLSQP", "L-BFGS-B"])
def test_the_minimum_does_not_depend_on_the_solver(solver: str) -> None:
    cells = [(step, 4.5 + 4 * step, 0.5) for step in range(6)]
    stage = HOST_STAGES.build("collision-optimizer", {"solver": solver})

    work = stage.work(PLAN, taken(*cells))

    moved = np.hypot(*(work.plan - PLAN).T)
    away = moved + np.hypot(0.5, 0.5)  # where both pulls are equal
    pushed = 5.0 * 4.0 / np.sqrt(2 * np.pi) * away * np.exp(-(away**2) / 2)
    assert 2.0 * moved == pytest.approx(pushed, abs=1e-3)
    assert moved == pytest.approx([1.213] * 6, abs=1e-3)


def test_the_gradient_is_that_of_the_cost() -> None:
    rng = np.random.default_rng(1)
    step = rng.integers(0, 6, 40)
    cells = PLAN[step] + rng.normal(0, 2, (40, 2))
    start = PLAN.ravel() + rng.normal(0, 1, 12)

    def value(flat: Floats) -> float:
        return cost(flat, PLAN, cells, step, 1.0, 20.0)[0]

    def gradient(flat: Floats) -> Floats:
        return cost(flat, PLAN, cells, step, 1.0, 20.0)[1]

    assert check_grad(value, gradient, start) < 1e-4


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("radius_m=0", "radius_m: Input should be greater than 0"),
        ("threshold=1", "threshold: Input should be less than 1"),
        ("solver=IPOPT", "solver: Input should be 'SLSQP'"),
    ],
)
def test_it_has_the_form_of_a_host_stage_and_checks_options(
    text: str, words: str
) -> None:
    check_form(CollisionOptimizer(radius_m=4.0), HOST_STAGES)
    with pytest.raises(EvaluationError, match=words):
        HOST_STAGES.parse(f"collision-optimizer{{{text}}}")


@pytest.mark.parametrize(
    ("policy", "words"),
    [
        ("blind{host_stage=collision-optimizer}", "blind has no option 'host_stage'"),
        ("onnx{path=m.onnx, host_stage=smoother}", "no host stage 'smoother'"),
    ],
)
def test_a_stage_that_does_not_fit_is_refused_before_anything_drives(
    policy: str, words: str
) -> None:
    with pytest.raises(EvaluationError, match=words):
        driver_named(policy)


def test_a_model_without_the_output_is_named_when_it_is_opened(tmp_path: Path) -> None:
    driver = OnnxDriver(
        straight_on(tmp_path / "m.onnx"), host_stage=CollisionOptimizer()
    )

    with pytest.raises(EvaluationError, match=r"m.onnx: .* no output occupancy; there"):
        driver.open()


def test_a_host_stage_is_part_of_what_identifies_a_driver(tmp_path: Path) -> None:
    model = straight_on(tmp_path / "m.onnx")
    plain = OnnxDriver(model).fingerprint()
    staged = OnnxDriver(model, host_stage=CollisionOptimizer()).fingerprint()

    assert staged.startswith(f"{plain}+collision-optimizer{{")
    assert "radius_m=5.0" in staged


def test_what_it_does_is_charged_where_it_has_something_to_do(tmp_path: Path) -> None:
    """The model says that all ground is taken for two seconds, and none after."""
    model = straight_on(
        tmp_path / "m.onnx",
        inputs="float[1] timestamp",
        body="""two = Constant <value_floats = [2.0]> ()
        shape = Constant <value_ints = [1, 1, 64, 48]> ()
        early = Less (timestamp, two)
        taken = Cast <to = 1> (early)
        occupancy = Expand (taken, shape)
        plan = Identity (ahead)""",
        outputs="float[1, 6, 2] plan, float[1, 1, 64, 48] occupancy",
    )
    policy = OnnxDriver(model, host_stage=CollisionOptimizer()).open()
    source = parse_latency("host-stage{source=fps:10, per_iteration_us=1000}")

    decisions = drive(PARKED, policy, Drive(source)).decisions

    more = [decision.time_us for decision in decisions if decision.latency_us > 100_000]
    assert more == [
        decision.time_us for decision in decisions if decision.time_us < 2_000_000
    ]
    assert 10 < len(more) < len(decisions)
