"""A stack whose planner attends to the cells of a map, for the tests of edges."""

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.passes.base import Context
from me2e_compress.passes.parts import Edge
from tests.support.nets import map_text, net

Numbers = npt.NDArray[np.float32]

STACK = """
stack (float[1,5,8] camera, float[1,3,5] pick, float[1,6,8] embedding,
       float[1,2,5] pair) => (float[1,1,8] plan, float[1,3,8] lanes, float[1,2,5] taken)
<int64[1] one = {1}, int64[2] whole = {1, 8}, int64[4] cut = {1, 5, 2, 4},
 int64[4] asked = {1, 1, 2, 4}, int64[3] back = {1, 1, 8}> {
    ["/backbone/Tanh"] bev = Tanh(camera)
    ["/track/ReduceMean"] ego = ReduceMean <axes = [1], keepdims = 0> (bev)
    ["/map/MatMul"] lanes = MatMul(pick, bev)
    ["/motion/Unsqueeze"] own = Unsqueeze(ego, one)
    ["/motion/Add"] modes = Add(own, embedding)
    ["/motion/agents/MatMul"] agents = MatMul(pair, bev)
    ["/occ/Transpose"] turned = Transpose <perm = [0, 2, 1]> (bev)
    ["/occ/MatMul"] taken = MatMul(agents, turned)
    ["/planner/Unsqueeze"] known = Unsqueeze(ego, one)
    ["/planner/Add"] told = Add(modes, known)
    ["/planner/ReduceMax"] query = ReduceMax <axes = [1]> (told)
    ["/planner/attn/Reshape"] q0 = Reshape(query, asked)
    ["/planner/attn/Transpose"] q = Transpose <perm = [0, 2, 1, 3]> (q0)
    ["/planner/attn/Reshape_1"] k0 = Reshape(bev, cut)
    ["/planner/attn/Transpose_1"] k = Transpose <perm = [0, 2, 3, 1]> (k0)
    ["/planner/attn/Transpose_2"] v = Transpose <perm = [0, 2, 1, 3]> (k0)
    ["/planner/attn/MatMul"] logits = MatMul(q, k)
    ["/planner/attn/Softmax"] weights = Softmax <axis = -1> (logits)
    ["/planner/attn/MatMul_1"] mixed0 = MatMul(weights, v)
    ["/planner/attn/Transpose_3"] mixed = Transpose <perm = [0, 2, 1, 3]> (mixed0)
    ["/planner/attn/Reshape_2"] plan = Reshape(mixed, back)
}
"""

PREDICTIONS = dict.fromkeys(("track", "map", "motion"), "prediction")
MAP = (
    map_text(backbone="feature", **PREDICTIONS)
    + "%s\n"
    + map_text(occ="prediction", planner="prediction")
)

KEYS = Edge("map", "*.attn")
"""The planner's attention reads lanes behind the cells."""


def weights() -> dict[str, Numbers]:
    noise = np.random.default_rng(0).normal(size=(3, 6, 8)).astype("f")
    return {
        "pick": noise[None, 0, :3, :5],
        "embedding": noise[None, 1],
        "pair": noise[None, 2, :2, :5],
    }


def stack() -> ir.Model:
    model = net(STACK, weights())
    graph.infer_shapes(model)
    return model


def context(substitutes: str = "") -> Context:
    return Context(ModuleMap.parse(MAP % substitutes, "stack"))
