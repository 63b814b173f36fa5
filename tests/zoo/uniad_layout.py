"""Names and shapes in UniAD-tiny's published checkpoint, written from the original.

Bench2DriveZoo, adzoo/uniad/configs/stage2_e2e/tiny_e2e_b2d.py.
"""

from tests.zoo.published_layouts import (
    Shapes,
    attention,
    batch_norm,
    branch,
    deformable,
    feed_forward,
    linear,
    norm,
    resnet,
)

FUTURES = 5

ANCHORS: Shapes = {"motion_head.kmeans_anchors": (3, 6, 12, 2)}
"""In a file of their own there; in ours among the tensors."""


def prefixed(prefix: str, shapes: Shapes) -> Shapes:
    return {f"{prefix}.{name}": shape for name, shape in shapes.items()}


def convolution(name: str, size: int, out: int, kernel: int, *, bias: bool) -> Shapes:
    found: Shapes = {f"{name}.weight": (out, size, kernel, kernel)}
    return found | ({f"{name}.bias": (out,)} if bias else {})


def norms(name: str, count: int) -> Shapes:
    return {k: s for n in range(count) for k, s in norm(f"{name}.{n}", 256).items()}


def torch_layer(name: str, *, cross: bool = True) -> Shapes:
    """``nn.TransformerDecoderLayer``, or the encoder's."""
    found = attention(f"{name}.self_attn")
    found |= attention(f"{name}.multihead_attn") if cross else {}
    found |= linear(f"{name}.linear1", 256, 512) | linear(f"{name}.linear2", 512, 256)
    for number in range(1, 4 if cross else 3):
        found |= norm(f"{name}.norm{number}", 256)
    return found


def mlp(name: str, *sizes: int) -> Shapes:
    size, hidden, out = sizes
    return linear(f"{name}.0", size, hidden) | linear(f"{name}.2", hidden, out)


def uniad_tiny() -> Shapes:
    found = resnet("img_backbone", (1, 3, 1), expansion=4)
    for number, size in enumerate((512, 1024, 2048)):
        lateral = f"img_neck.lateral_convs.{number}.conv"
        found |= convolution(lateral, size, 256, 1, bias=True)
    for number in range(4):
        found |= convolution(
            f"img_neck.fpn_convs.{number}.conv", 256, 256, 3, bias=True
        )
    found |= {"query_embedding.weight": (901, 512)} | linear("reference_points", 256, 3)
    found |= {"criterion.code_weights": (10,)}
    return (
        found
        | tracks()
        | prefixed("pts_bbox_head", track_head())
        | prefixed("seg_head", seg_head())
        | prefixed("motion_head", motion_head())
        | prefixed("occ_head", occ_head())
        | prefixed("planning_head", planning_head())
    )


def tracks() -> Shapes:
    found = attention("query_interact.self_attn") | attention(
        "memory_bank.temporal_attn"
    )
    for part in ("1", "2", "_pos1", "_pos2", "_feat1", "_feat2"):
        found |= linear(f"query_interact.linear{part}", 256, 256)
    for part in ("1", "2", "_pos", "_feat"):
        found |= norm(f"query_interact.norm{part}", 256)
    for part in ("save_proj", "temporal_fc1", "temporal_fc2"):
        found |= linear(f"memory_bank.{part}", 256, 256)
    for part in ("temporal_norm1", "temporal_norm2"):
        found |= norm(f"memory_bank.{part}", 256)
    return found


def track_head() -> Shapes:
    found: Shapes = {"code_weights": (10,), "bev_embedding.weight": (10000, 256)}
    found |= {
        f"positional_encoding.{w}_embed.weight": (100, 128) for w in ("row", "col")
    }
    found |= {"transformer.level_embeds": (4, 256), "transformer.cams_embeds": (6, 256)}
    found |= mlp("transformer.can_bus_mlp", 18, 128, 256)
    found |= norm("transformer.can_bus_mlp.norm", 256)
    for layer in range(3):
        name = f"transformer.encoder.layers.{layer}"
        found |= deformable(f"{name}.attentions.0", 64, 512)
        inner = f"{name}.attentions.1.deformable_attention"
        found |= deformable(inner, 256, out=False)
        found |= linear(f"{name}.attentions.1.output_proj", 256, 256)
        found |= feed_forward(f"{name}.ffns.0") | norms(f"{name}.norms", 3)
    for layer in range(6):
        found |= decoder_layer(f"transformer.decoder.layers.{layer}", 32)
        found |= branch(f"cls_branches.{layer}", 256, 9, normalised=True)
        found |= branch(f"reg_branches.{layer}", 256, 10, normalised=False)
        found |= branch(f"past_traj_reg_branches.{layer}", 256, 16, normalised=False)
    return found


def decoder_layer(name: str, samples: int) -> Shapes:
    found = attention(f"{name}.attentions.0.attn")
    found |= deformable(f"{name}.attentions.1", samples)
    return found | feed_forward(f"{name}.ffns.0") | norms(f"{name}.norms", 3)


def seg_head() -> Shapes:
    """Its attention has weights for four levels, of which there is one."""
    found: Shapes = {"query_embedding.weight": (300, 512)}
    found |= {"bev_embedding.weight": (40000, 256), "stuff_query.weight": (0, 512)}
    found |= {"transformer.level_embeds": (4, 256)}
    found |= linear("transformer.reference_points", 256, 2)
    for layer in range(6):
        name = f"transformer.encoder.layers.{layer}"
        found |= deformable(f"{name}.attentions.0", 128)
        found |= feed_forward(f"{name}.ffns.0") | norms(f"{name}.norms", 2)
        found |= decoder_layer(f"transformer.decoder.layers.{layer}", 128)
        found |= linear(f"cls_branches.{layer}", 256, 6)
        found |= branch(f"reg_branches.{layer}", 256, 4, normalised=False)
        found |= linear(f"cls_stuff_branches.{layer}", 256, 1)
    for layer in range(4):
        found |= branch(f"reg_branches2.{layer}", 256, 4, normalised=False)
        found |= linear(f"cls_thing_branches.{layer}", 256, 6)
    found |= mask_head("things_mask_head", 4, self_attention=False)
    return found | mask_head("stuff_mask_head", 6, self_attention=True)


def mask_head(name: str, blocks: int, *, self_attention: bool) -> Shapes:
    found = mask_attention(f"{name}.attnen", "qk")
    for number in range(blocks):
        block = f"{name}.blocks.{number}"
        found |= mask_attention(f"{block}.attn", "qkv")
        found |= linear(f"{block}.attn.proj", 256, 256)
        found |= linear(f"{block}.mlp.fc1", 256, 1024)
        found |= linear(f"{block}.mlp.fc2", 1024, 256)
        found |= norm(f"{block}.head_norm1", 256) | norm(f"{block}.head_norm2", 256)
        if self_attention:
            found |= linear(f"{block}.self_attention.qkv", 256, 768)
            found |= linear(f"{block}.self_attention.proj", 256, 256)
            found |= norm(f"{block}.norm3", 256)
    return found


def mask_attention(name: str, parts: str) -> Shapes:
    found = linear(f"{name}.linear_l1.0", 8, 8) | linear(f"{name}.linear.0", 8, 1)
    for part in parts:
        found |= linear(f"{name}.{part}", 256, 256)
    return found


def motion_head() -> Shapes:
    found: Shapes = {"learnable_motion_query_embedding.weight": (18, 256)}
    fuser = "layer_track_query_fuser"
    found |= linear(f"{fuser}.0", 1536, 256) | norm(f"{fuser}.1", 256)
    for level in ("agent", "scene_level_ego", "scene_level_offset", "boxes_query"):
        kind = "agent_level" if level == "agent" else level
        found |= mlp(f"{kind}_embedding_layer", 256, 512, 256)
    former = "motionformer"
    intention = f"{former}.intention_interaction_layers.interaction_transformer"
    found |= torch_layer(intention, cross=False)
    for part, size in (("static_dynamic", 2), ("in_query", 2), ("out_query", 4)):
        found |= mlp(f"{former}.{part}_fuser", size * 256, 512, 256)
    found |= mlp(f"{former}.dynamic_embed_fuser", 768, 512, 256)
    for layer in range(3):
        for kind in ("track_agent", "map"):
            place = f"{former}.{kind}_interaction_layers.{layer}"
            found |= torch_layer(f"{place}.interaction_transformer")
        name = f"{former}.bev_interaction_layers.{layer}"
        found |= deformable(f"{name}.attentions.0", 384, out=False)
        output = f"{name}.attentions.0.output_proj"
        found |= linear(f"{output}.0", 3072, 256) | norm(f"{output}.1", 256)
        found |= feed_forward(f"{name}.ffns.0") | norms(f"{name}.norms", 2)
        found |= branch(f"traj_cls_branches.{layer}", 256, 1, normalised=True)
        found |= branch(f"traj_reg_branches.{layer}", 256, 60, normalised=False)
    return found


def occ_head() -> Shapes:
    found: Shapes = {}
    for number in range(3):
        conv = f"bev_light_proj.conv_layers.{number}"
        found |= convolution(f"{conv}.conv", 256, 256, 3, bias=False)
        found |= batch_norm(f"{conv}.bn", 256)
    found |= convolution("bev_light_proj.conv_layers.3", 256, 256, 1, bias=True)
    downscales = [f"base_downscale.{n}" for n in range(2)]
    for name in (*downscales, *(f"downscale_convs.{n}" for n in range(FUTURES))):
        found |= bottleneck(name)
    for layer in range(FUTURES):
        name = f"transformer_decoder.layers.{layer}"
        for number in range(2):
            found |= attention(f"{name}.attentions.{number}.attn")
        found |= linear(f"{name}.ffns.0.layers.0.0", 256, 2048)
        found |= linear(f"{name}.ffns.0.layers.1", 2048, 256)
        found |= norms(f"{name}.norms", 3)
        for number in range(2):
            found |= linear(f"temporal_mlps.{layer}.layers.{number}", 256, 256)
        upsample = f"upsample_adds.{layer}.upsample_layer"
        found |= convolution(f"{upsample}.1", 256, 256, 1, bias=False)
        found |= batch_norm(f"{upsample}.2", 256)
    found |= norm("transformer_decoder.post_norm", 256)
    for layer in range(2):
        block = f"dense_decoder.layers.{layer}"
        found |= convolution(f"{block}.conv.1", 256, 128, 3, bias=False)
        found |= batch_norm(f"{block}.conv.2", 128)
        found |= convolution(f"{block}.conv.4", 128, 256, 1, bias=False)
        found |= batch_norm(f"{block}.conv.5", 256)
        found |= convolution(f"{block}.up", 256, 256, 1, bias=True)
    found |= linear("mode_fuser.0", 256, 256) | norm("mode_fuser.1", 256)
    found |= linear("multi_query_fuser.0", 768, 512) | norm("multi_query_fuser.1", 512)
    found |= linear("multi_query_fuser.3", 512, 256)
    for number in range(3):
        for name in ("query_to_occ_feat", "temporal_mlp_for_mask"):
            found |= linear(f"{name}.layers.{number}", 256, 256)
    return found


def bottleneck(name: str) -> Shapes:
    layers, skip = f"{name}.layers", f"{name}.projection"
    found = convolution(f"{layers}.conv_down_project", 256, 128, 1, bias=False)
    found |= batch_norm(f"{layers}.abn_down_project.0", 128)
    found |= convolution(f"{layers}.conv", 128, 128, 3, bias=False)
    found |= batch_norm(f"{layers}.abn.0", 128)
    found |= convolution(f"{layers}.conv_up_project", 128, 256, 1, bias=False)
    found |= batch_norm(f"{layers}.abn_up_project.0", 256)
    found |= convolution(f"{skip}.conv_skip_proj", 256, 256, 1, bias=False)
    return found | batch_norm(f"{skip}.bn_skip_proj", 256)


def planning_head() -> Shapes:
    found: Shapes = {"navi_embed.weight": (6, 256), "pos_embed.weight": (1, 256)}
    found |= mlp("reg_branch", 256, 256, 12)
    found |= linear("mlp_fuser.0", 768, 256) | norm("mlp_fuser.1", 256)
    for layer in range(3):
        found |= torch_layer(f"attn_module.layers.{layer}")
        found |= convolution(f"bev_adapter.{layer}.0", 256, 128, 3, bias=True)
        found |= convolution(f"bev_adapter.{layer}.2", 128, 256, 1, bias=True)
    return found
