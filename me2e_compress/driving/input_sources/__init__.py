"""Input sources by name: what a model can be fed with.

To add a source: write its class, then add it to the table.
"""

from me2e_compress.driving.input_sources.base import InputSource, Observed
from me2e_compress.errors import EvaluationError
from me2e_compress.registry import Registry

__all__ = ["INPUT_SOURCES", "InputSource", "Observed"]

_HERE = "me2e_compress.driving.input_sources"

INPUT_SOURCES: Registry[InputSource] = Registry(
    "input source",
    "me2e_compress.input_sources",
    EvaluationError,
    {
        "speed": f"{_HERE}.ego_motion:Speed",
        "velocity": f"{_HERE}.ego_motion:Velocity",
        "acceleration": f"{_HERE}.ego_motion:Acceleration",
        "yaw-rate": f"{_HERE}.ego_motion:YawRate",
        "command": f"{_HERE}.navigation:NavigationCommand",
        "target-point": f"{_HERE}.navigation:TargetPoint",
        "past": f"{_HERE}.past:Past",
        "can-bus": f"{_HERE}.can_bus_layouts:CanBus",
        "timestamp": f"{_HERE}.clock:Timestamp",
        "use-previous": f"{_HERE}.clock:UsePrevious",
        "l2g-rotation": f"{_HERE}.lidar_pose:LidarToGlobalRotation",
        "l2g-translation": f"{_HERE}.lidar_pose:LidarToGlobalTranslation",
        "lidar2img": f"{_HERE}.camera_geometry:LidarToImage",
        "lidar2cam": f"{_HERE}.camera_geometry:LidarToCamera",
        "intrinsics": f"{_HERE}.camera_geometry:Intrinsics",
        "constant": f"{_HERE}.constant:ConstantInput",
    },
)
