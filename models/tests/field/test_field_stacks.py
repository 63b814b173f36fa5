"""LEAD's and DiffusionDrive's structure through every recipe, for both targets.

Torch's older exporter writes what runs always; its newer one, whose graphs take longer
to write, runs where slow tests do.
"""

import itertools
import json
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from torch import Tensor, nn

from me2e_compress.graph import load
from me2e_compress.workflows.compress import compress
from me2e_compress.workflows.options import CompressOptions
from models.tests.field.diffusion_drive import DIFFUSION_DRIVE
from models.tests.field.transfuser import LEAD, FieldStack
from tests.frames import record

STACKS = {"lead": LEAD, "diffusion-drive": DIFFUSION_DRIVE}
CHOSEN = {"boxes": "TopK picks the best centres", "course": "argmax picks the anchor"}
"""Outputs that a choice between near equals decides, by what: no number bounds them."""
SUMMED = {"route": "CumSum adds up a shift that all its points share"}
"""Outputs whose placements part by more, by what: a few int8 layers of the trunk more,
which onnxruntime's cost rule keeps float, cost all others 3 dB and these 12."""
LEAST_DB = 22.0
"""Of every output that no choice decides; 23 to 68 dB were measured."""
PARTED_DB = 6.0
"""How far two placements of one plan may part: unsigned integers have half the step of
signed ones behind a ReLU, which is 6 dB."""


@dataclass(frozen=True)
class Written:
    """A stack as a file.

    Attributes:
        stack: its interface.
        file: the graph.
        frames: recorded, three scenes of four.
    """

    stack: FieldStack
    file: Path
    frames: Path


OLDER = [("lead", 17), ("diffusion-drive", 17)]
NEWER = itertools.product(STACKS, (20, 23))


@pytest.fixture(
    scope="module",
    params=[*OLDER, *(pytest.param(each, marks=pytest.mark.slow) for each in NEWER)],
    ids=lambda each: f"{each[0]}-{each[1]}",
)
def written(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Written:
    name, opset = request.param
    folder, stack = tmp_path_factory.mktemp(name), STACKS[name]
    frames = [drawn(stack, seed) for seed in range(12)]
    arrays = [{key: each.numpy() for key, each in frame.items()} for frame in frames]
    file = folder / "source.onnx"
    export(built(stack, frames), stack, frames[0], file, opset)
    return Written(stack, file, record(folder / "frames", arrays, (0, 4, 8)))


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


@pytest.fixture(scope="module")
def told(written: Written) -> dict[str, dict[str, float]]:
    """Compress for both targets; return what is told of every output, dB."""
    losses = {}
    for target in ("onnxruntime", "tensorrt"):
        small = written.file.with_name(f"{target}.onnx")
        result = compress(
            written.file,
            small,
            "full-fused",
            written.frames,
            CompressOptions(target=target),
        )
        assert result.status != "refused", result.verdict
        assert small.stat().st_size < 0.45 * written.file.stat().st_size
        report = json.loads(small.with_suffix(".report.json").read_text("utf-8"))
        measured = report["fidelity"]["fidelity"]["outputs"]
        losses[target] = {
            each["name"]: np.inf if each["sqnr_db"] is None else each["sqnr_db"]
            for each in measured
        }
    return losses


def test_full_fused_loses_little_for_both_targets(
    written: Written, told: dict[str, dict[str, float]]
) -> None:
    for losses in told.values():
        assert set(losses) == set(written.stack.outputs)
        steady = {name: db for name, db in losses.items() if name not in CHOSEN}
        assert min(steady.values()) > LEAST_DB, steady


def test_two_placements_of_one_plan_keep_the_same(
    told: dict[str, dict[str, float]],
) -> None:
    here, there = told.values()
    parted = {
        name: (db, there[name])
        for name, db in here.items()
        if name not in {**CHOSEN, **SUMMED} and abs(db - there[name]) > PARTED_DB
    }
    assert parted == {}


@pytest.mark.parametrize("recipe", ["exact", "fused"])
def test_a_second_exact_run_changes_nothing(
    written: Written, recipe: str, tmp_path: Path
) -> None:
    first, second = tmp_path / "first.onnx", tmp_path / "second.onnx"
    for source, file in ((written.file, first), (first, second)):
        assert compress(source, file, recipe, written.frames).status != "refused"
    kinds = [[node.op_type for node in load(file).graph] for file in (first, second)]
    assert kinds[0] == kinds[1]
    assert "SequenceAt" not in kinds[0]
    # the speed's own, which no layer is in front of
    assert kinds[0].count("BatchNormalization") <= 1
