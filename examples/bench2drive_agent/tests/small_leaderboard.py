"""The interface of CARLA and its leaderboard, written anew and small.

One vehicle on an endless plain, x east, y south, yaw clockwise, as in CARLA; 20 Hz. The
evaluator makes an agent, names it the route, sets it up, asks for its sensors, ticks it
and destroys it, in the order of Bench2Drive's; ControlLoss changes in place what the
agent returned.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum, IntEnum
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np

DT_S = 0.05
EARTH_M = 6378137.0
LATITUDE, LONGITUDE = 42.0, 2.0
SAVE_NAME = "RouteScenario_1711_rep0_Town12_ParkingCutIn_1_15_06_16_22_20_36"


class VehicleControl:
    """Like CARLA's: neither copy nor pickle takes it."""

    def __init__(self) -> None:
        self.throttle = self.steer = self.brake = 0.0
        self.hand_brake = self.reverse = self.manual_gear_shift = False
        self.gear = 0

    def __reduce_ex__(self, protocol: Any) -> Any:
        raise RuntimeError("Pickling of VehicleControl instances is not enabled")


class Track(Enum):
    SENSORS = "SENSORS"


class RoadOption(IntEnum):
    VOID = -1
    LEFT = 1
    RIGHT = 2
    STRAIGHT = 3
    LANEFOLLOW = 4


def vector(x: float, y: float, z: float) -> SimpleNamespace:
    return SimpleNamespace(x=x, y=y, z=z)


@dataclass
class World:
    """Where the hero is; it asks itself what it senses.

    ``mirrored`` GPS latitudes fall to the north, as in CARLA 0.9.16.
    """

    x: float = 0.0
    y: float = 0.0
    yaw_deg: float = 0.0
    speed: float = 0.0
    acceleration: float = 0.0
    turn_deg: float = 0.0
    frame: int = 0
    mirrored: bool = False
    sensors: list[dict[str, Any]] = field(default_factory=list)

    def tick(self, control: VehicleControl | None) -> None:
        self.frame += 1
        throttle, brake, steer = (
            (0.0, 0.0, 0.0)
            if control is None
            else (control.throttle, control.brake, control.steer)
        )
        before = self.speed
        self.speed = max(0.0, self.speed + DT_S * (4.0 * throttle - 8.0 * brake))
        self.acceleration = (self.speed - before) / DT_S
        self.turn_deg = math.degrees(self.speed / 5.0 * steer * 0.6)
        self.yaw_deg += self.turn_deg * DT_S
        yaw = math.radians(self.yaw_deg)
        self.x += self.speed * math.cos(yaw) * DT_S
        self.y += self.speed * math.sin(yaw) * DT_S

    @property
    def hero(self) -> SimpleNamespace:
        """The ego's actor; like CARLA's, it tells how things are when it is asked."""
        return SimpleNamespace(
            get_acceleration=lambda: vector(*self._pushed(), 0.0),
            get_angular_velocity=lambda: vector(0.0, 0.0, self.turn_deg),
            get_transform=self._transform,
        )

    def _pushed(self) -> tuple[float, float]:
        yaw = math.radians(self.yaw_deg)
        return self.acceleration * math.cos(yaw), self.acceleration * math.sin(yaw)

    def _transform(self) -> SimpleNamespace:
        yaw = math.radians(self.yaw_deg)
        return SimpleNamespace(
            location=vector(self.x, self.y, 0.0),
            rotation=SimpleNamespace(roll=0.0, pitch=0.0, yaw=self.yaw_deg),
            get_forward_vector=lambda: vector(math.cos(yaw), math.sin(yaw), 0.0),
            get_right_vector=lambda: vector(-math.sin(yaw), math.cos(yaw), 0.0),
        )

    def sensed(self) -> dict[str, tuple[int, Any]]:
        return {each["id"]: (self.frame, self._sense(each)) for each in self.sensors}

    def _sense(self, spec: dict[str, Any]) -> Any:
        kind = spec["type"]
        if kind == "sensor.camera.rgb":
            image = np.zeros((spec["height"], spec["width"], 4), np.uint8)
            image[..., 2] = 200  # BGRA: red
            return image
        if kind == "sensor.other.gnss":
            return np.array(
                [*gps_of(self.x, -self.y if self.mirrored else self.y), 0.0]
            )
        if kind == "sensor.other.imu":
            compass = math.radians(self.yaw_deg) + math.pi / 2
            gyro = math.radians(self.turn_deg)
            first = math.nan if self.frame == 1 else compass
            return np.array([self.acceleration, 0.0, 9.81, 0.0, 0.0, gyro, first])
        if kind == "sensor.speedometer":
            return {"speed": np.float64(self.speed)}
        raise AssertionError(kind)


def gps_of(x: float, y: float) -> tuple[float, float]:
    """Latitude and longitude, by CARLA's Mercator projection."""
    scale = math.cos(math.radians(LATITUDE)) * EARTH_M
    north = scale * math.log(math.tan(math.radians(90 + LATITUDE) / 2)) - y
    east = scale * math.radians(LONGITUDE) + x
    latitude = math.degrees(2 * math.atan(math.exp(north / scale))) - 90
    return latitude, math.degrees(east / scale)


Route = list[tuple[float, float, RoadOption]]
STRAIGHT_ON: Route = [(20.0 * k, 0.0, RoadOption.LANEFOLLOW) for k in range(6)]


@dataclass
class Leaderboard:
    """What runs an agent for a number of ticks."""

    world: World = field(default_factory=World)
    returned: list[VehicleControl] = field(default_factory=list)
    seen: list[tuple[float, float, float]] = field(default_factory=list)
    noise: float = 0.125

    def make(self, module: ModuleType, config: str, route: Route = STRAIGHT_ON) -> Any:
        """Make an agent and set it up for a route."""
        made = getattr(module, module.get_entry_point())
        assert made.get_ros_version() == -1
        agent = made("localhost", 2000, False)
        plan = [({**_gps(x, y), "z": 0.0}, option) for x, y, option in route]
        places = [
            (SimpleNamespace(location=vector(x, y, 0.0)), option)
            for x, y, option in route
        ]
        agent.set_global_plan(plan, places)
        agent.setup(config)
        assert agent.track is Track.SENSORS
        self.world.sensors = agent.sensors()
        names = [each["id"] for each in self.world.sensors]
        assert len(set(names)) == len(names)
        agent.sensor_interface.read = self.world.sensed
        return agent

    def run(
        self,
        agent: Any,
        ticks: int,
        meanwhile: Callable[[World], None] = lambda world: None,
    ) -> None:
        """Tick; what the agent returned is noted as it is, then spoilt in place."""
        control = None
        for _ in range(ticks):
            self.world.tick(control)
            meanwhile(self.world)
            control = agent()
            self.seen.append((control.throttle, control.steer, control.brake))
            self.returned.append(control)
            control.steer += self.noise  # ControlLoss

    def drive(
        self, module: ModuleType, config: str, ticks: int, route: Route = STRAIGHT_ON
    ) -> Any:
        """Make, run and destroy, whatever happens."""
        agent = self.make(module, f"{config}+{SAVE_NAME}", route)
        try:
            self.run(agent, ticks)
        finally:
            agent.destroy()
        return agent


def _gps(x: float, y: float) -> dict[str, float]:
    latitude, longitude = gps_of(x, y)
    return {"lat": latitude, "lon": longitude}


def _listed(found: SimpleNamespace) -> list[float]:
    return [found.x, found.y, found.z]


class SensorInterface:
    read: Callable[[], dict[str, tuple[int, Any]]]

    def get_data(self) -> dict[str, tuple[int, Any]]:
        return self.read()


def modules(board: Leaderboard) -> dict[str, ModuleType]:
    """Build the modules ``carla`` and ``leaderboard`` for one world."""

    class AutonomousAgent:
        def __init__(self, carla_host: str, carla_port: int, debug: bool = False):
            self.track = Track.SENSORS
            self._global_plan: Any = None
            self._global_plan_world_coord: Any = None
            self.sensor_interface = SensorInterface()
            self.wallclock_t0: object = None
            self.hero_actor = board.world.hero

        def __call__(self) -> VehicleControl:
            data = self.sensor_interface.get_data()
            self.wallclock_t0 = self.wallclock_t0 or object()
            control = self.run_step(data, board.world.frame * DT_S)
            control.manual_gear_shift = False
            return control

        def run_step(self, input_data: Any, timestamp: float) -> VehicleControl:
            return VehicleControl()

        def destroy(self) -> None:
            pass

        @staticmethod
        def get_ros_version() -> int:
            return -1

        def set_global_plan(self, gps: Any, world_coord: Any) -> None:
            self._global_plan, self._global_plan_world_coord = gps, world_coord

        def get_metric_info(self) -> dict[str, list[float]]:
            hero = board.world.hero
            at = hero.get_transform()
            turned = at.rotation
            return {
                "acceleration": _listed(hero.get_acceleration()),
                "angular_velocity": _listed(hero.get_angular_velocity()),
                "forward_vector": _listed(at.get_forward_vector()),
                "right_vector": _listed(at.get_right_vector()),
                "location": _listed(at.location),
                "rotation": [turned.roll, turned.pitch, turned.yaw],
            }

    carla = ModuleType("carla")
    carla.VehicleControl = VehicleControl  # type: ignore[attr-defined]
    agent = ModuleType("leaderboard.autoagents.autonomous_agent")
    agent.AutonomousAgent = AutonomousAgent  # type: ignore[attr-defined]
    agent.Track = Track  # type: ignore[attr-defined]
    return {
        "carla": carla,
        "leaderboard": ModuleType("leaderboard"),
        "leaderboard.autoagents": ModuleType("leaderboard.autoagents"),
        "leaderboard.autoagents.autonomous_agent": agent,
    }
