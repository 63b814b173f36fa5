"""Recorded driving: data sets from which frames are made.

To add a data set, write its class, then add it to this table.
"""

from me2e_compress.calibration.logs.base import Agent, DriveLog, LogMoment, LogScene
from me2e_compress.errors import FramesError
from me2e_compress.registry import Registry

__all__ = ["LOGS", "Agent", "DriveLog", "LogMoment", "LogScene"]

_HERE = "me2e_compress.calibration.logs"

LOGS: Registry[DriveLog] = Registry(
    "driving log",
    "me2e_compress.logs",
    FramesError,
    {
        "nuscenes": f"{_HERE}.nuscenes_log:NuScenesLog",
        "bench2drive": f"{_HERE}.bench2drive_log:Bench2DriveLog",
    },
)
