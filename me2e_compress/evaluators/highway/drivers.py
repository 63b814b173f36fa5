"""Who drives: ``expert``, ``blind``, or the path of an ONNX file."""

import hashlib
from dataclasses import dataclass
from pathlib import Path

from me2e_compress.driving.contract import Policy
from me2e_compress.errors import EvaluationError
from me2e_compress.evaluators.highway.adapter import Adapter
from me2e_compress.evaluators.highway.blind import Blind
from me2e_compress.evaluators.highway.expert import Expert
from me2e_compress.evaluators.highway.onnx_policy import OnnxPolicy
from me2e_compress.evaluators.highway.ports import DEFAULT_IMAGE_SIZE
from me2e_compress.graph import sha256_of

EXPERT = "expert"
BLIND = "blind"


@dataclass(frozen=True)
class Driver:
    """A policy by name, which any process can open for itself.

    Args:
        name: ``expert``, ``blind``, ``blind:S`` for S metres per second, or the path
            of an ONNX file.
        adapter: TOML file that adapts the model to the policy contract.
    """

    name: str
    adapter: Path | None = None

    def open(self) -> Policy:
        """Return the policy.

        Raises:
            EvaluationError: No such file or name, or a model that cannot drive.
        """
        if self.name == EXPERT:
            return Expert()
        if self._is_blind:
            return Blind(self._speed_mps)
        if not Path(self.name).is_file():
            raise EvaluationError(
                f"policy {self.name}: no such file, and neither {EXPERT} nor {BLIND}"
            )
        adapter = None if self.adapter is None else Adapter.load(self.adapter)
        return OnnxPolicy.open(Path(self.name), adapter)

    def fingerprint(self) -> str:
        """Return what identifies the policy: its name, or digests of its files."""
        if self.name == EXPERT or self._is_blind:
            return self.name
        digests = [sha256_of(Path(self.name))]
        if self.adapter is not None:
            digests.append(hashlib.sha256(self.adapter.read_bytes()).hexdigest())
        return "+".join(digests)

    @property
    def is_model(self) -> bool:
        """Whether it is an ONNX file, not one of the drivers that are built in."""
        return self.name != EXPERT and not self._is_blind

    @property
    def _is_blind(self) -> bool:
        return self.name == BLIND or self.name.startswith(f"{BLIND}:")

    @property
    def _speed_mps(self) -> float:
        _, _, text = self.name.partition(":")
        if not text:
            return Blind().speed_mps
        try:
            speed = float(text)
        except ValueError:
            speed = float("nan")
        if not 0.0 < speed < float("inf"):
            raise EvaluationError(f"policy {self.name}: {text} is not a speed in m/s")
        return speed


def image_size_of(policy: Policy) -> tuple[int, int]:
    """Return rows and columns of the images that a policy wants."""
    if isinstance(policy, OnnxPolicy):
        return policy.image_size
    return DEFAULT_IMAGE_SIZE
