"""The tiny world of which all is known, for the expert to drive on."""

import math
from dataclasses import dataclass

from me2e_compress.evaluators.highway.controller import AnchoredPlan
from me2e_compress.simulator.scene import (
    Control,
    Scene,
    Signal,
    SignalKind,
    SignalState,
)
from models.driver.expert.expert_policy import Memory, ceiling, decide
from models.driver.expert.privileged import Intent, Phase, Privileged
from tests.evaluators.highway.tiny_world import DT_US, TinyWorld


def signal_at(x: float, kind: SignalKind, state: SignalState | None = None) -> Signal:
    return Signal(1, kind, x, -3.0, 0.0, state, ((x, 1.75), (x, -1.75)))


@dataclass
class KnownWorld(TinyWorld):
    intents: tuple[Intent, ...] = ()

    def privileged(self) -> Privileged:
        phases = (Phase(s.id, s.stop_line[0][0], s.state) for s in self.signals)
        return Privileged(self.intents, tuple(phases))

    @property
    def touches(self) -> bool:
        """Whether a disc of the ego overlaps an actor's rectangle."""
        for a in self.actors:
            for disc in (-2.0, -1.0, 0.0, 1.0, 2.0):
                x = self.ego.x + disc * math.cos(self.ego.heading) - a.x
                y = self.ego.y + disc * math.sin(self.ego.heading) - a.y
                along = abs(math.cos(a.heading) * x + math.sin(a.heading) * y)
                across = abs(math.cos(a.heading) * y - math.sin(a.heading) * x)
                end = max(along - a.length / 2, 0.0)
                if math.hypot(end, max(across - a.width / 2, 0.0)) < 0.9:
                    return True
        return False


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
