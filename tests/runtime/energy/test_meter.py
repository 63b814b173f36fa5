"""The meter finds what a device takes, in turn, and refuses a counter that fails."""

from dataclasses import replace
from itertools import groupby
from pathlib import Path

import pynvml
import pytest
from hypothesis import given
from hypothesis import strategies as st

from me2e_compress.base.errors import EnergyError
from me2e_compress.graph import sha256_of
from me2e_compress.runtime.energy.energy_counter import EnergySchedule, Recorded
from me2e_compress.runtime.energy.energy_result import EnergyResult
from me2e_compress.runtime.energy.meter import EnergyMeter, measure_energy
from tests.runtime.energy.clockwork import Clock
from tests.runtime.energy.opened import Driver
from tests.runtime.energy.world import World
from tests.runtime.test_profile import FRAMES, model
from tests.support.installed import install

__all__ = ["model"]

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
    assert found.throttled == ("heat",)


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
    world = World()
    world.counts = False

    assert measured(world).j_per_frame == pytest.approx(9.0, rel=0.01)
    assert world.readings == 0


def test_power_that_is_read_too_seldom_is_an_error_without_a_counter() -> None:
    world = World()
    models = {"m": world.model("m", 0.03, 300)}
    world.counts = False
    with pytest.raises(EnergyError, match="power was read 10 times"):
        meter(world, seldom=10).measure(models)


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


@pytest.mark.parametrize(
    ("falls", "fault"), [(0.0, "stands still at 900 J"), (1.0, "went back from")]
)
def test_a_counter_that_does_not_rise_is_an_error(falls: float, fault: str) -> None:
    world = World()
    world.joules = lambda: 900.0 - falls * world.now  # type: ignore[method-assign]

    with pytest.raises(EnergyError, match=f"simulated of a device {fault}"):
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


# The energy of files is measured by what runs them, with any package's counter.


SHORT = EnergySchedule(
    *(0.02, 0.02, 5, 5), idle_s=0.02, lead_in_s=0.005
)  # whatever the machine: a clock never fails


@pytest.fixture
def clockwork(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    target = "tests.runtime.energy.clockwork:Clockwork"
    group = "me2e_compress.energy_counters"
    install(monkeypatch, tmp_path, "clockwork", group, {"clockwork": target})


@pytest.mark.usefixtures("clockwork")
def test_any_packages_counter_measures_models_in_turn(model: Path) -> None:
    seen, closed = list[tuple[int, int, str]](), Clock.closed

    found = measure_energy(
        {"a": model, "b": model},
        FRAMES,
        "clockwork:20",
        SHORT,
        on_window=lambda *told: seen.append(told),
    )

    assert [name for _, _, name in seen] == [*"abbaabbaab", "b"]
    assert [result.windows for result in found.values()] == [5, 5]
    assert found["a"].j_per_frame is not None
    assert found["a"].model_sha256 == sha256_of(model)
    assert Clock.closed == closed + 1


def test_without_a_counter_nothing_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "m.onnx").write_bytes(b"no model")
    Driver(monkeypatch, init=-pynvml.NVML_ERROR_LIBRARY_NOT_FOUND)

    found = measure_energy({"m": tmp_path / "m.onnx"}, FRAMES, "nvml")["m"]

    assert found.j_per_frame is None
    assert "nvml: NVML Shared Library Not Found" in found.reason


def test_a_recording_is_of_one_model(model: Path, tmp_path: Path) -> None:
    (tmp_path / "r.csv").write_text("time_s,frames,watts\n0,0,1\n1,1,1")

    with pytest.raises(EnergyError, match="a recording is of one model, and there are"):
        measure_energy(
            {"a": model, "b": model}, FRAMES, f"recorded:{tmp_path / 'r.csv'}"
        )


@pytest.mark.usefixtures("clockwork")
def test_no_frame_is_an_error(model: Path) -> None:
    with pytest.raises(EnergyError, match="there is no frame to run"):
        measure_energy({"m": model}, [], "clockwork", SHORT)


# A recording of the target device is cut into windows, or refused in one line.


CUT = EnergySchedule(warm_up_s=5, window_s=4, window_frames=10, idle_s=4)


def columns(watts: float = 30.0, idle: float = 10.0) -> dict[str, list[float]]:
    """Five seconds idle, then work for a minute at 10 frames a second, then idle."""
    found: dict[str, list[float]] = {"time_s": [], "frames": [], "watts": []}
    for tenth in range(701):
        works = 50 < tenth <= 650
        found["time_s"].append(tenth / 10)
        found["frames"].append(min(max(0, tenth - 50), 600))
        found["watts"].append(watts if works else idle)
    return found


def counting(power: dict[str, list[float]]) -> dict[str, list[float]]:
    joules = [0.1 * sum(power["watts"][1 : at + 1]) for at in range(701)]
    rest = {name: each for name, each in power.items() if name != "watts"}
    return {**rest, "joules": joules}


def as_csv(table: dict[str, list[float]]) -> str:
    rows = zip(*table.values(), strict=True)
    return "\n".join([", ".join(table), *(",".join(map(str, row)) for row in rows)])


def written(path: Path, text: str) -> Recorded:
    path.write_text(text)
    return Recorded(path)


@pytest.mark.parametrize("joules", [False, True])
def test_joules_a_frame(joules: bool, tmp_path: Path) -> None:
    table = counting(columns()) if joules else columns()
    found = written(tmp_path / "r.csv", as_csv(table)).open().measured(CUT)

    assert found.j_per_frame == pytest.approx(3.0, rel=0.01)
    assert found.net_j_per_frame == pytest.approx(2.0, rel=0.02)
    assert found.idle_w == pytest.approx(10.0, rel=0.05)
    assert (found.windows, found.frames) == (13, 13 * 40)
    assert found.counter_step_s == pytest.approx(0.1)


def changed(column: str, row: int, value: float, *, joules: bool = False) -> str:
    table = counting(columns()) if joules else columns()
    table[column][row] = value
    return as_csv(table)


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("", "no column time_s; there are none"),
        ("time_s,frames\n0,0\n1,1", "no column watts"),
        ("time_s,frames,watts", "a recording has 2 rows or more"),
        ("time_s,frames,watts\n0,0", "line 2 has 2 values, the header 3"),
        ("time_s,frames,watts\n0,0,x\n1,1,1", "could not convert string to float"),
        (changed("time_s", 9, 0.0), "time_s does not ascend at row 9"),
        (changed("frames", 99, 0), "frames go back at row 99"),
        (changed("watts", 3, -1), "watts are negative at row 4"),
        (changed("watts", 3, float("nan")), "watts is not finite at row 4"),
        (changed("joules", 99, 0, joules=True), "joules go back at row 99"),
    ],
    ids=lambda text: text[-20:],
)
def test_what_is_no_recording_is_one_line(
    text: str, fault: str, tmp_path: Path
) -> None:
    with pytest.raises(EnergyError, match=f"not an energy recording: {fault}"):
        written(tmp_path / "r.csv", text).open()


@pytest.mark.parametrize(
    ("table", "schedule", "fault"),
    [
        (columns(watts=0.0), CUT, "stands still from 10 to 14 s"),
        (columns(), EnergySchedule(), "3 windows of 10 s and 100 frames"),
        ({**columns(), "frames": [0.0] * 701}, CUT, "no frame is done"),
    ],
)
def test_a_recording_that_cannot_be_measured(
    table: dict[str, list[float]], schedule: EnergySchedule, fault: str, tmp_path: Path
) -> None:
    recording = written(tmp_path / "r.csv", as_csv(table)).open()

    with pytest.raises(EnergyError, match=fault):
        recording.measured(schedule)


@given(content=st.binary(max_size=60))
def test_any_bytes_are_one_line(
    content: bytes, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.getbasetemp() / "any.csv"
    path.write_bytes(content)

    with pytest.raises(EnergyError) as caught:
        Recorded(path).open()
    assert "\n" not in str(caught.value)
