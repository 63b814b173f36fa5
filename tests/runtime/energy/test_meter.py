"""The meter finds what a device takes, in turn, and refuses a counter that fails."""

from dataclasses import replace
from itertools import groupby

import pytest

from me2e_compress.errors import EnergyError
from me2e_compress.runtime.energy.energy_counter import EnergySchedule
from me2e_compress.runtime.energy.energy_result import EnergyResult
from me2e_compress.runtime.energy.meter import EnergyMeter
from tests.runtime.energy.world import World

SCHEDULE = EnergySchedule(
    warm_up_s=2, window_s=2, window_frames=10, windows=6, idle_s=2
)


def meter(
    world: World, schedule: EnergySchedule = SCHEDULE, *, seldom: int = 1
) -> EnergyMeter:
    """A meter in the world's time, which samples power so many times more seldom."""
    return EnergyMeter(
        world,
        schedule,
        clock=world.clock,
        sleep=world.sleep,
        every=lambda period, call: world.every(seldom * period, call),
    )


def measured(world: World, frame_s: float = 0.03, watts: float = 300) -> EnergyResult:
    return meter(world).measure({"m": world.model("m", frame_s, watts)})["m"]


def test_joules_windows_and_the_device_are_told() -> None:
    found = measured(World())

    assert (found.low or 10) <= 9.0 <= (found.high or 0)
    assert found.j_per_frame == pytest.approx(9.0, rel=0.03)
    assert found.net_j_per_frame == pytest.approx(7.5, rel=0.05)
    assert found.idle_w == pytest.approx(50, rel=0.1)
    # as the schedule says
    assert (found.windows, found.frames) == (6, 6 * 67)
    assert found.window_s == pytest.approx(2.01, abs=0.02)
    assert found.counter_step_s == 0.1
    said = found.counter, found.device, found.scope
    assert said == ("simulated", "a device", "board")
    first, last = found.temperature or (1, 0)
    assert first < last
    assert found.clocks["sm"][0] < found.clocks["sm"][1]


def test_models_take_turns_there_and_back() -> None:
    world = World()
    found = meter(world).measure(
        {"a": world.model("a", 0.03, 300), "b": world.model("b", 0.04, 100)}
    )

    after = [name for name, at in world.worked if at > 6.5]  # idle and warm-up
    assert "".join(name for name, _ in groupby(after)) == "abababa"
    assert found["a"].j_per_frame == pytest.approx(9.0, rel=0.03)
    assert found["b"].j_per_frame == pytest.approx(4.0, rel=0.03)


def test_a_drift_falls_on_all_models_alike() -> None:
    world = World()
    world.drift = 0.01  # a third more at the end
    found = meter(world).measure(
        {"a": world.model("a", 0.03, 300), "b": world.model("b", 0.03, 150)}
    )

    a, b = found["a"], found["b"]
    assert a.j_per_frame is not None
    assert b.j_per_frame == pytest.approx(a.j_per_frame / 2, rel=0.02)
    assert a.window_j_per_frame[-1] > 1.2 * a.window_j_per_frame[0]
    assert (a.high or 0) - (a.low or 0) < 0.05 * a.j_per_frame


def test_power_alone_is_integrated() -> None:
    world = World(tells_power=True)
    world.counts = False

    assert measured(world).j_per_frame == pytest.approx(9.0, rel=0.01)
    assert world.readings == 0


@pytest.mark.parametrize(("factor", "alerts"), [(1.0, 0), (1.2, 1)])
def test_power_stands_beside_the_counter(factor: float, alerts: int) -> None:
    world = World(tells_power=True)
    world.power_factor = factor
    found = measured(world)

    assert found.power_j_per_frame == pytest.approx(9.0 * factor, rel=0.01)
    assert len(found.alerts()) == alerts


def test_power_alone_that_is_read_too_seldom_is_an_error() -> None:
    world = World(tells_power=True)
    world.counts = False

    with pytest.raises(EnergyError, match="power was read 10 times"):
        meter(world, seldom=10).measure({"m": world.model("m", 0.03, 300)})


def test_power_that_is_read_too_seldom_spoils_no_counter() -> None:
    world = World(tells_power=True)
    found = meter(world, seldom=10).measure({"m": world.model("m", 0.03, 300)})["m"]

    assert found.j_per_frame == pytest.approx(9.0, rel=0.03)
    assert found.power_j_per_frame is None


@pytest.mark.parametrize("frame_s", [0.013, 0.05, 0.1])
def test_a_counter_that_looks_part_of_the_time_is_held(frame_s: float) -> None:
    parts = (0.7 * frame_s, 300, 0.3 * frame_s, 100)
    held = 0
    for seed in range(25):
        world, schedule = World(sensed=0.25), replace(SCHEDULE, seed=seed, idle_s=10)
        model = world.model("m", *parts)
        found = meter(world, schedule).measure({"m": model})["m"]
        held += (found.low or 1e9) <= 240 * frame_s <= (found.high or 0)

    assert held >= 21  # of 25 at 95 %, 1 time in 200 fewer


def test_a_counter_that_stands_still_is_an_error() -> None:
    world = World()
    world.joules = lambda: 7.0  # type: ignore[method-assign]

    with pytest.raises(EnergyError, match="simulated of a device stands still at 7 J"):
        measured(world)


def test_a_counter_that_goes_back_is_an_error() -> None:
    world = World()
    world.joules = lambda: 900.0 - world.now  # type: ignore[method-assign]

    with pytest.raises(EnergyError, match="simulated of a device went back from"):
        measured(world)


def test_the_seed_decides_the_phases() -> None:
    assert measured(World()) == measured(World())


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"windows": 4}, "4 windows: at least 5"),
        ({"window_s": 0.0}, "window_s 0 is not a positive number"),
        ({"warm_up_s": float("nan")}, "warm_up_s nan"),
        ({"seed": -1}, "seed -1"),
    ],
)
def test_a_schedule_that_cannot_be(change: dict[str, float], fault: str) -> None:
    with pytest.raises(EnergyError, match=fault):
        EnergySchedule(**change)  # type: ignore[arg-type]
