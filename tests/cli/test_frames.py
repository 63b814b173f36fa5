"""``frames --from``: recorded driving that another package reads."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from me2e_compress.calibration.dataset import CalibrationSet, PixelInput
from me2e_compress.calibration.recording import LOGS, Begin, DriveLog, LogRequest
from me2e_compress.driving.shipped_adapters import adapter_file
from me2e_compress.runtime.frames import Array, Frame
from tests.support.command import Cli
from tests.support.installed import install
from tests.support.nets import save_text

MODEL = "camera (float[1,3,2,2] img) => (float[1,3,2,2] plan) { plan = Relu(img) }"
PIXELS = PixelInput(mean=(1, 1, 1), std=(2, 2, 2), order="rgb", rows=2, columns=2)


@dataclass(frozen=True)
class Rides(DriveLog):
    """Two rides of two pictures each.

    Attributes:
        root: where they are.
    """

    name: ClassVar[str] = "rides"
    requests: ClassVar[list[LogRequest]] = []
    root: Path = field(kw_only=False)

    def frames(self, request: LogRequest, begin: Begin) -> Iterator[Frame]:
        """Yield grey pictures."""
        self.requests.append(request)
        for index in range(begin.frame, min(4, request.count)):
            arrays: dict[str, Array] = {"img": np.full((1, 3, 2, 2), 9 + index, "u1")}
            yield Frame(index, index % 2 == 0, arrays, index // 2)

    def pixels(self, request: LogRequest) -> Mapping[str, PixelInput]:
        """Return that the pictures are bytes."""
        return {"img": PIXELS}


@pytest.fixture(autouse=True)
def installed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    entry = {"rides": f"{__name__}:Rides"}
    install(monkeypatch, tmp_path / "site", "their-rides", LOGS.group, entry)
    save_text(tmp_path / "m.onnx", MODEL)


def test_a_log_of_another_package_becomes_the_frames_that_it_is_asked_for(
    cli: Cli, tmp_path: Path
) -> None:
    found = cli.document("frames m.onnx --from rides:log -n 3 -o out")

    assert (found["frames"], found["seed"]) == (3, None)
    assert found["log"] == 'rides{root="log"}'
    recording = CalibrationSet(tmp_path / "out")
    assert recording.scenes == (0, 2)
    assert [each.arrays["img"][0, 0, 0, 0] for each in recording] == [4.0, 4.5, 5.0]
    line = "--from rides:log --adapter vad-tiny -n 2 --scene-length 1"
    cli.done(f"frames m.onnx {line} -o other")
    assert Rides.requests[-1] == LogRequest(
        Path("m.onnx"), 2, 1, adapter_file(Path("vad-tiny"))
    )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("m.onnx --from kitti:log", "no driving log 'kitti'; there are rides"),
        ("nothing --from rides:log", "nothing: no such file; models that ship"),
    ],
)
def test_what_does_not_fit_is_one_line(cli: Cli, words: str, message: str) -> None:
    assert message in cli.refused(f"frames {words} -o out")
