"""Names and shapes in published checkpoints, written from the originals.

hustvl/VAD, configs/VAD/VAD_tiny_e2e.py, and OpenDriveLab/TCP with Bench2DriveZoo's
branch tcp/admlp.
"""

import itertools
from collections.abc import Iterator

Shapes = dict[str, tuple[int, ...]]


def linear(name: str, size: int, out: int) -> Shapes:
    return {f"{name}.weight": (out, size), f"{name}.bias": (out,)}


def norm(name: str, width: int) -> Shapes:
    return {f"{name}.weight": (width,), f"{name}.bias": (width,)}


def batch_norm(name: str, width: int) -> Shapes:
    statistics = {f"{name}.running_{each}": (width,) for each in ("mean", "var")}
    return norm(name, width) | statistics | {f"{name}.num_batches_tracked": ()}


def resnet(name: str, kernels: tuple[int, ...], expansion: int) -> Shapes:
    """A ResNet of stages of 3, 4, 6 and 3 blocks."""
    found: Shapes = {f"{name}.conv1.weight": (64, 3, 7, 7)}
    found |= batch_norm(f"{name}.bn1", 64)
    channels = 64
    for stage, count in enumerate((3, 4, 6, 3)):
        width = 64 * 2**stage
        for index in range(count):
            block = f"{name}.layer{stage + 1}.{index}"
            size = channels
            for number, kernel in enumerate(kernels, start=1):
                out = width * (expansion if number == len(kernels) else 1)
                found[f"{block}.conv{number}.weight"] = (out, size, kernel, kernel)
                found |= batch_norm(f"{block}.bn{number}", out)
                size = out
            if index == 0 and channels != width * expansion:
                shape = (width * expansion, channels, 1, 1)
                found[f"{block}.downsample.0.weight"] = shape
                found |= batch_norm(f"{block}.downsample.1", width * expansion)
            channels = width * expansion
    return found


def feed_forward(name: str) -> Shapes:
    return linear(f"{name}.layers.0.0", 256, 512) | linear(f"{name}.layers.1", 512, 256)


def attention(name: str) -> Shapes:
    packed = {f"{name}.in_proj_weight": (768, 256), f"{name}.in_proj_bias": (768,)}
    return packed | linear(f"{name}.out_proj", 256, 256)


def deformable(name: str, samples: int, size: int = 256, *, out: bool = True) -> Shapes:
    found = linear(f"{name}.sampling_offsets", size, samples * 2)
    found |= linear(f"{name}.attention_weights", size, samples)
    found |= linear(f"{name}.value_proj", 256, 256)
    return found | (linear(f"{name}.output_proj", 256, 256) if out else {})


def branch(name: str, width: int, out: int, *, normalised: bool) -> Shapes:
    """Two hidden layers, each followed by ReLU, or by LayerNorm and ReLU."""
    step = 3 if normalised else 2
    found: Shapes = {}
    for at in (0, step):
        found |= linear(f"{name}.{at}", width, width)
        found |= norm(f"{name}.{at + 1}", width) if normalised else {}
    return found | linear(f"{name}.{2 * step}", width, out)


def vad_tiny(classes: int = 10, map_classes: int = 3, modes: int = 3) -> Shapes:
    found = resnet("img_backbone", (1, 3, 1), expansion=4)
    for name, size, kernel in (("lateral", 2048, 1), ("fpn", 256, 3)):
        conv = f"img_neck.{name}_convs.0.conv"
        found |= {
            f"{conv}.weight": (256, size, kernel, kernel),
            f"{conv}.bias": (256,),
        }
    head: Shapes = {"code_weights": (10,), "map_code_weights": (4,)}
    head |= {f"positional_encoding.{way}_embed.weight": (100, 128) for way in RC}
    for name, rows, columns in (
        ("bev_embedding", 10000, 256),
        ("query_embedding", 300, 512),
        ("map_instance_embedding", 100, 512),
        ("map_pts_embedding", 20, 512),
        ("motion_mode_query", 6, 256),
        ("ego_query", 1, 256),
    ):
        head[f"{name}.weight"] = (rows, columns)
    for layer in range(3):
        head |= branch(f"cls_branches.{layer}", 256, classes, normalised=True)
        head |= branch(f"reg_branches.{layer}", 256, 10, normalised=False)
        head |= branch(f"map_cls_branches.{layer}", 256, map_classes, normalised=True)
        head |= branch(f"map_reg_branches.{layer}", 256, 2, normalised=False)
        head |= linear(f"lane_encoder.layer_seq.lmlp_{layer}.mlp.0", 256, 128)
        head |= norm(f"lane_encoder.layer_seq.lmlp_{layer}.mlp.1", 128)
    head |= branch("traj_branches.0", 512, 12, normalised=False)
    head |= branch("traj_cls_branches.0", 512, 1, normalised=True)
    head |= branch("ego_fut_decoder", 512, modes * 12, normalised=False)
    head |= linear("agent_fus_mlp.0", 3072, 256) | norm("agent_fus_mlp.1", 256)
    head |= linear("agent_fus_mlp.3", 256, 256)
    for name in ("motion", "motion_map", "ego_agent", "ego_map"):
        layer_name = f"{name}_decoder.layers.0"
        head |= attention(f"{layer_name}.attentions.0.attn")
        head |= feed_forward(f"{layer_name}.ffns.0")
        head |= norm(f"{layer_name}.norms.0", 256) | norm(f"{layer_name}.norms.1", 256)
    for name in ("pos_mlp_sa", "pos_mlp", "ego_agent_pos_mlp", "ego_map_pos_mlp"):
        head |= linear(name, 2, 256)
    head |= {f"transformer.{name}": shape for name, shape in vad_transformer().items()}
    return found | {f"pts_bbox_head.{name}": shape for name, shape in head.items()}


RC = ("row", "col")


def vad_transformer() -> Shapes:
    found: Shapes = {"level_embeds": (4, 256), "cams_embeds": (6, 256)}
    found |= linear("can_bus_mlp.0", 18, 128) | linear("can_bus_mlp.2", 128, 256)
    found |= norm("can_bus_mlp.norm", 256)
    found |= linear("reference_points", 256, 3)
    found |= linear("map_reference_points", 256, 2)
    for layer in range(3):
        name = f"encoder.layers.{layer}"
        found |= deformable(f"{name}.attentions.0", 64, 512)
        inner = f"{name}.attentions.1.deformable_attention"
        found |= deformable(inner, 64, out=False)
        found |= linear(f"{name}.attentions.1.output_proj", 256, 256)
        found |= dict(_rest(name))
        for decoder in ("decoder", "map_decoder"):
            name = f"{decoder}.layers.{layer}"
            found |= attention(f"{name}.attentions.0.attn")
            found |= deformable(f"{name}.attentions.1", 32)
            found |= dict(_rest(name))
    return found


def _rest(name: str) -> Iterator[tuple[str, tuple[int, ...]]]:
    yield from feed_forward(f"{name}.ffns.0").items()
    for number in range(3):
        yield from norm(f"{name}.norms.{number}", 256).items()


def tcp(heads: str = "bench2drive") -> Shapes:
    """As a Lightning module saves it, what only training reads included."""
    found = resnet("perception", (3, 3), expansion=1)
    found |= linear("perception.fc", 512, 1000)
    action = 39 if heads == "bench2drive" else 4
    for cell, size in (("ctrl", 256 + action), ("traj", 4)):
        for way, width in (("i", size), ("h", 256)):
            found[f"decoder_{cell}.weight_{way}h"] = (768, width)
            found[f"decoder_{cell}.bias_{way}h"] = (768,)
    for name, sizes in {
        "measurements": (9, 128, 128),
        "join_traj": (1128, 512, 512, 256),
        "join_ctrl": (640, 512, 512, 256),
        "policy_head": (256, 256, 256),
        "output_ctrl": (256, 256, 256),
        "init_att": (128, 256, 232),
        "wp_att": (512, 256, 232),
        "merge": (768, 512, 256),
        "speed_branch": (1000, 256, 256),
        "value_branch_traj": (256, 256, 256),
        "value_branch_ctrl": (256, 256, 256),
    }.items():
        for number, (size, out) in enumerate(itertools.pairwise(sizes)):
            found |= linear(f"{name}.{2 * number}", size, out)
    for name in ("speed_branch", "value_branch_traj", "value_branch_ctrl"):
        found |= linear(f"{name}.5", 256, 1)
    found |= linear("output_traj", 256, 2)
    if heads == "bench2drive":
        found |= linear("action_head", 256, 39)
        for name in ("traj", "ctrl"):
            found |= linear(f"feature_branch_{name}.0", 256, 1536)
    else:
        found |= linear("dist_mu.0", 256, 2) | linear("dist_sigma.0", 256, 2)
    return found
