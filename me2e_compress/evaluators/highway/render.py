"""Pictures of how a policy drives one route, alone or beside another."""

from pathlib import Path

from me2e_compress.driving.policies import Driver
from me2e_compress.evaluators.contract import Drive
from me2e_compress.evaluators.highway import runner
from me2e_compress.simulator.cameras.ground import paint_texture
from me2e_compress.simulator.pictures import (
    Moment,
    RoutePicture,
    write_picture,
)
from me2e_compress.simulator.routes import Route
from me2e_compress.simulator.world import World

EVERY_US = 200_000
"""Simulated time between two frames of an animation."""
STRIP = 4


def render(
    policy: Driver, drive: Drive, route: Route, folder: Path
) -> tuple[Path, Path]:
    """Drive a route again and draw it; return an animation and a strip.

    The animation shows six cameras and the view from above with the plan, infractions
    marked; the strip shows four moments including the end.
    """
    moments = list[Moment]()

    def see(moment: Moment) -> None:
        # every fourth moment stays, and the last one
        if moments and moments[-1].scene.time_us % EVERY_US:
            moments.pop()
        moments.append(moment)

    runner.drive(route, policy.open(), drive, runner.Listeners(on_moment=see))
    picture = _picture(f"{route.scenario} {route.id} {policy.label}", route, moments)
    gif, png = folder / f"{route.id}.gif", folder / f"{route.id}.png"
    write_picture(gif, picture.frames(), EVERY_US)
    chosen = [i * (len(moments) - 1) // (STRIP - 1) for i in range(STRIP)]
    write_picture(png, [picture.strip(chosen)])
    return gif, png


def _picture(title: str, route: Route, moments: list[Moment]) -> RoutePicture:
    world = World(route)
    texture = paint_texture(world.roadmap, world.path.points)
    return RoutePicture(title, texture, world.path.points, moments)
