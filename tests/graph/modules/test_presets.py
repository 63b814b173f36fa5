import pytest

from me2e_compress.graph.modules.module_map import ModuleMap

VAD = {
    "img_backbone.layer1.0.conv1.weight": "backbone",
    "img_neck.lateral_convs.0.conv.weight": "neck",
    "pts_bbox_head.bev_embedding.weight": "bev_encoder",
    "pts_bbox_head.positional_encoding.row_embed.weight": "bev_encoder",
    "pts_bbox_head.transformer.encoder.layers.0.norms.0.weight": "bev_encoder",
    "pts_bbox_head.transformer.can_bus_mlp.norm.weight": "bev_encoder",
    "pts_bbox_head.transformer.level_embeds": "bev_encoder",
    "encoder.layers.0.attentions.1": "bev_encoder",
    "pts_bbox_head.transformer.decoder.layers.2.norms.2": "det",
    "decoder.layers.0": "det",
    "pts_bbox_head.cls_branches.2.6.weight": "det",
    "pts_bbox_head.transformer.map_decoder.layers.0": "map",
    "pts_bbox_head.map_cls_branches.0.0.weight": "map",
    "pts_bbox_head.map_instance_embedding.weight": "map",
    "pts_bbox_head.lane_encoder.layer_seq.lmlp_0.linear.weight": "map",
    "pts_bbox_head.motion_decoder.layers.0.attentions.0.attn": "motion",
    "pts_bbox_head.motion_map_decoder.layers.0": "motion",
    "pts_bbox_head.pos_mlp_sa.weight": "motion",
    "pts_bbox_head.traj_cls_branches.0": "motion",
    "pts_bbox_head.ego_map_decoder.layers.0.attentions.0.attn": "planner",
    "pts_bbox_head.ego_map_pos_mlp.weight": "planner",
    "pts_bbox_head.agent_fus_mlp.0.weight": "planner",
    "module.pts_bbox_head.ego_fut_decoder.4.bias": "planner",
    "pts_bbox_head.transformer": None,
    "pts_bbox_head": None,
    "pts_bbox_head.code_weights": None,
}

UNIAD = {
    "img_backbone.layer4": "backbone",
    "img_neck.fpn_convs.3.conv.weight": "neck",
    "encoder.layers.0.attentions.0": "bev_encoder",
    "can_bus_mlp.0": "bev_encoder",
    "pts_bbox_head.bev_embedding.weight": "bev_encoder",
    "query_embedding.weight": "track",
    "decoder.layers.3.ffns.0": "track",
    "pts_bbox_head.past_traj_reg_branches.0.0.weight": "track",
    "query_interact.self_attn.in_proj_weight": "track",
    "memory_bank.temporal_attn.in_proj_weight": "track",
    "temporal_attn": "track",
    "self_attn": "track",
    "linear_pos1": "track",
    "seg_head.bev_embedding.weight": "map",
    "seg_head.transformer.decoder.layers.0": "map",
    "seg_head.cls_branches.0": "map",
    "things_mask_head.blocks.0.attn": "map",
    "motion_head.motionformer.map_interaction_layers.0": "motion",
    "motion_head.traj_cls_branches.0.0.weight": "motion",
    "occ_head.transformer_decoder.layers.0": "occ",
    "bev_light_proj.conv_layers.0": "occ",
    "planning_head.attn_module.layers.0": "planner",
    "planning_head.navi_embed.weight": "planner",
}

TCP = {
    "perception.layer4.2.conv2.weight": "backbone",
    "measurements.0.weight": "measurements",
    "join_traj.0.weight": "planner",
    "decoder_traj.weight_ih": "planner",
    "decoder_ctrl.weight_hh": "control",
    "wp_att.0": "control",
    "action_head.0.weight": "control",
}

HIGHWAY = {
    "backbone.stem.0.weight": "backbone",
    "neck.laterals.0.bias": "neck",
    "bev_encoder.cross.weights.weight": "bev_encoder",
    "track.cells_place": "track",
    "map.raster.2.weight": "map",
    "motion.layers.0.self_attn.query.weight": "motion",
    "occ.grow.0.weight": "occ",
    "planner.anchors": "planner",
    "module.planner.score.0.bias": "planner",
    "occupancy": None,
}

CASES = [
    (preset, path, module)
    for preset, table in (
        ("vad", VAD),
        ("uniad", UNIAD),
        ("tcp", TCP),
        ("highway", HIGHWAY),
    )
    for path, module in table.items()
]


@pytest.mark.parametrize(("preset", "path", "module"), CASES)
def test_preset(preset: str, path: str, module: str | None) -> None:
    assert ModuleMap.load(preset).match(path) == module


def test_feature_extraction_is_backbone_neck_and_bev_encoder() -> None:
    for preset in ("vad", "uniad", "highway"):
        features = ModuleMap.load(preset).names("feature")
        assert features == ("backbone", "neck", "bev_encoder")


def test_without_the_map_the_ego_query_keeps_what_it_knew_of_the_agents() -> None:
    pairs = {s.scope: s.by for s in ModuleMap.load("vad").module("map").substitutes}
    assert pairs == {
        "*.motion_map_decoder": "*.motion_decoder",
        "*.ego_map_decoder": "*.ego_agent_decoder",
    }
