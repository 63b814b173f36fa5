"""A recording of the target device is cut into windows, or refused in one line."""

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from me2e_compress.errors import EnergyError
from me2e_compress.runtime.energy.energy_counter import EnergySchedule, Recorded

SCHEDULE = EnergySchedule(warm_up_s=5, window_s=4, window_frames=10, idle_s=4)


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
@pytest.mark.parametrize("name", ["r.csv", "r.json"])
def test_joules_a_frame(name: str, joules: bool, tmp_path: Path) -> None:
    table = counting(columns()) if joules else columns()
    text = as_csv(table) if name.endswith("csv") else json.dumps(table)
    found = written(tmp_path / name, text).open().measured(SCHEDULE)

    assert found.j_per_frame == pytest.approx(3.0, rel=0.01)
    assert found.net_j_per_frame == pytest.approx(2.0, rel=0.02)
    assert found.idle_w == pytest.approx(10.0, rel=0.05)
    assert (found.windows, found.frames) == (13, 13 * 40)
    assert found.counter_step_s == pytest.approx(0.1)


def test_json_says_what_was_recorded(tmp_path: Path) -> None:
    words = {"device": "Orin NX", "scope": "VDD_IN", "counter": "tegrastats"}
    text = json.dumps({**columns(), **words})
    found = written(tmp_path / "r.json", text).open().measured(SCHEDULE)

    assert (found.device, found.scope, found.counter) == tuple(words.values())


def changed(column: str, row: int, value: float, *, joules: bool = False) -> str:
    table = counting(columns()) if joules else columns()
    table[column][row] = value
    return as_csv(table)


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("", "no column time_s; there are none"),
        ("time_s,frames\n0,0\n1,1", "no column watts"),
        ("time_s,frames,watts", "the columns are not of one length"),
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


@pytest.mark.parametrize("text", ["[]", '{"time_s": 1}', '{"time_s": [{}]}'])
def test_json_that_is_no_recording(text: str, tmp_path: Path) -> None:
    with pytest.raises(EnergyError, match="not an energy recording"):
        written(tmp_path / "r.json", text).open()


@pytest.mark.parametrize(
    ("watts", "schedule", "fault"),
    [
        (0.0, SCHEDULE, "stands still from 10 to 14 s"),
        (None, EnergySchedule(), "3 windows of 10 s and 100 frames"),
    ],
)
def test_a_recording_that_cannot_be_measured(
    watts: float | None, schedule: EnergySchedule, fault: str, tmp_path: Path
) -> None:
    made = columns() if watts is None else columns(watts=watts)
    recording = written(tmp_path / "r.csv", as_csv(made)).open()

    with pytest.raises(EnergyError, match=fault):
        recording.measured(schedule)


def test_a_recording_without_frames(tmp_path: Path) -> None:
    table = {**columns(), "frames": [0.0] * 701}

    with pytest.raises(EnergyError, match="no frame is done"):
        written(tmp_path / "r.csv", as_csv(table)).open().measured(SCHEDULE)


@given(content=st.binary(max_size=60), ending=st.sampled_from(["csv", "json"]))
def test_any_bytes_are_one_line(
    content: bytes, ending: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.getbasetemp() / f"any.{ending}"
    path.write_bytes(content)

    with pytest.raises(EnergyError) as caught:
        Recorded(path).open()
    assert "\n" not in str(caught.value)
