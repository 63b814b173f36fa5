"""Checkpoints as their originals would write them, of almost no bytes."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from models.state_dict import StateDict
from models.tests.published_layouts import Shapes

Tensors = dict[str, Tensor]

META = {"epoch": 60, "iter": 211_080, "mmcv_version": "1.4.0", "CLASSES": ["car"]}


def thin(shapes: Shapes) -> Tensors:
    """Full shapes over one number each, which is all that a file of them holds."""
    return {
        name: torch.tensor(0)
        if name.endswith("num_batches_tracked")
        else torch.full((1,), 0.5).expand(shape)
        for name, shape in shapes.items()
    }


def mmcv(tensors: Mapping[str, Tensor]) -> dict[str, Any]:
    """As ``mmcv.runner.save_checkpoint`` writes it, with an optimizer."""
    state = {0: {"step": 3, "exp_avg": torch.zeros(2)}}
    optimizer = {"state": state, "param_groups": [{"lr": 1e-4, "params": [0]}]}
    return {"meta": META, "state_dict": dict(tensors), "optimizer": optimizer}


def lightning(tensors: Mapping[str, Tensor]) -> dict[str, Any]:
    """As ``Trainer.save_checkpoint`` of version 2 writes it."""
    return {
        "epoch": 31,
        "global_step": 9_000,
        "pytorch-lightning_version": "2.0.8",
        "state_dict": {f"model.{name}": each for name, each in tensors.items()},
        "callbacks": {"ModelCheckpoint{'monitor': 'val_loss'}": {"best": "a.ckpt"}},
        "lr_schedulers": [],
    }


def parallel(tensors: Mapping[str, Tensor]) -> Tensors:
    """As DataParallel names them."""
    return {f"module.{name}": each for name, each in tensors.items()}


def averaged(tensors: Mapping[str, Tensor], names: list[str]) -> Tensors:
    """With mmcv's EMAHook: beside each parameter its moving average, one larger."""
    averages = {"ema_" + n.replace(".", "_"): tensors[n] + 1 for n in names}
    return {**tensors, **averages}


def saved(path: Path, what: object, *, zipped: bool = True) -> Path:
    torch.save(what, path, _use_new_zipfile_serialization=zipped)
    return path


def state(tensors: Mapping[str, Tensor]) -> StateDict:
    """As if read from a file."""
    return StateDict(Path("made.pth"), "0" * 64, tensors)
