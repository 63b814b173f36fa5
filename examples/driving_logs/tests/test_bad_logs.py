"""Data sets that lack something: one line that names it."""

import gzip
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from driving_logs.model_inputs import (
    InputForm,
    LoggedInputs,
    log_frames,
)
from driving_logs.nuscenes_tables import rows
from driving_logs.pictures import read_picture
from me2e_compress.base.errors import FramesError
from me2e_compress.calibration.dataset import PixelInput
from read_logs import opened
from small_logs import (
    CLIP,
    draw,
    write_bench2drive,
    write_nuscenes,
)

PIXELS = PixelInput(mean=(0, 0, 0), std=(1, 1, 1), order="bgr", rows=32, columns=64)
FORMS = {"img": InputForm((6, 3, 32, 64), np.dtype(np.float32))}
MODEL = LoggedInputs(FORMS, PIXELS)


def read(text: str) -> None:
    list(log_frames(opened(text), MODEL, 99))


def table(name: str, change: Callable[[list[Any]], object]) -> Callable[[Path], None]:
    """Change the rows of a table."""

    def damage(root: Path) -> None:
        path = root / "v1.0-mini" / f"{name}.json"
        found = json.loads(path.read_text())
        change(found)
        path.write_text(json.dumps(found))

    return damage


def cut(file: str) -> Callable[[Path], None]:
    """Leave the first half of a file."""

    def damage(root: Path) -> None:
        path = root / file
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])

    return damage


def without(file: str) -> Callable[[Path], None]:
    return lambda root: (root / file).unlink()


FRONT = "samples/CAM_FRONT/scene-0001-0.png"
NAN = float("nan")


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (without("v1.0-mini/ego_pose.json"), "ego_pose.json: No such file"),
        (cut("v1.0-mini/sample.json"), "sample.json: .*it breaks off or is malformed"),
        (
            lambda root: (root / "v1.0-mini/scene.json").write_text("{}"),
            r"scene.json: not a table of nuScenes: it does not begin with \[",
        ),
        (
            table("sample", lambda found: found[0].pop("timestamp")),
            "sample.json: not a table of nuScenes: row 0 has no timestamp",
        ),
        (
            table("sample", lambda found: found[0].update(timestamp="now")),
            "row 0: timestamp is 'now'",
        ),
        (
            table("sample", lambda found: found[0].update(scene_token=[1])),
            r"row 0: scene_token is \[1\]",
        ),
        (
            table("sample_data", lambda found: found.pop(3)),
            "sample scene-0001-0 has no CAM_FRONT_RIGHT",
        ),
        (
            table("ego_pose", lambda found: found.pop(1)),
            "ego_pose.json: no scene-0001-0 CAM_FRONT, which .*png names",
        ),
        (
            table("ego_pose", lambda found: found[0].update(translation=[0, NAN, 0])),
            "scene-0001-0 LIDAR_TOP: translation: is not finite",
        ),
        (
            table("ego_pose", lambda found: found[0].update(rotation=[0, 0, 0, 0])),
            "scene-0001-0 LIDAR_TOP: the pose is not finite",
        ),
        (
            table("calibrated_sensor", lambda f: f[1].update(camera_intrinsic=[1, 2])),
            r"CAM_FRONT: has shape \[2\], not \[3, 3\]",
        ),
        (
            table("sample", lambda found: found[0].update(next="?")),
            "scene-0001 breaks off at '\\?'",
        ),
        (
            table("sample", lambda found: found[0].update(timestamp=10**400)),
            "row 0: timestamp is 1000",
        ),
        (
            table("ego_pose", lambda f: f[0].update(translation=[0, 10**400, 0])),
            r"scene-0001-0 LIDAR_TOP: translation: no \[3\] of numbers",
        ),
        (
            lambda root: (root / "v1.0-mini/scene.json").write_bytes(b"[\xff]"),
            "scene.json: not a table of nuScenes: .*can't decode byte 0xff",
        ),
        (without(FRONT), "CAM_FRONT/scene-0001-0.png: No such file"),
        (cut(FRONT), "scene-0001-0.png: the picture breaks off, or is no JPEG or PNG"),
    ],
)
def test_what_is_wrong_in_nuscenes_is_named(
    tmp_path: Path, damage: Callable[[Path], object], message: str
) -> None:
    damage(write_nuscenes(tmp_path, 1))

    with pytest.raises(FramesError, match=message) as raised:
        read(f"nuscenes:{tmp_path}")

    assert "\n" not in str(raised.value)


def annotation(change: Callable[[dict[str, Any]], object]) -> Callable[[Path], None]:
    def damage(root: Path) -> None:
        path = root / CLIP / "anno" / "00000.json.gz"
        with gzip.open(path, "rt") as file:
            found = json.load(file)
        change(found)
        with gzip.open(path, "wt") as file:
            json.dump(found, file)

    return damage


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (cut(f"{CLIP}/anno/00000.json.gz"), "00000.json.gz: not a readable annotation"),
        (annotation(lambda a: a.pop("speed")), r"not an annotation.*\('speed'\)"),
        (annotation(lambda a: a.update(x=NAN)), "x, y or speed: is not finite"),
        (
            annotation(lambda a: a["sensors"].pop("CAM_BACK")),
            "00000.json.gz: has no CAM_BACK",
        ),
        (
            annotation(lambda a: a["sensors"]["LIDAR_TOP"].update(world2lidar=[1])),
            r"world2lidar: has shape \[1\], not \[4, 4\]",
        ),
        (annotation(lambda a: a.update(command_near=7)), "command_near 7 is none of"),
        (annotation(lambda a: a.update(x=10**400)), "not an annotation of Bench2Drive"),
        (without(f"{CLIP}/camera/rgb_back/00000.jpg"), "rgb_back/00000.jpg: No such"),
        (cut(f"{CLIP}/camera/rgb_front/00000.jpg"), "rgb_front/00000.jpg: the picture"),
    ],
)
def test_what_is_wrong_in_bench2drive_is_named(
    tmp_path: Path, damage: Callable[[Path], object], message: str
) -> None:
    damage(write_bench2drive(tmp_path, 1))

    with pytest.raises(FramesError, match=message):
        read(f"bench2drive:{tmp_path}")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("nuscenes:{root}/nowhere", "nowhere: no such folder"),
        ("nuscenes:{root}/empty", "name the version; no v1.0-\\* is in it"),
        (
            "nuscenes{{root={root}, version=v1.0-test}}",
            "no version v1.0-test; there",
        ),
        ("nuscenes{{root={root}, scenes=[x]}}", "no scene 'x'; there are scene-0001"),
        ("nuscenes{{root={root}, every=0}}", "nuscenes: every 0: must be at least 1"),
        ("nuscenes{{root={root}, width=0}}", "nuscenes: width 0: must be at least 1"),
        ("bench2drive:{root}/empty", "empty: holds no clip: a folder with anno/ in it"),
        ("navsim:{root}", "no driving log 'navsim'; there are bench2drive, nuscenes"),
    ],
)
def test_a_log_that_is_not_there_is_named(
    tmp_path: Path, text: str, message: str
) -> None:
    (write_nuscenes(tmp_path, 1) / "empty").mkdir()

    with pytest.raises(FramesError, match=message):
        read(text.format(root=tmp_path))


def test_pictures_of_several_sizes_are_named(tmp_path: Path) -> None:
    root = write_bench2drive(tmp_path, 1)
    wide = root / CLIP / "camera" / "rgb_front_left" / "00000.jpg"
    cv2.imwrite(str(wide), np.zeros((90, 400, 3), np.uint8))

    with pytest.raises(FramesError, match="pictures of several sizes"):
        read(f"bench2drive:{root}")


@pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
def test_a_half_written_jpeg_is_no_picture(tmp_path: Path, share: float) -> None:
    """OpenCV would fill the rest with grey."""
    draw(tmp_path / "a.jpg", "CAM_FRONT")
    content = (tmp_path / "a.jpg").read_bytes()
    (tmp_path / "a.jpg").write_bytes(content[: int(len(content) * share)])

    with pytest.raises(FramesError, match=r"a\.jpg: the picture breaks off"):
        read_picture(tmp_path / "a.jpg", PIXELS, 64)


WORDS = st.text('"\\[]{},é\n ', max_size=6)


@settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    found=st.lists(st.fixed_dictionaries({"token": WORDS, "a": WORDS}), max_size=6),
    more=st.integers(1, 40),
    indent=st.sampled_from([None, 0, 2]),
)
def test_a_table_is_read_piece_by_piece(
    tmp_path: Path, found: list[dict[str, Any]], more: int, indent: int | None
) -> None:
    """Whatever lies where two pieces meet."""
    path = tmp_path / "sample.json"
    text = json.dumps(found, indent=indent, ensure_ascii=False)
    path.write_text(text, encoding="utf-8")
    longest = max((len(json.dumps(each, indent=2)) for each in found), default=0)
    with patch(f"{rows.__module__}.PIECE", longest + more):
        assert list(rows(path, "token")) == found
