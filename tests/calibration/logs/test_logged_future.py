"""Where the car went and who was around it, as the frames of a log hold it."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.logs import LOGS, DriveLog
from me2e_compress.calibration.recording import write_recording
from me2e_compress.errors import FramesError
from tests.calibration.logs.read_logs import PIXELS, frames, to_lidar
from tests.calibration.logs.small_logs import BEND, LIDAR_M, SPEED, car_at


def test_the_future_is_where_the_car_went(log: DriveLog) -> None:
    future = frames(log)[0].future
    assert future is not None

    at_lidar = np.array([*LIDAR_M[:2], 0, 1])
    back = np.linalg.inv(car_at(0).to_world)
    for step, waypoint in enumerate(future.waypoints[:3], 1):
        there = back @ car_at(0.5 * step).to_world @ at_lidar
        assert waypoint == pytest.approx(to_lidar(there)[:2].tolist(), abs=1e-6)
    assert future.waypoints[3:] == (None, None, None)
    assert not future.whole
    assert future.forward == pytest.approx(math.pi / 2)


def test_the_others_are_boxes_in_the_frame_of_the_plan(log: DriveLog) -> None:
    future = frames(log)[0].future
    assert future is not None
    assert future.agents is not None

    car = future.agents[1][0]
    back = np.linalg.inv(car_at(0).to_world)
    there = car_at(1.0).to_world @ [8.0, 0, 0, 1]
    assert car[:2] == pytest.approx(to_lidar(back @ there)[:2].tolist(), abs=1e-5)
    assert car[2] == pytest.approx(math.pi / 2 + SPEED * BEND)
    assert car[3:] == pytest.approx((4.5, 1.9))
    names = {"nuscenes": 1, "bench2drive": 2}  # no barrier; a walker, nobody above
    assert len(future.agents[0]) == names[log.name]


def test_the_ego_stands_around_its_centre(roots: dict[str, Path]) -> None:
    future = frames(LOGS.parse(f"nuscenes:{roots['nuscenes']}"))[0].future

    assert future is not None
    assert future.ego == (4.084, 1.85)
    assert future.centre == pytest.approx((0.0, 0.5))


def test_a_future_is_written_and_read_again(log: DriveLog, tmp_path: Path) -> None:
    made = frames(log)
    pixels = {"img": PIXELS}
    folder = write_recording(tmp_path / "f", lambda _: iter(made), {}, pixels=pixels)

    assert [each.future for each in CalibrationSet(folder)] == [x.future for x in made]
    write_recording(folder, lambda _: iter(made[:1]), {}, pixels=pixels)
    assert not (folder / "000001.future.json").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"version": 2}, "000000.future.json: not a recorded future: version"),
        ({"ego": [1]}, "000000.future.json: not a recorded future: ego"),
    ],
)
def test_a_malformed_future_is_named(
    roots: dict[str, Path], tmp_path: Path, change: dict[str, object], message: str
) -> None:
    made = frames(LOGS.parse(f"nuscenes:{roots['nuscenes']}"), count=1)
    folder = write_recording(
        tmp_path / "f", lambda _: iter(made), {}, pixels={"img": PIXELS}
    )
    path = folder / "000000.future.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))

    with pytest.raises(FramesError, match=message):
        _ = CalibrationSet(folder)[0]
