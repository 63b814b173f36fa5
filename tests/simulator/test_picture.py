from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image

from me2e_compress.base.errors import EvaluationError
from me2e_compress.simulator.camera_rig import CAMERA_NAMES
from me2e_compress.simulator.pictures import (
    EGO,
    INK,
    PLAN,
    TRAIL,
    Moment,
    RoutePicture,
    write_picture,
)
from me2e_compress.simulator.scene import ActorKind, Event, EventKind, SignalState
from tests.simulator.cameras import town

TEXTURE = town.paint()
PLAN_AHEAD = np.array([(4.0 * step, 0.0) for step in range(1, 7)])
Image8 = npt.NDArray[np.uint8]


def event(kind: EventKind, time_us: int) -> Event:
    return Event(time_us, kind, "", 2.0, 0.0, 8.0, 1, ActorKind.CAR)


BLACK = np.zeros((6, 96, 160, 3), np.uint8)


def moment(i: int, *events: Event, images: Image8 = BLACK) -> Moment:
    scene = town.light(SignalState.RED, x=30.0)
    scene = replace(scene, time_us=i * 50_000, ego=town.ego(float(i), 0.0))
    return Moment(scene, images, PLAN_AHEAD, events)


def picture(*moments: Moment) -> RoutePicture:
    return RoutePicture("Accident_1", TEXTURE, town.ROUTE, moments)


def count(pixels: Image8, colour: tuple[int, int, int]) -> int:
    return int((pixels == colour).all(axis=2).sum())


def above(frame: Image.Image) -> Image8:
    """The view from above: right of three tiles and their gaps."""
    return np.asarray(frame)[:-34, 3 * 324 :]


def test_a_frame_has_six_tiles_a_view_from_above_and_a_caption() -> None:
    images = np.stack([np.full((96, 160, 3), 20 * i, np.uint8) for i in range(6)])
    drawn = picture(moment(0, images=images)).frame(0)
    frame = np.asarray(drawn)
    sides = ("{}_LEFT", "{}", "{}_RIGHT")
    for row, column in np.ndindex(2, 3):
        name = sides[column].format(("FRONT", "BACK")[row])
        pixel = frame[row * 196 + 120, column * 324 + 160]
        assert pixel.tolist() == [20 * CAMERA_NAMES.index(name)] * 3
    assert above(drawn).shape[0] == 388
    assert (frame[-30:] < 120).any()


def test_the_view_from_above_shows_ego_trail_and_plan() -> None:
    moments = [moment(i) for i in range(9)]
    first, last = picture(*moments).frame(0), picture(*moments).frame(8)
    for colour in (EGO, PLAN):
        assert count(above(first), colour) > 20
    assert count(above(first), TRAIL) == 0
    assert count(above(last), TRAIL) > 10


def test_the_plan_lies_ahead_of_the_ego() -> None:
    view = above(picture(moment(0)).frame(0))
    rows, columns = np.nonzero((view == PLAN).all(axis=2))
    scale = view.shape[0] / 72.0  # the ego stands 50 m below the upper edge
    assert rows.min() == pytest.approx((50 - 24) * scale, abs=4)
    assert columns.mean() == pytest.approx(view.shape[1] / 2, abs=2)
    # the bar in the corner is ten metres long
    bar = (view[-13:-10, :200] == INK).all(axis=2).any(axis=0)
    assert bar.sum() == pytest.approx(10 * scale, abs=2)
    # a moment may have none
    bare = replace(moment(0), plan=None)
    frame = picture(bare).frame(0)
    assert count(above(frame), PLAN) == 0


def test_an_infraction_is_marked_from_its_moment_on() -> None:
    crash = event(EventKind.COLLISION, 100_000)
    moments = [moment(0), moment(1), moment(2, crash), moment(3, crash)]
    red = [count(above(picture(*moments).frame(i)), (208, 16, 32)) for i in range(4)]
    assert red[0] == red[1] == 0
    assert min(red[2:]) > 20


def test_an_event_is_drawn_once_and_a_trigger_is_no_infraction() -> None:
    crash = event(EventKind.RED_LIGHT, 50_000)
    once = picture(moment(0), moment(1, crash), moment(2))
    twice = picture(moment(0), moment(1, crash), moment(2, crash))
    np.testing.assert_array_equal(once.frame(2), twice.frame(2))
    trigger = event(EventKind.TRIGGER, 0)
    with_it, without = picture(moment(0, trigger)), picture(moment(0))
    np.testing.assert_array_equal(with_it.frame(0), without.frame(0))


def test_a_strip_sets_moments_side_by_side() -> None:
    film = picture(*(moment(i) for i in range(4)))
    strip = film.strip([0, 2, 3])
    assert strip.size == (3 * 320 + 2 * 4, 30 + 4 + 192 + 4 + 320)
    # without a moment there is nothing to draw
    with pytest.raises(EvaluationError, match="Accident_1: no moments to draw"):
        picture()


def test_a_png_is_what_was_drawn(tmp_path: Path) -> None:
    frame = picture(moment(0)).frame(0)
    write_picture(tmp_path / "moment.png", [frame])
    with Image.open(tmp_path / "moment.png") as image:
        np.testing.assert_array_equal(np.asarray(image), frame)
    assert [path.name for path in tmp_path.iterdir()] == ["moment.png"]


def test_a_gif_has_all_frames_and_their_pace(tmp_path: Path) -> None:
    film = picture(*(moment(i) for i in range(5)))
    write_picture(tmp_path / "route.gif", film.frames(), 200_000)
    with Image.open(tmp_path / "route.gif") as image:
        assert getattr(image, "n_frames", 1) == 5
        assert image.info["duration"] == 200
        assert image.info["loop"] == 0
        image.seek(4)
        shown = np.asarray(image.convert("RGB")).astype(int)
    assert np.abs(shown - np.asarray(film.frame(4))).mean() < 3
    assert [path.name for path in tmp_path.iterdir()] == ["route.gif"]


@pytest.mark.parametrize("name", ["moment.png", "moment.gif"])
def test_a_place_that_cannot_be_written_is_named(tmp_path: Path, name: str) -> None:
    path = tmp_path / "missing" / name
    with pytest.raises(EvaluationError, match=f"{name}: cannot be written"):
        write_picture(path, [picture(moment(0)).frame(0)])
    assert not list(tmp_path.iterdir())
