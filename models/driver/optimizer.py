"""The optimizer step on averaged gradients, and the running mean of the weights."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from models.driver.process_group import ProcessGroup

CLIP = 5.0
"""Longest gradient: one outlier batch must not undo a hundred others."""
WEIGHT_DECAY = 1e-3
"""A tenth of AdamW's default: a course is short, and the data is fresh."""
AVERAGED = 0.998
"""Decay of the running mean of the weights: it looks back over about 500 steps."""


class AveragedAdamW:
    """AdamW (Loshchilov and Hutter, 2019) on gradients averaged over processes."""

    def __init__(
        self, learning: Sequence[nn.Parameter], rate: float, group: ProcessGroup
    ) -> None:
        """Prepare the optimizer.

        Args:
            learning: parameters, the same in every process.
            rate: first learning rate.
            group: the processes.
        """
        self.learning, self.group = list(learning), group
        self.adamw = torch.optim.AdamW(self.learning, rate, weight_decay=WEIGHT_DECAY)

    def step(self, loss: Tensor, rate: float, rank: int) -> None:
        """Take one optimizer step; every process must call it.

        Args:
            loss: of this process.
            rate: learning rate of this step.
            rank: of this process.
        """
        for parameters in self.adamw.param_groups:
            parameters["lr"] = rate
        self.adamw.zero_grad()
        loss.backward()
        self._average(rank)
        torch.nn.utils.clip_grad_norm_(self.learning, CLIP)
        self.adamw.step()

    def _average(self, rank: int) -> None:
        grads = [
            p.grad if p.grad is not None else torch.zeros_like(p) for p in self.learning
        ]
        flat = self.group.average(rank, torch.cat([g.flatten() for g in grads]))
        parts = flat.split([p.numel() for p in self.learning])
        for p, part in zip(self.learning, parts, strict=True):
            p.grad = part.view_as(p)


class WeightAverage:
    """Running mean of the weights (Polyak and Juditsky, 1992), the ones that drive."""

    def __init__(self, model: nn.Module) -> None:
        """Begin with the weights of a model."""
        self.weights = {k: v.clone() for k, v in model.state_dict().items()}

    def update(self, model: nn.Module, step: int) -> None:
        """Move towards the weights of a model, fast in the first steps.

        Args:
            model: the same.
            step: steps taken before this one.
        """
        decay = min(AVERAGED, (step + 1) / (step + 10))
        for name, value in model.state_dict().items():
            if value.is_floating_point():
                self.weights[name].lerp_(value, 1 - decay)
            else:
                self.weights[name].copy_(value)
