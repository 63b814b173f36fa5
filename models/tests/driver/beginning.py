"""Drive only the beginning of a route."""

from contextlib import suppress

from me2e_compress.driving.contract import Policy
from me2e_compress.evaluators import Drive
from me2e_compress.evaluators.highway.runner import Listeners, drive
from me2e_compress.simulator.routes import Route
from me2e_compress.simulator.world import World


class EnoughError(Exception):
    """The rest is not driven."""


def drive_beginning(route: Route, policy: Policy, until_us: int) -> None:
    def look(world: World) -> None:
        if world.time_us >= until_us:
            raise EnoughError

    with suppress(EnoughError):
        drive(route, policy, Drive(), Listeners(on_query=look))
