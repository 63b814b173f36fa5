"""The weights that ship, in closed loop; five CPU seconds."""

from me2e_compress.evaluators import Drive
from me2e_compress.evaluators.highway.drivers import OnnxDriver
from me2e_compress.evaluators.highway.runner import drive
from me2e_compress.metrics.episode import Ending
from me2e_compress.metrics.route_scores import route_score
from me2e_compress.shipped.drivers import shipped
from me2e_compress.simulator.routes import load_routes, pick_routes


def test_the_shipped_driver_passes_a_parked_car() -> None:
    """A route that nobody passes blindly, and one of the shortest."""
    (route,) = pick_routes(load_routes(), "ParkedObstacle_R2_0")
    policy = OnnxDriver(shipped("highway")).open()

    episode = drive(route, policy, Drive())

    assert (episode.ending, episode.infractions) == (Ending.COMPLETED, ())
    assert route_score(episode).composed == 100.0
