import pytest

from me2e_compress.graph.modules.module_map import ModuleMap

VAD = {
    "pts_bbox_head.transformer.level_embeds": "bev_encoder",
    "encoder.layers.0.attentions.1": "bev_encoder",
    "pts_bbox_head.transformer.decoder.layers.2.norms.2": "det",
    "decoder.layers.0": "det",
    "pts_bbox_head.transformer.map_decoder.layers.0": "map",
    "pts_bbox_head.map_cls_branches.0.0.weight": "map",
    "pts_bbox_head.lane_encoder.layer_seq.lmlp_0.linear.weight": "map",
    "pts_bbox_head.motion_map_decoder.layers.0": "motion",
    "pts_bbox_head.pos_mlp_sa.weight": "motion",
    "pts_bbox_head.ego_map_decoder.layers.0.attentions.0.attn": "planner",
    "pts_bbox_head.agent_fus_mlp.0.weight": "planner",
    "module.pts_bbox_head.ego_fut_decoder.4.bias": "planner",
    "pts_bbox_head.transformer": None,
    "pts_bbox_head.code_weights": None,
}

UNIAD = {
    "query_embedding.weight": "track",
    "pts_bbox_head.past_traj_reg_branches.0.0.weight": "track",
    "memory_bank.temporal_attn.in_proj_weight": "track",
    "self_attn": "track",
    "linear_pos1": "track",
    "seg_head.transformer.decoder.layers.0": "map",
    "things_mask_head.blocks.0.attn": "map",
    "motion_head.motionformer.map_interaction_layers.0": "motion",
    "bev_light_proj.conv_layers.0": "occ",
    "planning_head.navi_embed.weight": "planner",
}

TCP = {
    "measurements.0.weight": "measurements",
    "join_traj.0.weight": "planner",
    "decoder_ctrl.weight_hh": "control",
    "wp_att.0": "control",
}

CASES = [
    (preset, path, module)
    for preset, table in (("vad", VAD), ("uniad", UNIAD), ("tcp", TCP))
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
