"""A stack of four modules, for the tests of what ``ablate-modules`` fills in."""

import numpy as np
import onnx_ir as ir

from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.passes.ablate_modules import AblateModules
from me2e_compress.passes.base import Context
from me2e_compress.runtime.session import run_once
from tests.support.nets import map_text

STACK = """
stack (float[1,4] camera) => (float[1,4] plan, float[1,2,2] lanes)
<int64[3] square = {1, 2, 2}, int64[2] flat = {1, 4}> {
    ["/backbone/Relu"] f = Relu(camera)
    ["/agents/Abs"] agents = Abs(f)
    ["/map/Neg"] m = Neg(f)
    ["/map/Reshape"] lanes = Reshape(m, square)
    ["/planner/look/Reshape"] seen = Reshape(lanes, flat)
    ["/planner/look/Exp"] ego_map = Exp(seen)
    ["/planner/meet/Sqrt"] met = Sqrt(agents)
    ["/planner/Add"] plan = Add(ego_map, met)
}
"""

MAP = (
    map_text(backbone="feature", agents="prediction", map="prediction")
    + "%s\n"
    + map_text(planner="prediction")
)

CAMERA = np.array([[-1, 0, 4, 9]], np.float32)


def context(substitutes: str = "") -> Context:
    return Context(ModuleMap.parse(MAP % substitutes, "stack"))


def substitute(scope: str, by: str | None = None) -> str:
    substitute = "" if by is None else f', by = "{by}"'
    return f'substitutes = [{{ scope = "{scope}"{substitute} }}]'


def plan_of(model: ir.Model) -> list[float]:
    plan: list[float] = run_once(model, {"camera": CAMERA})["plan"][0].tolist()
    return plan


SIZED = STACK.replace(
    '["/planner/look/Reshape"] seen = Reshape(lanes, flat)',
    '["/map/Shape"] size = Shape(f)\n["/planner/look/Reshape"] seen = Reshape(f, size)',
)
NO_MAP = AblateModules(drop=("map",), drop_outputs=True)
NO_AGENTS = AblateModules(drop=("agents",))
