"""ResNet-50 with a classifier, random but used to its images, and frames for it."""

import warnings
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from models.resnet import ResNet50
from models.stacks import VAD_TINY
from models.synthetic_frames import frames

SIDE = 224
CLASSES = 1000
RESIDUAL_SCALE = 0.35
"""Of the last normalisation of a block, so that 16 blocks do not explode."""

MAP = """
[modules.backbone]
role = "feature"
patterns = ["backbone"]
[modules.head]
role = "prediction"
patterns = ["head"]
"""


class Classifier(nn.Module):
    """Image to logits."""

    def __init__(self) -> None:
        super().__init__()
        self.backbone = ResNet50()
        self.head = nn.Linear(self.backbone.channels[-1], CLASSES)

    def forward(self, image: Tensor) -> Tensor:
        """[1, 3, 224, 224] -> [1, 1000]."""
        features: Tensor = self.backbone(image)
        logits: Tensor = self.head(features.mean((2, 3)))
        return logits


def export(path: Path, seed: int = 0) -> None:
    """Write the network; its normalisations have seen eight images."""
    torch.manual_seed(seed)
    network = Classifier()
    for name, layer in network.named_modules():
        if isinstance(layer, nn.Conv2d):
            nn.init.kaiming_normal_(layer.weight, mode="fan_out", nonlinearity="relu")
        elif isinstance(layer, nn.BatchNorm2d):
            nn.init.normal_(layer.weight, 1.0, 0.2)
            nn.init.normal_(layer.bias, 0.0, 0.2)
            layer.momentum = None  # the plain mean over what it sees
            if name.endswith("bn3"):
                layer.weight.data *= RESIDUAL_SCALE
    with torch.no_grad():
        for image in images(8, seed):
            network(torch.from_numpy(image))
    network.eval()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=DeprecationWarning)
        torch.onnx.export(
            network,
            (torch.zeros(1, 3, SIDE, SIDE),),
            path,
            dynamo=False,
            opset_version=17,
            do_constant_folding=False,
            input_names=["image"],
            output_names=["logits"],
        )


def images(
    count: int, seed: int
) -> list[np.ndarray[tuple[int, ...], np.dtype[np.float32]]]:
    """Crop what six rendered cameras see: float32 [1, 3, 224, 224]."""
    seen = []
    for frame in frames(VAD_TINY, -(-count // 6), seed, scene_length=1):
        (name,) = (each for each in frame if "img" in each and frame[each].ndim == 5)
        height, width = frame[name].shape[-2:]
        top, left = (height - SIDE) // 2, (width - SIDE) // 2
        crop = frame[name][0, :, :, top : top + SIDE, left : left + SIDE]
        seen += [np.ascontiguousarray(each[None], np.float32) for each in crop]
    return seen[:count]
