"""Pictures of how a policy drives one route, alone or beside another."""

import contextlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from me2e_compress.driving.policies import Driver
from me2e_compress.evaluators.contract import Drive
from me2e_compress.evaluators.highway import runner
from me2e_compress.simulator.cameras.ground import paint_texture
from me2e_compress.simulator.pictures.route import (
    Moment,
    RoutePicture,
    overlay,
    write_gif,
    write_png,
)
from me2e_compress.simulator.routes import Route
from me2e_compress.simulator.world import World

EVERY_US = 200_000
"""Simulated time between two frames of an animation."""
STRIP = 4
_NO_IMAGES = np.zeros((0, 0, 0, 3), np.uint8)


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
    write_gif(gif, picture.frames(), EVERY_US)
    chosen = [i * (len(moments) - 1) // (STRIP - 1) for i in range(STRIP)]
    write_png(png, picture.strip(chosen))
    return gif, png


def overlay_drives(
    labelled: Sequence[tuple[str, Driver, Drive]],
    route: Route,
    time_us: int,
    path: Path,
) -> None:
    """Drive a route with each up to a moment, and lay the views over one another."""
    pictures = [
        _picture(label, route, watch(policy, drive, route, time_us))
        for label, policy, drive in labelled
    ]
    write_png(path, overlay(*pictures))


def _picture(title: str, route: Route, moments: list[Moment]) -> RoutePicture:
    world = World(route)
    texture = paint_texture(world.roadmap, world.path.points)
    return RoutePicture(title, texture, world.path.points, moments)


class _Enough(Exception):  # noqa: N818 - it ends a drive, nothing went wrong
    """Ends a drive once the moment was seen."""


def watch(policy: Driver, drive: Drive, route: Route, until_us: int) -> list[Moment]:
    """Drive a route, and return its moments; only the last one has camera images."""
    moments = list[Moment]()

    def see(moment: Moment) -> None:
        if moments:
            moments[-1] = replace(moments[-1], images=_NO_IMAGES)
        moments.append(moment)
        if moment.scene.time_us >= until_us:
            raise _Enough

    with contextlib.suppress(_Enough):
        runner.drive(route, policy.open(), drive, runner.Listeners(on_moment=see))
    return moments
