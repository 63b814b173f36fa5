"""LEAD's and DiffusionDrive's structure through every recipe, for both targets.

The recipes exact and full-fused of what torch's older exporter writes run always; the
others, and the newer exporter's graphs, where slow tests do.
"""

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from torch import Tensor, nn

from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.commands.compress import compress
from me2e_compress.commands.lint import lint
from me2e_compress.commands.options import CompressOptions, LintOptions
from me2e_compress.fidelity.compare import compare
from me2e_compress.graph import load
from me2e_compress.runtime.session import Session
from models.tests.field.diffusion_drive import DIFFUSION_DRIVE
from models.tests.field.transfuser import LEAD, FieldStack
from tests.support.frames import record

STACKS = {"lead": LEAD, "diffusion-drive": DIFFUSION_DRIVE}
TARGETS = ("onnxruntime", "tensorrt")
FRAMES, SCENES = 6, (0, 2, 4)
CHOSEN = {"lead": {"boxes": "heat"}, "diffusion-drive": {"course": "courses"}}
"""Outputs that a choice between near equals decides, by what they are chosen from."""
LEAST_DB, EXACT_DB = 22.0, 80.0
"""Of every output that no choice decides, in int8 and where a recipe is exact."""
PARTED_DB = 6.0
"""How far two placements of one plan may part: unsigned integers have half the step of
signed ones behind a ReLU, which is 6 dB."""
PARTED: dict[str, dict[str, str]] = {"lead": {}, "diffusion-drive": {}}
"""Outputs whose placements part by more, and why."""
NORMS = {"lead": 1, "diffusion-drive": 0}
"""Normalizations that stay: LEAD's of the speed, which no layer is in front of."""


@dataclass(frozen=True)
class Written:
    """A stack as a file.

    Attributes:
        name: of the stack.
        stack: its interface.
        file: the graph.
        frames: recorded, three scenes of two.
    """

    name: str
    stack: FieldStack
    file: Path
    frames: Path


@pytest.fixture(
    scope="module",
    params=[
        *((name, 17) for name in STACKS),
        *(
            pytest.param((name, opset), marks=pytest.mark.slow)
            for name in STACKS
            for opset in (20, 23)
        ),
    ],
    ids=lambda wanted: f"{wanted[0]}-{wanted[1]}",
)
def written(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Written:
    name, opset = request.param
    folder, stack = tmp_path_factory.mktemp(name), STACKS[name]
    frames = [drawn(stack, seed) for seed in range(FRAMES)]
    arrays = [{key: value.numpy() for key, value in frame.items()} for frame in frames]
    file = folder / "source.onnx"
    export(built(stack, frames), stack, frames[0], file, opset)
    return Written(name, stack, file, record(folder / "frames", arrays, SCENES))


def drawn(stack: FieldStack, seed: int) -> dict[str, Tensor]:
    """Draw inputs: smooth pictures, points in metres, noise."""
    random = np.random.default_rng(seed)

    def normal(*shape: int) -> Tensor:
        return torch.from_numpy(random.standard_normal(shape, np.float32))

    def smooth(shape: tuple[int, ...]) -> Tensor:
        coarse = normal(*shape[:2], shape[2] // 8, shape[3] // 8)
        return nn.functional.interpolate(coarse, size=shape[2:], mode="bilinear")

    frame = {
        name: smooth(shape) if name in ("image", "lidar") else normal(*shape)
        for name, shape in stack.inputs.items()
    }
    frame["image"] = (120 + 50 * frame["image"]).clamp(0, 255)
    frame["lidar"] = frame["lidar"].relu()
    if "points" in frame:
        frame["points"][..., :2] *= 15
        frame["points"][..., 3] = frame["points"][..., 3].abs().clamp(0, 3).round()
        frame["speed"] = 5 * frame["speed"].abs()
        frame["goals"] *= torch.tensor((40.0, 10.0))
    return frame


def built(stack: FieldStack, frames: list[dict[str, Tensor]]) -> nn.Module:
    """Build it with weights of seed 0; the frames settle its batch norms."""
    torch.manual_seed(0)
    model = stack.build().requires_grad_(False)
    for module in model.modules():
        if isinstance(module, (nn.BatchNorm1d, nn.BatchNorm2d)):
            module.momentum = None
        elif isinstance(module, nn.Dropout):
            module.p = 0.0
    model(*(torch.cat([frame[name] for frame in frames]) for name in stack.inputs))
    return model.eval()


def export(
    model: nn.Module,
    stack: FieldStack,
    frame: dict[str, Tensor],
    file: Path,
    opset: int,
) -> None:
    """Write it by the exporter of that opset, as it comes out of its trace."""
    feeds, names = tuple(frame.values()), (list(stack.inputs), list(stack.outputs))
    fast = torch.backends.mha.get_fastpath_enabled()
    torch.backends.mha.set_fastpath_enabled(False)
    try:
        with warnings.catch_warnings(), torch.no_grad():
            warnings.simplefilter("ignore")
            if opset < 18:
                torch.onnx.export(
                    model, feeds, file, opset_version=opset, dynamo=False,
                    input_names=names[0], output_names=names[1],
                )  # fmt: skip
                return
            program = torch.onnx.export(
                model, feeds, opset_version=opset, dynamo=True, optimize=False,
                input_names=names[0], output_names=names[1], verbose=False,
            )  # fmt: skip
    finally:
        torch.backends.mha.set_fastpath_enabled(fast)
    assert program is not None
    onnx.save(program.model_proto, file)


def compressed(
    written: Written, recipe: str, file: Path, target: str | None = None
) -> dict[str, float]:
    """Compress; return what is kept of every output, dB, infinite where it is equal.

    An output that is chosen is judged by what it is chosen from.
    """
    options = CompressOptions(target=target)
    result = compress(written.file, file, recipe, written.frames, options)
    assert result.status != "refused", result.summary_lines
    for runtime in TARGETS if target is None else (target,):
        assert lint(file, LintOptions(target=runtime)).refusal is None
    sessions = Session(written.file), Session(file)
    measured = compare(*sessions, CalibrationSet(written.frames)).outputs
    assert {output.name for output in measured} == set(written.stack.outputs)
    kept = {output.name: output.sqnr_db for output in measured}
    chosen = CHOSEN[written.name]
    assert kept.keys() >= set(chosen.values())
    return {name: db for name, db in kept.items() if name not in chosen}


@pytest.mark.parametrize(
    "recipe", ["full-fused", pytest.param("full", marks=pytest.mark.slow)]
)
def test_int8_loses_little_on_both_targets(
    written: Written, recipe: str, tmp_path: Path
) -> None:
    kept = {}
    for target in TARGETS:
        file = tmp_path / f"{target}.onnx"
        kept[target] = compressed(written, recipe, file, target)
        assert file.stat().st_size < 0.45 * written.file.stat().st_size
    assert min(min(outputs.values()) for outputs in kept.values()) > LEAST_DB, kept
    here, there = kept.values()
    parted = {name for name in here if abs(here[name] - there[name]) > PARTED_DB}
    assert parted <= PARTED[written.name].keys(), kept


@pytest.mark.parametrize(
    "recipe", ["exact", pytest.param("fused", marks=pytest.mark.slow)]
)
def test_a_second_exact_run_changes_nothing(
    written: Written, recipe: str, tmp_path: Path
) -> None:
    first, second = tmp_path / "first.onnx", tmp_path / "second.onnx"
    assert min(compressed(written, recipe, first).values()) > EXACT_DB
    assert compress(first, second, "exact", written.frames).status != "refused"
    kinds = [[node.op_type for node in load(file).graph] for file in (first, second)]
    assert kinds[0] == kinds[1]
    assert "SequenceAt" not in kinds[0]
    assert kinds[0].count("BatchNormalization") == NORMS[written.name]
