"""Recorded driving as a policy sees it, for a graph that drives through an adapter."""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from driving_logs.commands import command_at
from driving_logs.model_inputs import changes
from driving_logs.moments import (
    CAMERAS,
    CameraLog,
    LogMoment,
    LogScene,
)
from driving_logs.pictures import read_pixels
from me2e_compress.base.errors import EvaluationError, FramesError
from me2e_compress.driving.contract import EgoKinematics, Observation
from me2e_compress.driving.onnx_policy import OnnxPolicy
from me2e_compress.runtime.frames import Array


@dataclass(frozen=True)
class AdaptedInputs:
    """The moments of a log as the inputs of a graph, laid out as its adapter says."""

    policy: OnnxPolicy

    def log_for(self, log: CameraLog) -> CameraLog:
        """Return the log in the contract's axes, with the cameras the graph sees."""
        for option in ("cameras", "size", "width"):
            if getattr(log, option):
                raise FramesError(
                    f"{log.name}: {option} and the adapter's [images] both say what"
                    " the model sees: leave one out"
                )
        seen = tuple(CAMERAS[at] for at in self.policy.inputs.cameras)
        return dataclasses.replace(log.as_contract(), cameras=seen)

    def check(self, log: CameraLog) -> None:
        """Check nothing: the policy ran on zeros when it was opened."""

    def arrays(
        self, log: CameraLog, scene: LogScene, at: int, before: int | None
    ) -> dict[str, Array]:
        """Return the model's inputs at a moment, with first values at a scene's start.

        Raises:
            FramesError: A picture cannot be read, or the log lacks what an input needs.
        """
        if before is None:
            self.policy.reset(None)
        seen = self._observation(log, scene, at, before)
        try:
            feeds = self.policy.inputs.feeds(seen)
            first = self.policy.first_values(feeds) if before is None else {}
        except EvaluationError as error:
            raise FramesError(f"{log.name}: {error}") from error
        return {**feeds, **first}

    def _observation(
        self, log: CameraLog, scene: LogScene, at: int, before: int | None
    ) -> Observation:
        now = scene[at]
        to_ego = np.linalg.inv(now.lidar_to_ego)
        rows, columns = self.policy.image_size
        images = np.zeros((len(CAMERAS), rows, columns, 3), np.uint8)
        projections = np.tile(np.eye(4), (len(CAMERAS), 1, 1))
        # cameras that the graph does not see stay black
        for camera in log.seen:
            if camera not in now.pictures:
                there = ", ".join(now.pictures)
                raise FramesError(f"{log.name}: no camera {camera}; there is {there}")
            picture, place = read_pixels(now.pictures[camera], (rows, columns))
            images[CAMERAS.index(camera)] = picture
            looks = place @ now.lidar_to_image[camera] @ to_ego
            projections[CAMERAS.index(camera)] = looks
        # the CAN bus holds differences to the moment before
        bus = changes(now, None if before is None else scene[before])
        return Observation(
            now.time_us - scene[0].time_us,
            images,
            projections.astype(np.float32),
            bus.astype(np.float32),
            command_at(log, scene, at),
            float(now.can_bus[7]),
            motion=_motion(now),
        )


def _motion(now: LogMoment) -> EgoKinematics:
    """Return the ego state; the CAN bus must be laid out as the contract's."""
    to_world = now.lidar_to_world @ np.linalg.inv(now.lidar_to_ego)
    x, y = to_world[:2, 3].tolist()
    heading = math.atan2(to_world[1, 0], to_world[0, 0])
    speed, *moving = now.can_bus[[7, *range(10, 16)]].tolist()
    ax, ay, az, roll, pitch, yaw = moving
    return EgoKinematics(x, y, heading, speed, (ax, ay, az), (roll, pitch, yaw))
