"""Small helpers of the world's tests."""

from me2e_compress.driving.latency import FixedLatency
from me2e_compress.evaluators import Drive
from me2e_compress.evaluators.highway.runner import drive
from me2e_compress.metrics.episode import Infraction, InfractionKind
from me2e_compress.simulator.routes import Parameter, Route
from me2e_compress.simulator.scenarios.roads import two_way
from me2e_compress.simulator.scene import Control
from me2e_compress.simulator.traffic.stage import Stage
from me2e_compress.simulator.world import World
from models.driver.expert.blind import Blind

ENDS_ONLY = (
    InfractionKind.ROUTE_TIMEOUT,
    InfractionKind.VEHICLE_BLOCKED,
    InfractionKind.ROUTE_DEVIATION,
)


def route_of(
    scenario: str = "Accident", seed: int = 0, **parameters: Parameter
) -> Route:
    return Route("test", scenario, seed, dict(parameters))


def empty_road(stage: Stage) -> None:
    two_way(stage)


def coast(world: World, frames: int, control: Control | None = None) -> None:
    for _ in range(frames):
        if world.done:
            return
        world.step(control or Control(0.0, 0.0))


def drive_blind(route: Route, speed_mps: float) -> list[Infraction]:
    """What was done wrong; that the end was not reached does not count."""
    episode = drive(route, Blind(speed_mps), Drive(FixedLatency(100_000)))
    return [one for one in episode.infractions if one.kind not in ENDS_ONLY]


def trace(route: Route, frames: int = 200, dt_us: int = 50_000) -> list[object]:
    """Everything that is visible, frame by frame, at full precision."""
    world, seen = World(route, dt_us=dt_us), list[object]()
    for _ in range(frames):
        if world.done:
            break
        world.step(Control(0.5, 0.0))
        seen.append(world.scene())
    return [*seen, world.events, world.reason]
