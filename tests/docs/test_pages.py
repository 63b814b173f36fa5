"""What single pages of docs say and show is so: each is done as it stands there."""

import importlib.util
import re
import subprocess
import sys
import types
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest

import me2e_compress as me2e
from me2e_compress.commands.inspect import inspect
from me2e_compress.driving.adapter import Adapter
from me2e_compress.driving.onnx_policy import OnnxPolicy
from me2e_compress.driving.shipped_adapters import adapter_file
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.session import DTYPES, Session, replay
from me2e_compress.shipped.drivers import frames_of, shipped_model
from tests.docs.pages import ROOT, Block, blocks
from tests.driving.observed import motion, observation
from tests.evaluators.highway.drivers import straight_on
from tests.support.command import Cli
from tests.support.frames import record
from tests.support.nets import save_text
from tests.support.stacks import dense_frames, write_dense

DOCS = ROOT / "docs"
CAMERA = ROOT / "examples" / "front_camera"
SHOWN = blocks(DOCS / "adapter.md", "onnx", "toml")
TCP = (
    Block("onnx", "float[1,3,256,900] img, float[1,9] state, float[1,2] target_point"),
    Block("toml", adapter_file(Path("tcp")).read_text(encoding="utf-8")),
)


@pytest.mark.parametrize(
    ("graph", "adapter"), [*zip(SHOWN[::2], SHOWN[1::2], strict=True), TCP]
)
def test_a_graph_is_fed_by_the_adapter_beside_it(
    graph: Block, adapter: Block, tmp_path: Path
) -> None:
    assert (graph.language, adapter.language) == ("onnx", "toml")
    model = straight_on(
        tmp_path / "m.onnx",
        inputs=graph.text.strip(),
        outputs="float[1, 6, 2] plan, float[1, 3, 3] l2g_r_mat_out",
        body="plan = Identity (ahead) l2g_r_mat_out = Identity (turn_of)",
        initializers=f", float[1, 3, 3] turn_of = {{{'0, ' * 8} 1}}",
    )
    toml = tmp_path / "a.toml"
    toml.write_text(adapter.text)
    policy = OnnxPolicy.open(
        model, Adapter.load(toml).model_copy(update={"plan": None})
    )
    pictures = np.zeros((6, *policy.image_size, 3), np.uint8)

    feeds = policy.inputs.feeds(observation(motion(0.0, 0.0, 0.0), images=pictures))

    policy.reset(None)
    feeds |= policy._state | policy.first_values(feeds)
    for name, port in policy.session.inputs.items():
        assert feeds[name].shape == port.shape
        assert feeds[name].dtype == DTYPES[port.type]


def test_the_driver_has_the_modules_parameters_and_macs_of_its_page() -> None:
    row = r"^\| `(\w+)` \|.*\| ([\d,]+) \| ([\d.]+) \|$"
    rows = re.findall(row, (DOCS / "driver.md").read_text(), re.MULTILINE)

    assert [(n, int(p.replace(",", "")), float(macs)) for n, p, macs in rows] == [
        (item.module, item.parameters, round((item.macs or 0) / 1e6, 1))
        for item in inspect(shipped_model("highway"), None).modules
    ]


class Runner:
    """Runs a graph as polygraphy runs an engine; answers share one memory."""

    def __init__(self, session: Session) -> None:
        self.session, self.memory = session, dict[str, Array]()

    def get_input_metadata(self) -> Mapping[str, object]:
        return self.session.inputs

    def infer(self, feeds: Mapping[str, Array]) -> dict[str, Array]:
        for name, value in self.session.run(feeds).items():
            held: Any = self.memory.setdefault(name, np.array(value))
            held[...] = value
        return self.memory


@contextmanager
def runner(path: str) -> Iterator[Runner]:
    yield Runner(Session(Path(path)))


@pytest.fixture
def dumped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Run the script of docs/engine-dumps.md over three frames of two scenes."""
    drawn = np.random.default_rng(0)
    shapes = Session(shipped_model("highway")).inputs
    record(tmp_path / "frames", [
        {
            name: np.array([1]) if name == "command"
            else drawn.normal(size=np.array(port.shape, int)).astype(np.float32)
            for name, port in shapes.items() if not name.startswith("prev_")
        }
        for _ in range(3)
    ], (0, 2))  # fmt: skip
    package: dict[str, dict[str, Any]] = {
        "polygraphy": {},
        "polygraphy.backend": {},
        "polygraphy.backend.common": {"BytesFromPath": str},
        "polygraphy.backend.trt": {"EngineFromBytes": str, "TrtRunner": runner},
    }
    for name, contents in package.items():
        module = types.ModuleType(name)
        module.__dict__.update(contents)
        monkeypatch.setitem(sys.modules, name, module)
    (script,) = blocks(DOCS / "engine-dumps.md", "python")
    paths = [str(each) for each in (shipped_model("highway"), tmp_path / "frames")]
    monkeypatch.setattr(sys, "argv", ["dump.py", *paths, str(tmp_path / "dump")])
    exec(script.text, {})
    return tmp_path / "dump"


def test_a_dump_is_what_a_replay_answers_and_compare_reads_it(
    dumped: Path, cli: Cli
) -> None:
    frames = me2e.CalibrationSet(dumped.with_name("frames"))
    answers = replay(Session(shipped_model("highway")), frames)
    for path, wanted in zip(sorted(dumped.iterdir()), answers, strict=True):
        assert path.name in {each.name for each in frames.files}
        found = dict(np.load(path))
        for name, array in wanted.items():
            right: Any = array
            np.testing.assert_allclose(found[name], right, rtol=1e-4, atol=1e-4)

    read = cli.document(f"compare highway {dumped.parent}/frames --outputs {dumped}")

    assert read["verdict"][0].startswith("the engine answers as its graph does")
    assert read["state"].startswith("the engine's own")


@pytest.mark.parametrize(
    "words", ["highway highway", "highway highway frames --outputs dump"]
)
def test_two_graphs_or_one_and_its_engine(words: str, cli: Cli) -> None:
    said = cli(f"compare {words}")
    assert said.code == 2
    assert "expected" in said.err


@pytest.mark.usefixtures("weights")
def test_the_front_camera_is_recorded_cloned_and_plans(tmp_path: Path) -> None:
    spec = importlib.util.spec_from_file_location("front", CAMERA / "clone.py")
    assert spec is not None
    assert spec.loader is not None
    clone = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(clone)
    blank, model = tmp_path / "blank.onnx", tmp_path / "front.onnx"
    onnx.save(clone.network(None), blank)
    options = me2e.FramesOptions(count=6, scene_length=6, adapter=CAMERA / "front.toml")
    frames = me2e.record_frames(blank, tmp_path / "frames", options)

    xs, ways = clone.examples(frames)
    weights = clone.fitted(xs, ways)
    onnx.save(clone.network(weights), model)

    assert ways.shape == (2, 4, 2)
    assert (np.diff(ways[:, :, 0]) >= 0).all()
    assert not me2e.check_model(
        model, me2e.GraphOptions(adapter=CAMERA / "front.toml")
    ).problems
    first = next(iter(me2e.CalibrationSet(frames))).arrays
    del first["can_bus"]
    (planned,) = Session(model, threads=1).run(first).values()
    assert planned.reshape(-1) == pytest.approx(xs[0] @ weights, abs=1e-3)
    (shown,) = blocks(DOCS / "front-camera.md", "sh")
    assert "clone.py" in shown.text
    assert "front.toml" in shown.text


def test_a_stack_that_is_cut_and_joined_decides_as_the_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    page = DOCS / "stacks.md"
    (toml,), (script,) = blocks(page, "toml"), blocks(page, "python")
    Path("stack.toml").write_text(toml.text)
    exec(script.text, {})

    made = me2e.join("stack.toml", "whole.onnx")

    whole = shipped_model("highway")
    frames = me2e.CalibrationSet(frames_of(whole) or tmp_path)
    for joined, one in zip(
        *(replay(Session(path), frames, ["plan"]) for path in (made.output, whole)),
        strict=True,
    ):
        assert joined["plan"].tolist() == one["plan"].tolist()
    policies = map(OnnxPolicy.open, (made.output, whole))
    read, shown = (
        (p.recurrent, *((e.normalization, e.size) for e in p.inputs.images.values()))
        for p in policies
    )
    assert read == shown


def test_the_commands_of_stacks_run(cli: Cli) -> None:
    write_dense(cli.folder)  # a smaller stack
    dense_frames(cli.folder)

    for block in blocks(DOCS / "stacks.md", "sh"):
        for line in block.text.splitlines():
            cli.done(line.removeprefix("me2e-compress "))


def test_the_line_that_names_the_state_of_your_model_works(tmp_path: Path) -> None:
    save_text(
        tmp_path / "M.onnx",
        "mine (float[1,4] img, float[1,4] prev_bev) => (float[1,4] bev_embed)"
        " { bev_embed = Add(img, prev_bev) }",
    )
    (line,) = blocks(DOCS / "your-model.md", "")
    assert line.text.startswith("python -c ")
    run = line.text.replace("python", sys.executable, 1)

    for _ in range(2):  # a line that is copied is run again
        subprocess.run(["bash", "-c", run], cwd=tmp_path, check=True)

    assert Session(tmp_path / "M.onnx").recurrent == {"prev_bev": "bev_embed"}
