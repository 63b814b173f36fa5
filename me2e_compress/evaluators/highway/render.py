"""Pictures of how a policy drives one route."""

from dataclasses import dataclass, field
from pathlib import Path

from me2e_compress.evaluators.highway.runner import Listeners, drive
from me2e_compress.evaluators.highway.worker import Job
from me2e_compress.simulator.cameras import paint_texture
from me2e_compress.simulator.pictures.route import (
    Moment,
    RoutePicture,
    write_gif,
    write_png,
)
from me2e_compress.simulator.routes import Route
from me2e_compress.simulator.world import World

EVERY_US = 200_000
"""Simulated time between two frames of an animation."""
STRIP = 4


@dataclass
class _Film:
    """Keeps every fourth moment, and the last one."""

    kept: list[Moment] = field(default_factory=list)
    last: Moment | None = None

    def see(self, moment: Moment) -> None:
        self.last = moment
        if moment.scene.time_us % EVERY_US == 0:
            self.kept.append(moment)

    @property
    def moments(self) -> list[Moment]:
        if self.last is None or self.kept[-1] is self.last:
            return self.kept
        return [*self.kept, self.last]


def render(job: Job, route: Route, folder: Path) -> tuple[Path, Path]:
    """Drive a route again and draw it; return an animation and a strip.

    The animation shows six cameras and the view from above with the plan, infractions
    marked; the strip shows four moments including the end.
    """
    film = _Film()
    drive(route, job.driver.open(), job.conditions, Listeners(on_moment=film.see))
    world = World(route)
    texture = paint_texture(world.roadmap, world.path.points)
    title = f"{route.scenario} {route.id} {job.driver.label}"
    moments = film.moments
    picture = RoutePicture(title, texture, world.path.points, moments)
    gif, png = folder / f"{route.id}.gif", folder / f"{route.id}.png"
    write_gif(gif, picture.frames(), EVERY_US)
    chosen = [i * (len(moments) - 1) // (STRIP - 1) for i in range(STRIP)]
    write_png(png, picture.strip(chosen))
    return gif, png
