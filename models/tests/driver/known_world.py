"""The tiny world of which all is known, for the expert to drive on."""

from dataclasses import dataclass

from me2e_compress.evaluators.highway.controller import AnchoredPlan
from me2e_compress.simulator.scene import Control, Scene
from models.driver.expert.expert_policy import Memory, ceiling, decide
from models.driver.expert.privileged import Intent, Phase, Privileged
from tests.evaluators.highway.tiny_world import DT_US, TinyWorld


@dataclass
class KnownWorld(TinyWorld):
    intents: tuple[Intent, ...] = ()

    def privileged(self) -> Privileged:
        phases = (Phase(s.id, s.stop_line[0][0], s.state) for s in self.signals)
        return Privileged(self.intents, tuple(phases))


def drive(world: KnownWorld, seconds: float, every: int = 1) -> list[Scene]:
    """Let the expert drive through the controller; all scenes, the last included."""
    top, memory = ceiling(world.path), Memory()
    scenes, control = [world.scene()], Control(0.0, 0.0)
    for frame in range(round(seconds * 1e6 / DT_US)):
        if frame % every == 0:
            scene = world.scene()
            decision = decide(scene, world.privileged(), world.path, top, memory)
            memory = decision.memory
            plan = AnchoredPlan.of(decision.waypoints, scene.ego, scene.time_us)
            control = plan.control(scene.ego, scene.time_us)
        world.step(control)
        scenes.append(world.scene())
        if world.touches:
            break
    return scenes
