import cv2
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from me2e_compress.simulator.camera_rig import CAMERA_NAMES, CameraRig
from me2e_compress.simulator.cameras.painter import painting_order
from me2e_compress.simulator.cameras.renderer import Cameras
from me2e_compress.simulator.cameras.solids import TEMPLATES
from me2e_compress.simulator.scene import Actor, ActorKind, Ego, SignalState
from tests.simulator.cameras import town
from tests.support.profiles import scaled

Floats = npt.NDArray[np.float64]
FRONT, FRONT_LEFT, FRONT_RIGHT, BACK = (
    CAMERA_NAMES.index(name) for name in ("FRONT", "FRONT_LEFT", "FRONT_RIGHT", "BACK")
)
TEXTURE = town.paint()
PAINTS_APART = (0, 1)
"""Numbers of two actors that get different colours."""


def silhouette(rig: CameraRig, camera: int, actor: Actor) -> Floats:
    """[N, 2] pixels of all corners of an actor's faces, by lidar2img alone."""
    shapes = [t.corners[:, :, ~t.details] for t in TEMPLATES[actor.kind]]
    corners = np.concatenate([s.reshape(3, -1) for s in shapes], axis=1)
    x, y, z = corners * np.array([[actor.length], [actor.width], [actor.height]])
    cos, sin = np.cos(actor.heading), np.sin(actor.heading)
    points = [cos * x - sin * y + actor.x, sin * x + cos * y + actor.y, z]
    homogeneous = np.stack([*points, np.ones_like(x)])
    u, v, depth, _ = rig.lidar2img[camera].astype(float) @ homogeneous
    return np.stack([u / depth, v / depth], axis=1)


def bounds(mask: npt.NDArray[np.bool_]) -> Floats:
    """left, top, right, bottom of the pixels in a mask."""
    rows, columns = np.nonzero(mask)
    ends = columns.min(), rows.min(), columns.max() + 1, rows.max() + 1
    return np.array(ends, float)


@pytest.mark.parametrize("kind", list(ActorKind))
@pytest.mark.parametrize("heading", [0.0, 0.7, -2.0])
def test_an_actor_covers_the_pixels_that_lidar2img_gives_its_corners(
    rig: CameraRig, kind: ActorKind, heading: float
) -> None:
    actor = town.actor(13.0, 1.0, kind, heading=heading)
    mask = town.covered(rig, town.scene(actor))[FRONT]
    pixels = silhouette(rig, FRONT, actor)
    expected = np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])
    # cv2 rounds polygons out by half a pixel, and bounds are whole pixels
    np.testing.assert_allclose(bounds(mask), expected, atol=1.2)


@pytest.mark.parametrize("kind", list(ActorKind))
def test_an_image_shows_an_actor_where_its_faces_are(
    cameras: Cameras, kind: ActorKind
) -> None:
    scene = town.scene(town.actor(9.0, 0.0, kind, heading=0.5))
    mask = town.covered(cameras.rig, scene)[FRONT].astype(np.uint8)
    empty = cameras.render(town.scene())[FRONT].astype(int)
    image = cameras.render(scene)[FRONT].astype(int)
    changed = np.abs(image - empty).max(axis=2) > 12
    core = cv2.erode(mask, np.ones((3, 3), np.uint8)).astype(bool)
    assert core.sum() > 20
    assert changed[core].mean() > 0.97
    # outside of it there is only its shadow, which is darker than any ground
    outside = changed & ~cv2.dilate(mask, np.ones((3, 3), np.uint8)).astype(bool)
    assert (image <= empty)[outside].all()


def test_the_nearer_car_hides_the_farther_one_whatever_their_order(
    cameras: Cameras,
) -> None:
    near = town.actor(10.0, 0.0, number=PAINTS_APART[0])
    far = town.actor(18.0, 0.4, number=PAINTS_APART[1])
    both = cameras.render(town.scene(near, far))
    np.testing.assert_array_equal(both, cameras.render(town.scene(far, near)))
    assert_hides(cameras, near, far, town.ego())


def assert_hides(cameras: Cameras, near: Actor, far: Actor, ego: Ego) -> None:
    alone = town.scene(near, seen_from=ego)
    mask = town.covered(cameras.rig, alone)[FRONT].astype(np.uint8)
    core = cv2.erode(mask, np.ones((5, 5), np.uint8)).astype(bool)
    both = cameras.render(town.scene(far, near, seen_from=ego))[FRONT]
    np.testing.assert_array_equal(both[core], cameras.render(alone)[FRONT][core])


def test_a_car_beside_a_long_truck_is_not_painted_over(cameras: Cameras) -> None:
    # the truck's centre is farther than the car's, yet its tail is nearer, and the
    # car behind its far side must not show through
    truck = town.actor(12.0, 0.0, ActorKind.TRUCK, number=3)
    hidden = town.actor(11.5, 2.6, ActorKind.PEDESTRIAN)
    assert_hides(cameras, truck, hidden, town.ego(0.0, -4.0))


def rectangle(
    x: float, y: float, heading: float, length: float, width: float
) -> Floats:
    half = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * (length / 2, width / 2)
    cos, sin = np.cos(heading), np.sin(heading)
    turned = half @ np.array([(cos, sin), (-sin, cos)])
    return np.asarray(turned + np.array([x, y]))


def first_hit(corners: Floats, bearing: float) -> float:
    """Distance at which a ray from the origin meets a convex polygon, or infinity."""
    ray = np.array([np.sin(bearing), np.cos(bearing)])
    hits = []
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        edge = b - a
        cross = ray[0] * edge[1] - ray[1] * edge[0]
        if abs(cross) < 1e-12:
            continue
        t = (a[0] * edge[1] - a[1] * edge[0]) / cross
        s = (a[0] * ray[1] - a[1] * ray[0]) / cross
        if t > 0 and 0 <= s <= 1:
            hits.append(t)
    return min(hits, default=float("inf"))


rectangles = st.builds(
    rectangle,
    st.floats(-8, 8),
    st.floats(4, 25),
    st.floats(-3, 3),
    st.floats(0.5, 9.0),
    st.floats(0.5, 2.5),
)


@given(rectangles, rectangles)
def test_of_two_boxes_the_one_hit_first_is_painted_last(a: Floats, b: Floats) -> None:
    bearings = np.linspace(-1.2, 1.2, 241)
    hits = np.array([[first_hit(box, t) for t in bearings] for box in (a, b)])
    hits = hits[:, np.isfinite(hits).all(axis=0)]
    gap = hits[0] - hits[1]
    assume(len(gap) > 0 and (np.abs(gap) > 0.2).all())
    assume(separate(a, b) or separate(b, a))
    shapes = np.stack([a, b])
    right, forward = (shapes[None, :, :, i].transpose(0, 2, 1) for i in (0, 1))
    _, order = painting_order(right, forward, np.ones((1, 2), np.bool_))
    assert (gap > 0).all() or (gap < 0).all()
    assert order.tolist() == ([0, 1] if gap[0] > 0 else [1, 0])


def separate(a: Floats, b: Floats) -> bool:
    """Whether an edge of a has all of b outside of it."""
    edges = np.roll(a, -1, axis=0) - a
    normals = np.stack([edges[:, 1], -edges[:, 0]], axis=1)
    reach = np.einsum("ec,ekc->ek", normals, b[None] - a[:, None])
    return bool((reach > 0).all(axis=1).any())


def test_a_car_in_two_cameras_is_one_car(cameras: Cameras, rig: CameraRig) -> None:
    car = town.actor(7.0, 4.8)
    covered = town.covered(rig, town.scene(car))
    images = cameras.render(town.scene(car)).astype(int)
    colours = []
    for camera in (FRONT, FRONT_LEFT):
        mask = covered[camera]
        assert mask.sum() > 100
        columns = silhouette(rig, camera, car)[:, 0]
        expected = np.clip([columns.min(), columns.max()], 0, 224)
        np.testing.assert_allclose(bounds(mask)[[0, 2]], expected, atol=1.2)
        colours.append(np.median(images[camera][mask], axis=0))
    assert np.abs(colours[0] - colours[1]).max() < 40
    assert not covered[[FRONT_RIGHT, BACK]].any()


@pytest.mark.parametrize("kind", [ActorKind.CAR, ActorKind.VAN, ActorKind.TRUCK])
def test_brake_lights_light_up_on_the_actor(cameras: Cameras, kind: ActorKind) -> None:
    off = town.scene(town.actor(11.0, 0.0, kind))
    on = town.scene(town.actor(11.0, 0.0, kind, braking=True))
    before, after = (cameras.render(s)[FRONT].astype(int) for s in (off, on))
    changed = (before != after).any(axis=2)
    assert changed.sum() >= 8
    assert (after - before)[changed][:, 0].max() > 60
    mask = town.covered(cameras.rig, on)[FRONT].astype(np.uint8)
    assert cv2.dilate(mask, np.ones((3, 3), np.uint8)).astype(bool)[changed].all()


@pytest.mark.parametrize(
    ("indicator", "half"), [(1, slice(0, 112)), (-1, slice(112, 224))]
)
def test_an_indicator_blinks_on_its_side(
    cameras: Cameras, indicator: int, half: slice
) -> None:
    car = town.actor(11.0, 0.0, indicator=indicator)
    off = cameras.render(town.scene(car, time_us=350_000))[FRONT]
    on = cameras.render(town.scene(car, time_us=0))[FRONT]
    changed = (on != off).any(axis=2)
    assert changed[:, half].sum() >= 4
    assert changed.sum() == changed[:, half].sum()


@pytest.mark.parametrize(
    ("state", "channel"), [(SignalState.RED, 0), (SignalState.GREEN, 1)]
)
def test_a_light_shows_its_state(
    cameras: Cameras, state: SignalState, channel: int
) -> None:
    image = cameras.render(town.light(state))[FRONT].astype(int)
    lit = image[town.covered(cameras.rig, town.light(state))[FRONT]]
    other = lit[:, [c for c in (0, 1) if c != channel]].max(axis=1)
    assert ((lit[:, channel] > 200) & (other < 150)).sum() >= 6


def test_a_waiting_car_sees_the_light_of_its_own_stop_line(cameras: Cameras) -> None:
    # the post stands 0.5 m behind the line and 0.8 m beside a lane of 4 m
    scene = town.light(SignalState.RED, x=2.3 + 1.0 + 0.5, y=-2.8)
    image = cameras.render(scene)[FRONT_RIGHT].astype(int)
    red = (image[..., 0] > 220) & (image[..., 1] < 90) & (image[..., 2] < 90)
    assert red.sum() >= 20


def test_something_in_the_face_of_a_camera_is_cut_not_dropped(rig: CameraRig) -> None:
    wall = town.actor(3.2, 0.0, ActorKind.TRUCK, heading=np.pi / 2)
    assert town.covered(rig, town.scene(wall))[FRONT].mean() > 0.5


def test_what_is_far_away_is_not_drawn(cameras: Cameras) -> None:
    far = town.scene(town.actor(130.0, 0.0))
    np.testing.assert_array_equal(cameras.render(far), cameras.render(town.scene()))


@settings(max_examples=scaled(30))
@given(
    st.lists(
        st.tuples(
            st.sampled_from(ActorKind),
            st.floats(-8, 8),
            st.floats(-8, 8),
            st.floats(-7, 7),
        ),
        max_size=8,
    )
)
def test_actors_may_be_anywhere_even_inside_each_other(
    crowd: list[tuple[ActorKind, float, float, float]],
) -> None:
    actors = [
        town.actor(x, y, kind, number=i, heading=heading)
        for i, (kind, x, y, heading) in enumerate(crowd)
    ]
    cameras = Cameras(TEXTURE, CameraRig(48, 80))
    assert cameras.render(town.scene(*actors)).shape == (6, 48, 80, 3)
