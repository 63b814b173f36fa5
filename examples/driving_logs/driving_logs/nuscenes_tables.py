"""Read the tables of nuScenes, whose rows refer to each other by token.

``sample_data.json`` of v1.0-trainval has more than 1 GB; tables are read row by row,
and only the required rows are kept.
"""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

from driving_logs.moments import Floats, matrix_of, pose
from me2e_compress.base import documents
from me2e_compress.base.errors import FramesError

Row: TypeAlias = Mapping[str, Any]

NAMES = ("token", "name", "next", "channel")
TIMES = ("timestamp", "utime")
LATEST_US = 1 << 62
"""Latest valid time, microseconds."""
PIECE = 1 << 22
"""Characters to read at once; no row is larger."""
_SPACE = " \t\r\n,"


def rows(path: Path, *fields: str) -> Iterator[Row]:
    """Yield the rows of a table one by one; each must have ``fields``."""
    with documents.reading(path, FramesError, "not a table of nuScenes"):
        for index, row in enumerate(_objects(path)):
            for name in fields:
                _check(row, name, index)
            yield row


def _check(row: Row, name: str, index: int) -> None:
    """Check a field: references are text, times are integers."""
    if name not in row:
        raise documents.MalformedError(f"row {index} has no {name}")
    kind = int if name in TIMES else str if name.endswith(NAMES) else object
    found = row[name]
    late = isinstance(found, int) and kind is int and abs(found) > LATEST_US
    if late or not isinstance(found, kind):
        raise documents.MalformedError(f"row {index}: {name} is {row[name]!r:.40}")


def by_token(path: Path, keep: Callable[[Row], bool], *fields: str) -> dict[str, Row]:
    """Read the rows to keep, by their token."""
    return {row["token"]: row for row in rows(path, "token", *fields) if keep(row)}


class NuScenesTables:
    """The rows of some scenes, given by name; none means all."""

    def __init__(self, folder: Path, wanted: Sequence[str]) -> None:
        self.folder = folder
        self.scenes = [
            *rows(folder / "scene.json", "token", "name", "first_sample_token")
        ]
        # Keep the samples of the scenes, and what they refer to.
        tokens = {s["token"] for s in self.scenes if not wanted or s["name"] in wanted}
        self.samples = by_token(
            folder / "sample.json",
            lambda row: row["scene_token"] in tokens,
            *("scene_token", "timestamp", "next"),
        )
        self.sensors = by_token(
            folder / "calibrated_sensor.json",
            lambda row: True,
            *("sensor_token", "translation", "rotation", "camera_intrinsic"),
        )
        # Then the sensor data of the samples, and the poses it uses.
        self.data = self._key_frames()
        used = {
            d["ego_pose_token"] for each in self.data.values() for d in each.values()
        }
        self.poses = by_token(
            folder / "ego_pose.json",
            lambda row: row["token"] in used,
            *("translation", "rotation"),
        )

    def _key_frames(self) -> dict[str, dict[str, Row]]:
        """Return the row of each sample and sensor."""
        channels = by_token(self.folder / "sensor.json", lambda row: True, "channel")
        found: dict[str, dict[str, Row]] = {token: {} for token in self.samples}
        path = self.folder / "sample_data.json"
        names = ("sample_token", "ego_pose_token", "calibrated_sensor_token")
        # Sweeps between key frames are left out.
        for row in rows(path, *names, "is_key_frame", "filename"):
            if row["is_key_frame"] and row["sample_token"] in found:
                sensor = channels.get(self.sensor(row)["sensor_token"])
                if sensor is None:
                    raise FramesError(f"{path}: {row['filename']} is of no sensor")
                found[row["sample_token"]][sensor["channel"]] = row
        return found

    def samples_of(self, scene: Row) -> list[Row]:
        """Return the samples of a scene in order."""
        token, found = scene["first_sample_token"], list[Row]()
        while token:
            if token not in self.samples or len(found) > len(self.samples):
                path = self.folder / "sample.json"
                raise FramesError(f"{path}: {scene['name']} breaks off at {token!r}")
            found.append(self.samples[token])
            token = found[-1]["next"]
        return found

    def sensor(self, data: Row) -> Row:
        """Return the calibration of the sensor of a sample_data row."""
        return self._named(self.sensors, data, "calibrated_sensor")

    def ego(self, data: Row) -> Row:
        """Return the vehicle's pose of a sample_data row."""
        return self._named(self.poses, data, "ego_pose")

    def pose_of(self, row: Row) -> Floats:
        """Return the [4, 4] of a row with translation and rotation."""
        what = f"{self.folder}: {row['token']}"
        rotation = matrix_of(row["rotation"], (4,), f"{what}: rotation")
        translation = matrix_of(row["translation"], (3,), f"{what}: translation")
        return pose(rotation.tolist(), translation.tolist(), what)

    def _named(self, table: Mapping[str, Row], data: Row, name: str) -> Row:
        found = table.get(data[f"{name}_token"])
        if found is None:
            raise FramesError(
                f"{self.folder / name}.json: no {data[f'{name}_token']}, which"
                f" {data['filename']} names"
            )
        return found


def _objects(path: Path) -> Iterator[dict[str, Any]]:
    decode = json.JSONDecoder().raw_decode
    documents.check_regular(path)
    with path.open(encoding="utf-8") as file:
        # The file is one array of rows.
        text, at = file.read(PIECE), 0
        at = _past(text, at, " \t\r\n")
        if text[at : at + 1] != "[":
            raise documents.MalformedError("it does not begin with [")
        at += 1
        while True:
            at = _past(text, at, _SPACE)
            if text[at : at + 1] == "]":
                return
            # Decode one row; at the end of the piece, read another one.
            try:
                row, at = decode(text, at)
            except (ValueError, RecursionError) as error:
                more = file.read(PIECE)
                if not more or len(text) - at > PIECE:
                    line = (
                        f"it breaks off or is malformed behind {text[at : at + 40]!r}"
                    )
                    raise documents.MalformedError(line) from error
                text, at = text[at:] + more, 0
                continue
            if not isinstance(row, dict):
                raise documents.MalformedError(f"{row!r} is not a row")
            yield row


def _past(text: str, at: int, what: str) -> int:
    while at < len(text) and text[at] in what:
        at += 1
    return at
