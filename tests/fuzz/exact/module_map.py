"""The module map of drawn graphs whose nodes are named after modules."""

import onnx

from me2e_compress.modules import ModuleMap

MODULES = ModuleMap.parse(
    """
    [modules.backbone]
    role = "feature"
    optional = ["img_backbone"]
    [modules.neck]
    role = "feature"
    optional = ["img_neck"]
    [modules.bev_encoder]
    role = "feature"
    optional = ["pts_bbox_head.transformer.encoder"]
    [modules.map]
    role = "prediction"
    optional = ["pts_bbox_head.map_decoder"]
    [modules.motion]
    role = "prediction"
    optional = ["motion_head"]
    [modules.planner]
    role = "prediction"
    optional = ["planning_head", "**"]
    """,
    "drawn",
)


def modules_of(model: onnx.ModelProto) -> ModuleMap:
    """Return the map that fits a graph, of one module where nodes have no paths."""
    named = any(node.name.startswith("/") for node in model.graph.node)
    return MODULES if named else ModuleMap.whole()
