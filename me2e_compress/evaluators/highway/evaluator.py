"""Closed-loop evaluation in highway-env: routes that do not depend on one another."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

from me2e_compress.base.errors import EvaluationError
from me2e_compress.base.extras import require_extra
from me2e_compress.base.listener import Listener
from me2e_compress.driving.contract import RouteInfo
from me2e_compress.driving.policies import Driver, opened
from me2e_compress.evaluators.contract import ABILITIES, Drive, Engine, Evaluator
from me2e_compress.evaluators.highway.drivers import image_size_of
from me2e_compress.evaluators.highway.engine import LocalEngine
from me2e_compress.evaluators.results import log_cost
from me2e_compress.metrics.episode import Episode
from me2e_compress.simulator.routes import (
    EXPERT_S,
    ROAD_VERSION,
    VERSION,
    Route,
    digest_of,
    load_routes,
    pick_routes,
)
from me2e_compress.version import __version__

STRIP = 4  # moments of the strip
EVERY_US = 200_000  # simulated time between two frames of an animation


@dataclass(frozen=True)
class Highway(Evaluator):
    """Drives a policy over routes of highway-env."""

    name: ClassVar[str] = "highway"
    takes: ClassVar[frozenset[str]] = frozenset(ABILITIES)

    @property
    def label(self) -> str:
        """The simulator."""
        return "highway-env"

    def routes(
        self, words: str, beside: Path = Path()
    ) -> tuple[tuple[Route, ...], int]:
        """Return routes by ``all``, a number, ``ID,ID`` or a file's name."""
        is_file = words.endswith(".json")
        routes = load_routes(beside / words) if is_file else load_routes()
        return routes if is_file else pick_routes(routes, words), len(routes)

    def check_policy(self, policy: Driver) -> None:
        """Open a policy once; highway-env is an extra."""
        require_extra("highway", "driving")
        opened(policy)

    def made_by(self, policy: Driver | None, drive: Drive) -> dict[str, Any]:
        """Return policy, image size, conditions and a digest of the routes."""
        if policy is None:
            raise EvaluationError(f"{self.name} drives a policy: name one")
        require_extra("highway", "driving")
        image_size = image_size_of(opened(policy))  # before its file is read
        made = drive.conditions()
        weather = made.pop("weather")
        return {
            VERSION: ROAD_VERSION,
            "version": __version__,
            "policy": policy.fingerprint(),
            **made,
            "image_size": list(image_size),
            "weather": weather,
            "frame_limit_s": drive.frame_limit_s,
            "set_size": drive.set_size,
            "routes_sha256": digest_of(_highway_routes(drive.routes)),
        }

    def episodes(
        self, policy: Driver | None, drive: Drive, folder: Path, listener: Listener
    ) -> Iterator[Episode]:
        """Drive the routes, the longest first; log what each costs beside the folder.

        Raises:
            EvaluationError: There is no route or no policy, or a process was killed.
        """
        if policy is None or not drive.routes:
            raise EvaluationError("there is no route to drive, or no policy")
        engine: Engine = drive.engine or LocalEngine()
        if drive.latency.measures and engine != LocalEngine():
            listener.on_warning(
                "latency is measured here: routes driven in parallel would disturb "
                "it, so they are driven one at a time"
            )
            engine = LocalEngine()
        # A long route that starts last would leave all other workers waiting
        ordered = longest_first(_highway_routes(drive.routes))
        for driven in engine.drive(policy, replace(drive, routes=()), ordered):
            log_cost(folder, driven)
            yield driven.episode

    def render(
        self, policy: Driver, drive: Drive, route: RouteInfo, folder: Path
    ) -> tuple[Path, ...]:
        """Drive a route again and draw it; return an animation and a strip.

        The animation shows six cameras and the view from above with the plan,
        infractions marked; the strip shows four moments including the end.
        """
        from me2e_compress.evaluators.highway import runner
        from me2e_compress.simulator.cameras.ground import paint_texture
        from me2e_compress.simulator.pictures import Moment, RoutePicture, write_picture
        from me2e_compress.simulator.world import World

        moments: list[Moment] = []
        (ours,) = _highway_routes([route])

        def on_moment(moment: Moment) -> None:
            # Every fourth moment stays, and the last one
            if moments and moments[-1].scene.time_us % EVERY_US:
                moments.pop()
            moments.append(moment)

        runner.drive(ours, policy.open(), drive, runner.Listeners(on_moment=on_moment))
        # Draw all moments, then four of them side by side
        world, title = World(ours), f"{ours.scenario} {ours.id} {policy.label}"
        texture = paint_texture(world.roadmap, world.path.points)
        picture = RoutePicture(title, texture, world.path.points, moments)
        gif, png = folder / f"{ours.id}.gif", folder / f"{ours.id}.png"
        write_picture(gif, picture.frames(), EVERY_US)
        chosen = [i * (len(moments) - 1) // (STRIP - 1) for i in range(STRIP)]
        write_picture(png, [picture.strip(chosen)])
        return gif, png


def _highway_routes(routes: Sequence[RouteInfo]) -> list[Route]:
    """Return routes of highway's own kind; an EvaluationError of any others."""
    ours = [route for route in routes if isinstance(route, Route)]
    if len(ours) < len(routes):
        raise EvaluationError("highway drives routes of its own kind alone")
    return ours


def longest_first(routes: Sequence[Route]) -> list[Route]:
    """Order routes by the typical duration of their type, longest first."""
    return sorted(routes, key=lambda route: (-EXPERT_S[route.scenario], route.id))
