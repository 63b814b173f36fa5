"""The whole TCP model."""

import itertools

import torch
from torch import Tensor, nn
from torch.nn import functional

from models.drawing import Gains, draw_weights, one_thread, take_statistics
from models.regions import region
from models.resnet import ResNet
from models.tcp.config import (
    ACTION_SIZE,
    DISTRIBUTIONS,
    STATE,
    ActionHeads,
    TcpConfig,
)

PUBLISHED = TcpConfig()

GAINS = Gains(
    by_name=(
        (r"weight_(ih|hh)|action_head|dist_", 1.0),
        (r"output_traj", 1.0),
    ),
    last_norm=r"layer\d\.\d\.bn2\.weight$",
)


class ImageTrunk(ResNet):
    """ResNet-34 with its classifier: maps the strip to a vector and a feature map."""

    def __init__(self, config: TcpConfig) -> None:
        super().__init__(config.stem, bottleneck=False)
        self.fc = nn.Linear(self.channels[-1], config.classes)

    def forward(self, img: Tensor) -> tuple[Tensor, Tensor]:
        """Map [1, 3, 256, 900] to [1, 1000] and [1, 512, 8, 29]."""
        features = self.stages(img)[-1]
        return self.fc(features.mean((2, 3))), features


class RecurrentCell(nn.Module):
    """An ``nn.GRUCell`` (Cho et al. 2014) that the exporter supports."""

    def __init__(self, size: int, hidden: int) -> None:
        super().__init__()
        self.weight_ih = nn.Parameter(torch.empty(3 * hidden, size))
        self.weight_hh = nn.Parameter(torch.empty(3 * hidden, hidden))
        self.bias_ih = nn.Parameter(torch.empty(3 * hidden))
        self.bias_hh = nn.Parameter(torch.empty(3 * hidden))

    def forward(self, x: Tensor, hidden: Tensor) -> Tensor:
        """Map [1, size] and [1, hidden] to [1, hidden]."""
        seen = functional.linear(x, self.weight_ih, self.bias_ih).chunk(3, 1)
        known = functional.linear(hidden, self.weight_hh, self.bias_hh).chunk(3, 1)
        reset = torch.sigmoid(seen[0] + known[0])
        keep = torch.sigmoid(seen[1] + known[1])
        new = torch.tanh(seen[2] + reset * known[2])
        return new + keep * (hidden - new)


class MapReader(nn.Sequential):
    """Maps a vector to weights over the cells of the image map, which sum to 1."""

    def __init__(self, size: int, config: TcpConfig) -> None:
        rows, columns = config.map_hw
        super().__init__(
            nn.Linear(size, config.hidden),
            nn.ReLU(),
            nn.Linear(config.hidden, rows * columns),
            nn.Softmax(1),
        )
        self.hw = config.map_hw

    def read(self, features: Tensor, by: Tensor) -> Tensor:
        """Return [1, 512], the weighted sum of the map [1, 512, 8, 29]."""
        weights = self(by).view(1, 1, *self.hw)
        read: Tensor = (features * weights).sum((2, 3))
        return read


def layers(*sizes: int) -> nn.Sequential:
    """Build linear layers of the given sizes, each with a ReLU."""
    built = nn.Sequential()
    for size, out in itertools.pairwise(sizes):
        built.extend([nn.Linear(size, out), nn.ReLU()])
    return built


class Tcp(nn.Module):
    """Maps a strip of three cameras and the ego state to waypoints and actions.

    Wu et al. 2022, written from the published description, with the published
    dimensions and the original's parameter names. Nothing is remembered between frames.
    PID control of the waypoints, the choice of an action and the fusion of both heads
    are up to the host. Head ``bench2drive`` scores 39 actions; ``beta``, the original,
    returns Beta distributions of acceleration and steer. The branches used only in
    training are left out: 1,375,491 parameters of Bench2DriveZoo's 26,593,444.
    """

    def __init__(
        self,
        heads: ActionHeads = "bench2drive",
        *,
        config: TcpConfig = PUBLISHED,
    ) -> None:
        super().__init__()
        self.heads: ActionHeads = heads
        self.config = config
        joint, hidden, measured = config.joint, config.hidden, config.measured
        # Inputs of both branches
        self.perception = ImageTrunk(config)
        channels = self.perception.channels[-1]
        self.measurements = layers(STATE, measured, measured)
        self.join_traj = layers(measured + config.classes, joint, joint, hidden)
        self.join_ctrl = layers(measured + channels, joint, joint, hidden)
        # Control branch
        self.policy_head = nn.Sequential(
            nn.Linear(hidden, hidden),
            nn.ReLU(),
            nn.Linear(hidden, hidden),
            nn.Dropout(0.5),
            nn.ReLU(),
        )
        self.decoder_ctrl = RecurrentCell(hidden + ACTION_SIZE[heads], hidden)
        self.output_ctrl = layers(hidden, hidden, hidden)
        self._add_action_head(hidden)
        # Trajectory branch
        self.decoder_traj = RecurrentCell(2 + 2, hidden)
        self.output_traj = nn.Linear(hidden, 2)
        # Attention of the control branch to the image
        self.init_att = MapReader(measured, config)
        self.wp_att = MapReader(2 * hidden, config)
        self.merge = nn.Sequential(
            nn.Linear(channels + hidden, joint), nn.ReLU(), nn.Linear(joint, hidden)
        )

    def _add_action_head(self, hidden: int) -> None:
        if self.heads == "bench2drive":
            self.action_head = nn.Linear(hidden, ACTION_SIZE[self.heads])
            return
        for name in ("dist_mu", "dist_sigma"):
            positive = nn.Sequential(nn.Linear(hidden, DISTRIBUTIONS), nn.Softplus())
            self.add_module(name, positive)

    def forward(
        self, img: Tensor, state: Tensor, target_point: Tensor
    ) -> tuple[Tensor, ...]:
        """Compute waypoints and actions of one frame.

        Args:
            img: [1, 3, 256, 900] float32, normalised: front left, front, front right.
            state: [1, 9] float32: speed over 12 m/s, target point, command one-hot.
            target_point: [1, 2] float32, metres: x forward, y right, as in CARLA.

        Returns:
            Waypoints [1, 4, 2], metres, in the frame of the target point; then for
            ``bench2drive`` the logits of 39 actions now [1, 39] and in the next four
            steps [1, 4, 39]; for ``beta`` alpha and beta of acceleration and steer now
            and in the next four steps, [1, 2], [1, 2], [1, 4, 2] and [1, 4, 2].
        """
        with region("backbone"):
            vector, features = self.perception(img)
        with region("measurements"):
            measured = self.measurements(state)
        with region("planner"):
            waypoints, planned = self._trajectory(vector, measured, target_point)
        with region("control"):
            now, later = self._actions(features, measured, planned)
            if self.heads == "bench2drive":
                return waypoints, now, later
            return waypoints, *now.chunk(2, -1), *later.chunk(2, -1)

    def _trajectory(
        self, vector: Tensor, measured: Tensor, target_point: Tensor
    ) -> tuple[Tensor, list[Tensor]]:
        """Return the waypoints [1, 4, 2] and the cell's state [1, 256] at each."""
        hidden = self.join_traj(torch.cat([vector, measured], 1))
        at = torch.zeros_like(target_point)
        waypoints, states = [], []
        for _ in range(self.config.steps):
            hidden = self.decoder_traj(torch.cat([at, target_point], 1), hidden)
            at = self.output_traj(hidden) + at
            waypoints.append(at)
            states.append(hidden)
        return torch.stack(waypoints, 1), states

    def _actions(
        self, features: Tensor, measured: Tensor, planned: list[Tensor]
    ) -> tuple[Tensor, Tensor]:
        """Return the action now [1, A] and after each step of the plan [1, 4, A]."""
        seen = self.init_att.read(features, measured)
        x = self.join_ctrl(torch.cat([seen, measured], 1))
        now = action = self._action(x)
        hidden = torch.zeros_like(x)
        later = []
        # Attend to the image by the planned state
        for state in planned:
            hidden = self.decoder_ctrl(torch.cat([x, action], 1), hidden)
            seen = self.wp_att.read(features, torch.cat([hidden, state], 1))
            merged = self.merge(torch.cat([hidden, seen], 1))
            x = self.output_ctrl(merged) + x
            action = self._action(x)
            later.append(action)
        return now, torch.stack(later, 1)

    def _action(self, x: Tensor) -> Tensor:
        policy = self.policy_head(x)
        if self.heads == "bench2drive":
            out: Tensor = self.action_head(policy)
            return out
        parameters = [self.get_submodule(n)(policy) for n in ("dist_mu", "dist_sigma")]
        return torch.cat(parameters, -1)


def initialise(model: Tcp, images: Tensor, seed: int) -> None:
    """Draw parameters, then statistics of images [N, 3, H, W], normalised, in place."""
    draw_weights(model, GAINS, seed)
    with one_thread():
        take_statistics(model.perception, images)
