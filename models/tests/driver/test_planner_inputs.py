"""What the planner alone learns from: kept on disk until its stage has ended."""

from pathlib import Path

import pytest
import torch

from me2e_compress.simulator.camera_rig import CameraRig
from models.driver import sampled_losses
from models.driver.data import Episodes
from models.driver.network.stack import Highway
from models.driver.sampled_losses import PlannerInputCache
from models.tests.driver.made import LITTLE, SIZE, arrays_of, write

LIDAR2IMG = torch.from_numpy(CameraRig(*SIZE).lidar2img)


@pytest.fixture(scope="module")
def episodes(tmp_path_factory: pytest.TempPathFactory) -> Episodes:
    folder = tmp_path_factory.mktemp("episodes")
    files = [write(folder / f"{i}.npz", arrays_of(3, i)) for i in range(2)]
    return Episodes(files, SIZE)


@pytest.fixture
def model() -> Highway:
    torch.manual_seed(0)
    return Highway(LITTLE).eval()


def cached(model: Highway, episodes: Episodes, folder: Path) -> dict[str, torch.Tensor]:
    return PlannerInputCache.of(model, episodes, LIDAR2IMG, folder).rows


def same(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> bool:
    return one.keys() == other.keys() and all(
        torch.equal(one[name], other[name]) and one[name].dtype == other[name].dtype
        for name in one
    )


def test_what_was_kept_is_read_and_not_run_again(
    model: Highway,
    episodes: Episodes,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before = cached(model, episodes, tmp_path)
    assert len(list(tmp_path.iterdir())) == 2
    monkeypatch.setattr(sampled_losses, "_episode", None)
    torch.nn.init.zeros_(model.planner.score.get_parameter("0.weight"))
    assert same(cached(model, episodes, tmp_path), before)


def test_a_damaged_file_is_made_again(
    model: Highway, episodes: Episodes, tmp_path: Path
) -> None:
    before = cached(model, episodes, tmp_path)
    file = min(tmp_path.iterdir())
    content = file.read_bytes()
    for damaged in (b"", content[:-40], b"no archive"):
        file.write_bytes(damaged)
        assert same(cached(model, episodes, tmp_path), before)
        assert file.read_bytes() == content


def test_other_weights_or_pictures_have_other_files(
    model: Highway, episodes: Episodes, tmp_path: Path
) -> None:
    cached(model, episodes, tmp_path)
    model.occ.get_parameter("body.4.bias").data.add_(1)
    cached(model, episodes, tmp_path)
    assert len(list(tmp_path.iterdir())) == 4
    kept = episodes.pictures[0]
    episodes.pictures[0] = episodes.pictures[1]
    cached(model, episodes, tmp_path)
    episodes.pictures[0] = kept
    assert len(list(tmp_path.iterdir())) == 5
