import numpy as np

from me2e_compress.simulator.plane_geometry import resample
from me2e_compress.simulator.scene import Control
from me2e_compress.simulator.world import World
from models.driver.expert.privileged import privileged
from tests.simulator.world.driving import route_of


def test_an_intent_leads_where_the_actor_goes() -> None:
    world = World(route_of("NonSignalizedJunctionRightTurn", 2))
    (intent, *_) = privileged(world).intents
    way = resample(intent.path, 0.25)
    for _ in range(60):
        world.step(Control(-8.0, 0.0))
        actors = {actor.id: actor for actor in world.scene().actors}
        if intent.actor_id not in actors:
            break
        actor = actors[intent.actor_id]
        away = np.hypot(*(way - (actor.x, actor.y)).T).min()
        assert away < 0.5


def test_phases_are_those_on_the_route() -> None:
    world = World(route_of("VanillaSignalizedTurnEncounterRedLight", 1))

    (phase,) = privileged(world).phases

    assert len(world.scene().signals) == 4
    assert phase.state == "red"
    assert 70 < phase.line_s < 130
