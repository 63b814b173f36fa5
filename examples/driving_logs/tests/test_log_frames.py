"""What a known drive, written as nuScenes and as Bench2Drive, is read as."""

import math
from itertools import islice
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

from driving_logs.bench2drive import Bench2DriveLog
from driving_logs.model_inputs import (
    InputForm,
    LoggedInputs,
    log_frames,
)
from driving_logs.moments import CameraLog
from driving_logs.nuscenes import NuScenesLog
from driving_logs.pictures import Picture, read_picture
from me2e_compress.base.errors import FramesError
from me2e_compress.calibration.dataset import PixelInput
from me2e_compress.calibration.recording import LOGS
from me2e_compress.testing import check_form
from read_logs import F32, FORMS, MODEL, PIXELS, frames, opened, to_lidar
from small_logs import (
    BEND,
    CLIP,
    MAKERS,
    SPEED,
    WIDTH,
    YAWS,
    car_at,
    pixel,
    seen_point,
    write_bench2drive,
    write_nuscenes,
)

Layout = Literal["nuscenes", "bench2drive"]


def bright(planes: np.ndarray) -> tuple[float, float]:
    """Return the middle of what is white."""
    rows, columns = np.nonzero(planes.mean(axis=0) > 128)
    return columns.mean() + 0.5, rows.mean() + 0.5


@pytest.mark.parametrize("forward_left", [False, True])
def test_a_point_lands_on_the_pixel_it_was_drawn_at(
    log: CameraLog, forward_left: bool
) -> None:
    frame = frames(log, LoggedInputs(FORMS, PIXELS, forward_left), 1)[0]

    for index, camera in enumerate(log.seen):
        point = to_lidar(seen_point(camera))
        if forward_left:
            point = log.scene(log.chosen()[0])[0].lidar_to_ego @ point
        u, v, depth, _ = frame.arrays["lidar2img"][0, index] @ point
        found = bright(frame.arrays["img"][0, index])
        assert found == pytest.approx((u / depth, v / depth), abs=1.0)
        assert 2 * u / depth == pytest.approx(pixel(camera)[0], abs=1e-3)


def test_pictures_are_bytes_and_what_is_short_is_left_to_pad(log: CameraLog) -> None:
    image = frames(log, count=1)[0].arrays["img"]

    assert str(image.dtype) == "uint8"
    assert image.shape == (1, 6, 3, 45, 80)


def test_what_is_too_tall_loses_its_upper_rows(log: CameraLog) -> None:
    short = PIXELS.model_copy(update={"rows": 32})
    whole = frames(log, count=1)[0].arrays
    cut = frames(log, LoggedInputs(FORMS, short), 1)[0].arrays

    np.testing.assert_array_equal(cut["img"], whole["img"][..., 13:, :])
    point = to_lidar(seen_point("CAM_FRONT"))
    before, after = (each["lidar2img"][0, 0] @ point for each in (whole, cut))
    assert before[1] / before[2] - after[1] / after[2] == pytest.approx(13, abs=1e-3)


@pytest.mark.parametrize("by_log", [False, True])
def test_a_picture_may_take_a_part_of_the_columns(
    roots: dict[str, Path], by_log: bool
) -> None:
    """As 416 columns of DL4AGX's UniAD hold pictures of 400."""
    log = NuScenesLog(roots["nuscenes"], width=60 if by_log else None)
    model = LoggedInputs(FORMS, PIXELS, width=60 if not by_log else None)

    arrays = frames(log, model, 1)[0].arrays

    assert arrays["img"].shape == (1, 6, 3, 34, 60)
    u, v, depth, _ = arrays["lidar2img"][0, 0] @ to_lidar(seen_point("CAM_FRONT"))
    assert bright(arrays["img"][0, 0]) == pytest.approx((u / depth, v / depth), abs=1)
    assert u / depth * WIDTH / 60 == pytest.approx(pixel("CAM_FRONT")[0], abs=1e-3)


def test_frames_are_half_a_second_apart_and_one_scene(log: CameraLog) -> None:
    found = frames(log)

    assert [each.starts_scene for each in found] == [True, False, False, False]
    seconds = [each.arrays["timestamp"].item() for each in found]
    assert seconds == pytest.approx([0, 0.5, 1, 1.5])


def test_the_can_bus_holds_changes_since_the_frame_before(log: CameraLog) -> None:
    first, second = (
        each.arrays["can_bus"].astype(float) for each in frames(log, count=2)
    )
    a, b = car_at(0), car_at(0.5)

    assert (*first[:3], first[17]) == (0, 0, 0, 0)
    np.testing.assert_allclose(second[:3], [b.x - a.x, b.y - a.y, 0], atol=1e-4)
    turned = math.degrees(SPEED * BEND * 0.5)
    assert second[17] == pytest.approx(turned, abs=1e-3)
    assert second[16] == pytest.approx(b.heading, abs=1e-5)
    assert (second[3], second[6]) == pytest.approx(
        (math.cos(b.heading / 2), math.sin(b.heading / 2)), abs=1e-5
    )


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("nuscenes", {7: 0.1, 8: 0.2, 9: 9.8, 12: SPEED * BEND, 13: SPEED}),
        ("bench2drive", {7: SPEED, 10: 0.1, 11: 0.2, 12: 9.8, 15: SPEED * BEND}),
    ],
)
def test_the_can_bus_is_filled_as_each_data_set_does(
    roots: dict[str, Path], text: Layout, expected: dict[int, float]
) -> None:
    like = opened(f"{text}:{roots[text]}")
    other = NuScenesLog(roots["nuscenes"], layout=text)
    for log in (like, other):
        bus = frames(log, count=1)[0].arrays["can_bus"]
        wanted = {at: expected.get(at, 0.0) for at in range(7, 16)}
        assert dict(enumerate(bus[7:16].tolist(), 7)) == pytest.approx(wanted, abs=1e-5)


@pytest.mark.parametrize(
    ("text", "second"),
    [
        ("nuscenes{{root={nuscenes}}}", "CAM_FRONT_RIGHT"),
        ("nuscenes{{root={nuscenes}, layout=bench2drive}}", "CAM_FRONT_LEFT"),
        ("bench2drive{{root={bench2drive}}}", "CAM_FRONT_LEFT"),
    ],
)
def test_cameras_stand_as_the_models_of_the_data_set_have_them(
    roots: dict[str, Path], text: str, second: str
) -> None:
    log = opened(text.format_map(roots))

    assert sorted(log.seen) == sorted(YAWS)
    assert log.seen[1] == second


def test_no_can_bus_is_zeros(tmp_path: Path) -> None:
    root = write_nuscenes(tmp_path, 1)
    (root / "can_bus" / "scene-0001_pose.json").unlink()

    bus = frames(opened(f"nuscenes:{root}"))[0].arrays["can_bus"]

    assert not bus[7:16].any()


def test_the_lidar_is_placed_in_the_world(log: CameraLog) -> None:
    arrays = frames(log, count=1)[0].arrays
    turn = arrays["l2g_r_mat"]
    turn = turn.T if log.name == "nuscenes" else turn  # UniAD multiplies rows
    point = to_lidar(seen_point("CAM_FRONT"))[:3]

    expected = car_at(0).to_world @ seen_point("CAM_FRONT")
    np.testing.assert_allclose(turn @ point + arrays["l2g_t"], expected[:3], atol=1e-3)


@pytest.mark.parametrize(("layout", "left"), [("nuscenes", 1), ("bench2drive", 0)])
def test_the_command_follows_what_the_car_did(
    tmp_path: Path, layout: Layout, left: int
) -> None:
    root = write_nuscenes(tmp_path, 8)
    log = NuScenesLog(root, layout=layout)
    straight = {"nuscenes": 2, "bench2drive": 3}[layout]

    found = [each.arrays["command"].item() for each in frames(log)]

    # 18 m of the bend are 4.7 m to the left, 12 m are 2.1 m, 6 m are 0.5 m
    assert found == [left] * 4 + [straight] * 4


def test_bench2drive_gives_its_command(roots: dict[str, Path]) -> None:
    log = opened(f"bench2drive:{roots['bench2drive']}")
    assert frames(log, count=1)[0].arrays["command"].item() == 3


def test_scenes_cameras_and_every_nth_are_chosen(tmp_path: Path) -> None:
    write_bench2drive(tmp_path, 4)
    cameras = ("CAM_BACK", "CAM_FRONT")
    log = Bench2DriveLog(tmp_path, scenes=(CLIP,), cameras=cameras, every=2)
    form = {"img": InputForm((2, 3, 45, 80), F32)}

    found = frames(log, LoggedInputs(form, PIXELS))

    assert len(found) == 2
    assert found[0].arrays["img"].shape == (2, 3, 45, 80)
    away = [bright(planes) for planes in found[0].arrays["img"]]
    assert away[1] == pytest.approx([each / 2 for each in pixel("CAM_FRONT")], abs=1)


def test_pictures_are_read_when_their_frame_is_asked_for(
    log: CameraLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = list[Path]()

    def read(path: Path, pixels: PixelInput, columns: int) -> Picture:
        asked.append(path)
        return read_picture(path, pixels, columns)

    monkeypatch.setattr(f"{log_frames.__module__}.read_picture", read)

    list(islice(log_frames(log, MODEL, 99), 2))

    assert len(asked) == 12


def test_it_goes_on_with_a_scene(tmp_path: Path) -> None:
    for name in ("b", "a"):
        write_bench2drive(tmp_path / name, 2)
    log = opened(f"bench2drive:{tmp_path}")

    found = list(log_frames(log, MODEL, 2, 1, done=1, first=1))

    assert [(each.index, each.place, each.starts_scene) for each in found] == [
        (1, 1, True)
    ]


@pytest.mark.parametrize(
    ("form", "message"),
    [
        ({"state": InputForm((1, 9), F32)}, "input state is not made from a log;.*img"),
        (
            {"img": InputForm((1, 1, 3, 64, 80), F32)},
            r"img takes 1 cameras, the log gives 6: name them \(cameras=\[CAM_FRONT",
        ),
        ({"img": InputForm((1, 6, 3, 64, 80), np.dtype(np.uint8))}, "img is uint8"),
        ({"img": InputForm((6, 3, 64, 80), F32), "width": 99}, "99 columns .* img: 80"),
        ({"l2g_t": InputForm((1, 4), F32)}, r"l2g_t takes \[1, 4\], a log gives \[3\]"),
        (
            {"lidar2img": InputForm((4, 4), F32)},
            r"lidar2img takes \[4, 4\], a log gives \[6, 4, 4\]",
        ),
    ],
)
def test_what_a_log_cannot_feed_is_named(
    roots: dict[str, Path], form: dict[str, Any], message: str
) -> None:
    log = opened(f"nuscenes:{roots['nuscenes']}")
    forms = {name: each for name, each in form.items() if name != "width"}
    image = PIXELS if "img" in form else None
    model = LoggedInputs(forms, image, width=form.get("width"))
    with pytest.raises(FramesError, match=message):
        frames(log, model, 1)


@pytest.mark.parametrize("name", MAKERS)
def test_the_text_of_a_log_makes_it_again(name: str) -> None:
    check_form(LOGS.build(name, {"root": "x", "size": [2, 3], "width": 1}), LOGS)
