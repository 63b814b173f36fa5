"""Models of the kinds that people bring, at published sizes, with random weights.

    python -m benchmarks.subjects.model_kinds OUT [--only vit,detr]

Each becomes ``OUT/NAME/source.onnx`` with ``frames`` and ``held-out`` beside it. The
architectures are those of ``transformers``' configurations or of
:mod:`benchmarks.subjects.own_kinds`; the way each is exported is the kind: float16,
weights in a file beside the graph, a symbolic batch and image size, torch's older and
newer exporter. Normalisations have seen images, so that signals neither vanish nor
explode. A model that is there is not made again. Needs `pip install -c constraints.txt
transformers`.
"""

import argparse
import dataclasses
import json
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
import transformers  # pyright: ignore[reportMissingImports]
from torch import Tensor, nn

from benchmarks.subjects import own_kinds
from benchmarks.subjects.smooth_images import smooth_images

OPSET = 17
FRAMES, HELD_OUT = 4, 2


class First(nn.Module):
    """One tensor in, a tuple of named tensors out: what exporters want of a model."""

    def __init__(self, model: nn.Module, outputs: tuple[str, ...]) -> None:
        super().__init__()
        self.model = model
        self.outputs = outputs

    def forward(self, x: Tensor) -> tuple[Tensor, ...]:
        found = self.model(x)
        if isinstance(found, Tensor):
            return (found,)
        return tuple(getattr(found, name) for name in self.outputs)


@dataclasses.dataclass(frozen=True)
class Kind:
    """One model and the way it is exported.

    Attributes:
        build: makes the network.
        shape: of the one input ``x``, float32.
        outputs: read off what the network answers, and the graph's.
        half: exported in float16, input and outputs too.
        dynamo: by torch's newer exporter, opset 18, weights in a file of their own.
        symbolic: axes of ``x`` without a size, by name.
    """

    build: Callable[[], nn.Module]
    shape: tuple[int, ...]
    outputs: tuple[str, ...] = ("logits",)
    half: bool = False
    dynamo: bool = False
    symbolic: dict[int, str] = dataclasses.field(default_factory=dict)


def resnet(name: str) -> transformers.PretrainedConfig:
    """Return the configuration of a ResNet whose four stages a detector reads."""
    depths = {"resnet50": [3, 4, 6, 3], "resnet18": [2, 2, 2, 2]}[name]
    basic = name == "resnet18"
    return transformers.ResNetConfig(
        depths=depths,
        hidden_sizes=[64, 128, 256, 512] if basic else [256, 512, 1024, 2048],
        layer_type="basic" if basic else "bottleneck",
        out_features=["stage2", "stage3", "stage4"],
    )


def detr() -> nn.Module:
    """DETR-R50: Carion et al. 2020."""
    backbone = resnet("resnet50")
    backbone.out_features = ["stage4"]
    config = transformers.DetrConfig(backbone_config=backbone)
    network: nn.Module = transformers.DetrForObjectDetection(eager(config))
    return network


def deformable_detr() -> nn.Module:
    """Deformable DETR-R50: Zhu et al. 2021."""
    config = transformers.DeformableDetrConfig(backbone_config=resnet("resnet50"))
    network: nn.Module = transformers.DeformableDetrForObjectDetection(eager(config))
    return network


def rt_detr() -> nn.Module:
    """RT-DETR-R18: Zhao et al. 2024."""
    backbone = transformers.RTDetrResNetConfig(
        depths=[2, 2, 2, 2],
        hidden_sizes=[64, 128, 256, 512],
        layer_type="basic",
        out_features=["stage2", "stage3", "stage4"],
    )
    config = transformers.RTDetrConfig(
        backbone_config=backbone,
        encoder_in_channels=[128, 256, 512],
        hidden_expansion=0.5,
        decoder_layers=3,
        anchor_image_size=[640, 640],
    )
    network: nn.Module = transformers.RTDetrForObjectDetection(eager(config))
    return network


def eager(config: transformers.PretrainedConfig) -> transformers.PretrainedConfig:
    """Ask for attention as MatMul and Softmax, as graphs for deployment hold it."""
    config._attn_implementation = "eager"
    return config


def classifier(name: str) -> Callable[[], nn.Module]:
    """Return the maker of a classifier at its published configuration."""
    makers: dict[str, tuple[type, type]] = {
        "vit": (transformers.ViTConfig, transformers.ViTForImageClassification),
        "swin": (transformers.SwinConfig, transformers.SwinForImageClassification),
        "convnext": (
            transformers.ConvNextConfig,
            transformers.ConvNextForImageClassification,
        ),
        "resnet18": (
            transformers.ResNetConfig,
            transformers.ResNetForImageClassification,
        ),
    }
    config, model = makers[name]
    given = resnet(name) if name == "resnet18" else config()
    return lambda: model(eager(given))


BOXES = ("logits", "pred_boxes")
SIZES = {0: "batch", 2: "height", 3: "width"}

KINDS = {
    "cnn": Kind(own_kinds.resnet50, (1, 3, 224, 224)),
    "mobilenetv3": Kind(own_kinds.MobileNetV3, (1, 3, 224, 224)),
    "vit": Kind(classifier("vit"), (1, 3, 224, 224)),
    "swin": Kind(classifier("swin"), (1, 3, 224, 224)),
    "detr": Kind(detr, (1, 3, 480, 640), BOXES),
    "rt-detr": Kind(rt_detr, (1, 3, 640, 640), BOXES),
    "deformable-detr": Kind(deformable_detr, (1, 3, 480, 640), BOXES),
    "lstm": Kind(own_kinds.Recurrent, (1, 3, 64, 256)),
    "float16": Kind(classifier("resnet18"), (1, 3, 224, 224), half=True),
    "external-data": Kind(classifier("convnext"), (1, 3, 224, 224), dynamo=True),
    "dynamic": Kind(own_kinds.Segmenter, (1, 3, 256, 256), symbolic=SIZES),
}
"""Name, and what is made."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--only", default=",".join(KINDS))
    chosen = parser.parse_args()
    for name in chosen.only.split(","):
        print(make(name, chosen.out), flush=True)


def make(name: str, out: Path) -> Path:
    """Write a model and its frames, unless they are there; return the model's file."""
    kind, folder = KINDS[name], out / name
    source = folder / "source.onnx"
    if not source.is_file():
        shutil.rmtree(folder, ignore_errors=True)
        for part, count, seed in (("frames", FRAMES, 0), ("held-out", HELD_OUT, 1)):
            record(kind, folder / part, count, seed)
        export(kind, source)
    return source


def expected(source: Path) -> Path:
    """Return the file of torch's own outputs on the first frame that is held out."""
    return source.with_name("expected.npz")


def record(kind: Kind, folder: Path, count: int, seed: int) -> None:
    """Write frames of the model's input, each a scene of its own."""
    folder.mkdir(parents=True)
    for index, image in enumerate(smooth_images(kind.shape, count, seed)):
        held = image.astype(np.float16) if kind.half else image
        np.savez(folder / f"{index:06d}.npz", x=held)
    scenes = json.dumps({"scenes": list(range(count))})
    (folder / "scenes.json").write_text(scenes, encoding="utf-8")


def export(kind: Kind, path: Path) -> None:
    """Write one network as its kind is exported."""
    torch.manual_seed(0)
    network = settled(kind.build(), kind.shape)
    wrapped = First(network, kind.outputs).eval()
    example = torch.zeros(kind.shape)
    if kind.half:
        wrapped, example = wrapped.half(), example.half()
    with np.load(path.parent / "held-out" / "000000.npz") as frame, torch.no_grad():
        found = wrapped(torch.from_numpy(frame["x"]))
    answers = zip(kind.outputs, found, strict=True)
    np.savez(expected(path), **{name: value.numpy() for name, value in answers})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            wrapped,
            (example,),
            path,
            dynamo=kind.dynamo,
            external_data=kind.dynamo,
            opset_version=18 if kind.dynamo else OPSET,
            input_names=["x"],
            output_names=list(kind.outputs),
            dynamic_axes={"x": kind.symbolic} if kind.symbolic else None,
        )


def settled(network: nn.Module, shape: tuple[int, ...]) -> nn.Module:
    """Let the batch normalisations see images, as training would have."""
    layers = [each for each in network.modules() if isinstance(each, nn.BatchNorm2d)]
    for layer in layers:
        layer.momentum = None  # the plain mean over what it sees
        nn.init.normal_(layer.weight, 1.0, 0.2)
        nn.init.normal_(layer.bias, 0.0, 0.2)
        layer.train()
    if layers:
        with torch.no_grad():
            for image in smooth_images(shape, 4, 2):
                network(torch.from_numpy(image))
    return network


if __name__ == "__main__":
    main()
