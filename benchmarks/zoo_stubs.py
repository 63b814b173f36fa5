"""What Bench2Drive's own Python imports and no laptop has: CARLA, srunner, mmcv.

The modules hold just enough for the leaderboard's AutonomousAgent, AgentWrapper and
SensorInterface and for Bench2DriveZoo's VAD agent to run as they are, in the small
world of `tests.evaluators.carla.small_leaderboard`. The network is left out: its plan
goes straight on, a little to the right, and what it was given is kept.
"""

import datetime
import math
import sys
from collections.abc import Iterator
from enum import IntEnum
from importlib.util import find_spec
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np

from tests.evaluators.carla.small_leaderboard import DT_S, VehicleControl, World


class RoadOption(IntEnum):
    """CARLA's, whole."""

    VOID = -1
    LEFT = 1
    RIGHT = 2
    STRAIGHT = 3
    LANEFOLLOW = 4
    CHANGELANELEFT = 5
    CHANGELANERIGHT = 6


class Anything:
    """Takes every call and has every attribute."""

    def __init__(self, *given: Any, **named: Any) -> None:
        pass

    def __call__(self, *given: Any, **named: Any) -> "Anything":
        return self

    def __getattr__(self, name: str) -> "Anything":
        return Anything()


class Quaternion:
    """Of a turn about the vertical axis."""

    def __init__(self, axis: Any, radians: float) -> None:
        self.radians = radians

    def __iter__(self) -> Iterator[float]:
        half = self.radians / 2
        return iter((math.cos(half), 0.0, 0.0, math.sin(half)))

    @property
    def rotation_matrix(self) -> Any:
        sin, cos = math.sin(self.radians), math.cos(self.radians)
        return np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])


class Network:
    """Stands where VAD is; `given` is what its agent made of the sensors."""

    def __init__(self) -> None:
        self.given = list[dict[str, Any]]()

    def cuda(self) -> None:
        pass

    def eval(self) -> None:
        pass

    def __call__(self, batch: Any, **options: Any) -> Any:
        from torch import tensor

        self.given.append(batch["inputs"][0])
        steps = np.tile([0.02, 2.0], (6, 6, 1))
        return [{"pts_bbox": {"ego_fut_preds": tensor(steps)}}]


def install(world: World, network: Network) -> None:
    """Put all modules where imports find them."""
    hero = world.hero
    hero.attributes = {"role_name": "hero"}
    stepped = SimpleNamespace(fixed_delta_seconds=DT_S)
    theirs = SimpleNamespace(get_actors=lambda: [hero], get_settings=lambda: stepped)
    data = SimpleNamespace(get_world=lambda: theirs)
    clock = SimpleNamespace(
        get_frame=lambda: world.frame,
        get_time=lambda: world.frame * DT_S,
        get_wallclocktime=datetime.datetime.now,
    )
    kinds = dict.fromkeys(
        ("Image", "LidarMeasurement", "RadarMeasurement", "GnssMeasurement"), Anything
    )
    config = SimpleNamespace(
        fromfile=lambda path: SimpleNamespace(
            model=None, inference_only_pipeline=[], get=lambda name: None
        )
    )
    places = {"Location": Anything, "Rotation": Anything, "Transform": Anything}
    _put(
        "carla",
        VehicleControl=VehicleControl,
        libcarla=SimpleNamespace(**kinds, IMUMeasurement=Anything),
        **places,
    )
    _put("srunner")
    _put("srunner.scenariomanager")
    _put("srunner.scenariomanager.carla_data_provider", CarlaDataProvider=data)
    _put("srunner.scenariomanager.timer", GameTime=clock)
    _put("agents")
    _put("agents.navigation")
    _put("agents.navigation.global_route_planner", GlobalRoutePlanner=Anything)
    _put("agents.navigation.local_planner", RoadOption=RoadOption)
    _put("leaderboard.autoagents.ros_base_agent", ROSBaseAgent=Anything)
    _put("mmcv", Config=config)
    _put("mmcv.models", build_model=lambda *given, **named: network)
    same = {"wrap_fp16_model": None, "init_dist": None, "get_dist_info": None}
    _put("mmcv.utils", load_checkpoint=Anything(), **same)
    _put("mmcv.datasets")
    _put("mmcv.datasets.pipelines", Compose=lambda steps: lambda inputs: inputs)
    _put("mmcv.parallel")
    _put(
        "mmcv.parallel.collate",
        collate=lambda given, samples_per_gpu: {"inputs": given, "img_metas": None},
    )
    _put("mmcv.core")
    _put("mmcv.core.bbox", get_box_type=lambda name: (None, None))
    _put("pyquaternion", Quaternion=Quaternion)
    if find_spec("torchvision") is None:
        _put("torchvision")
        _put("torchvision.transforms", **dict.fromkeys(TRANSFORMS, Anything))


TRANSFORMS = ("Compose", "ToTensor", "Normalize")


def _put(name: str, **members: Any) -> None:
    module = ModuleType(name)
    vars(module).update(members)
    sys.modules[name] = module
