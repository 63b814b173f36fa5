"""Dumps of engines are read in every form, and refused in one line."""

import base64
import io
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.engine_dump import EngineDump
from me2e_compress.errors import FramesError
from me2e_compress.runtime.frames import Array
from tests.frames import record

ANSWERS: list[dict[str, Any]] = [
    {
        "plan": np.full((1, 6, 2), at, np.float32),
        "score": np.array([at, 0.5], np.float32),
    }
    for at in range(3)
]


def as_npz(folder: Path, answers: Sequence[Mapping[str, Array]] = ANSWERS) -> Path:
    return record(folder, answers)


def exported(answers: Mapping[str, Array]) -> str:
    """Write as trtexec does: sampleReporting.cpp, exportJSONOutput."""
    parts = [
        f'{{ "name" : "{name}"\n  , "dimensions" : "{"x".join(map(str, each.shape))}"\n'
        f'  , "values" : [ {", ".join(f"{value:g}" for value in each.reshape(-1))} ]\n'
        "  }\n"
        for name, each in answers.items()
    ]
    return "[\n  " + ", ".join(parts) + "]\n"


def as_trtexec(folder: Path) -> Path:
    folder.mkdir()
    for at, answers in enumerate(ANSWERS):
        (folder / f"{at:06d}.json").write_text(exported(answers))
    return folder


def encoded(array: Array) -> dict[str, object]:
    """Encode as polygraphy 0.53 does: json/serde.py, comparator/struct.py."""
    content = io.BytesIO()
    np.save(content, array, allow_pickle=False)
    text = base64.b64encode(content.getvalue()).decode()
    held = {"array": text, "polygraphy_class": "ndarray"}
    return {"values": held, "polygraphy_class": "LazyArray"}


def as_polygraphy(path: Path, runners: int = 1) -> Path:
    iterations = [
        {
            "outputs": {name: encoded(each) for name, each in answers.items()},
            "runtime": 0.1,
            "runner_name": "trt-runner-N0",
            "polygraphy_class": "IterationResult",
        }
        for answers in ANSWERS
    ]
    runs = [[f"trt-runner-N{at}", iterations] for at in range(runners)]
    path.write_text(json.dumps({"lst": runs, "polygraphy_class": "RunResults"}))
    return path


@pytest.fixture
def frames(tmp_path: Path) -> CalibrationSet:
    return CalibrationSet(record(tmp_path / "frames", [{"x": np.ones(1)}] * 3))


def _read(path: Path, frames: CalibrationSet | None) -> None:
    found = EngineDump(path)
    if frames is not None:
        found.check(frames)


def refused(path: Path, frames: CalibrationSet | None = None) -> str:
    with pytest.raises(FramesError) as caught:
        _read(path, frames)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("form", ["npz", "trtexec", "polygraphy", "in a folder"])
def test_every_form_says_the_same(
    form: str, tmp_path: Path, frames: CalibrationSet
) -> None:
    write: dict[str, Callable[[], Path]] = {
        "npz": lambda: as_npz(tmp_path / "dump"),
        "trtexec": lambda: as_trtexec(tmp_path / "dump"),
        "polygraphy": lambda: as_polygraphy(tmp_path / "dump.json"),
        "in a folder": lambda: as_polygraphy(frames.folder.with_name("d.json")),
    }
    dump = EngineDump(write[form]())
    dump.check(frames)

    assert dump.names == ("plan", "score")
    assert len(dump) == 3
    for found, wanted in zip(dump, ANSWERS, strict=True):
        for name, array in wanted.items():
            assert form == "trtexec" or found[name].dtype == array.dtype
            np.testing.assert_array_equal(found[name], array)


def test_what_cpp_writes_of_no_number_is_read(tmp_path: Path) -> None:
    odd = {"plan": np.array([np.nan, -np.nan, np.inf, -np.inf], np.float32)}
    (tmp_path / "000000.json").write_text(exported(odd).replace(" nan,", " -nan,", 1))
    found = EngineDump(tmp_path)[0]["plan"]
    assert np.isnan(found[:2]).all()
    assert found[2:].tolist() == [np.inf, -np.inf]


@pytest.mark.parametrize("form", ["npz", "json"])
def test_a_file_that_is_cut(form: str, tmp_path: Path, frames: CalibrationSet) -> None:
    write = as_npz if form == "npz" else as_trtexec
    file = write(tmp_path / "dump") / f"000001.{form}"
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    assert str(file) in refused(tmp_path / "dump", frames)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, ": holds no .npz and no .json of an engine's answers"),
        ('[{"startEnqMs": 1}]', "not what trtexec --exportOutput writes"),
        ('[{"name": "plan", "dimensions": [1, 2], "values": [1, 2]}]', "a.json: not "),
        (
            '{"lst": [["trt", [{"outputs": {"plan": {"values": "?"}}}]]]}',
            "a.json: not ",
        ),
        ('{"lst": [["trt", [{"outputs": ["plan"]}]]]}', "a.json: not "),
    ],
)
def test_a_folder_of_no_dump(text: str | None, said: str, tmp_path: Path) -> None:
    if text is not None:
        (tmp_path / "a.json").write_text(text)
    assert said in refused(tmp_path)


@pytest.mark.parametrize("kind", ["complex64", "U4", "V4"])
def test_arrays_of_no_numbers(
    kind: str, tmp_path: Path, frames: CalibrationSet
) -> None:
    changed = [dict(each) for each in ANSWERS]
    changed[2]["plan"] = np.zeros((1, 6, 2), kind)
    as_npz(tmp_path / "dump", changed)
    assert refused(tmp_path / "dump", frames).startswith(
        f"{tmp_path}/dump/000002: plan is {np.dtype(kind)}, which is no number"
    )


def cut_text(dump: Path) -> None:
    as_polygraphy(dump)
    dump.write_text(dump.read_text()[:-40])


def cut_array(dump: Path) -> None:
    text = json.loads(as_polygraphy(dump).read_text())
    held = text["lst"][0][1][0]["outputs"]["plan"]["values"]
    held["array"] = held["array"][:40]
    dump.write_text(json.dumps(text))


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda dump: None, "DUMP: no such folder or file"),
        (
            lambda dump: (as_npz(dump) / "a.json").write_text("[]"),
            "holds both .npz and .json",
        ),
        (cut_text, "DUMP: not the JSON of an engine's answers"),
        (cut_array, "not the RunResults that polygraphy"),
        (lambda dump: as_polygraphy(dump, 2), "2 runners, expected one"),
        (
            lambda dump: as_npz(dump, ANSWERS[:2]),
            "answers to 2 frames, FRAMES has 3: the dump is of other frames",
        ),
        (
            lambda dump: (as_npz(dump) / "000001.npz").unlink(),
            "DUMP: 000001 is not answered: answers to 2",
        ),
        (
            lambda dump: (as_npz(dump) / "000002.npz").rename(dump / "000009.npz"),
            "000009 is answered and is no frame of",
        ),
    ],
)
def test_what_is_no_whole_dump_of_the_frames(
    spoil: Callable[[Path], object], said: str, tmp_path: Path, frames: CalibrationSet
) -> None:
    dump = tmp_path / "dump"
    spoil(dump)
    said = said.replace("DUMP", str(dump)).replace("FRAMES", str(frames.folder))
    assert said in refused(dump, frames)


@pytest.mark.parametrize("lacks", [0, 2])
def test_a_frame_without_an_output(
    lacks: int, tmp_path: Path, frames: CalibrationSet
) -> None:
    cut = [dict(each) for each in ANSWERS]
    del cut[lacks]["score"]
    as_npz(tmp_path / "dump", cut)
    assert refused(tmp_path / "dump", frames) == (
        f"{tmp_path}/dump/{lacks:06d}: score is missing; other frames have it"
    )


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.binary(max_size=200) | st.text(max_size=200).map(str.encode))
def test_any_file_is_read_or_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.json").write_bytes(content)
    try:
        EngineDump(tmp_path)
    except FramesError as error:
        assert "\n" not in str(error)  # noqa: PT017
