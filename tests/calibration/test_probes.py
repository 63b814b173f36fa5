from pathlib import Path

import numpy as np
import pytest

from me2e_compress import graph
from me2e_compress.calibration.calibrator import (
    Calibrator,
    Extremes,
    probed_session,
    schedule_probes,
)
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.statistics import READINGS, insert_probes
from me2e_compress.operators.kernels.kernel import BINS
from me2e_compress.runtime.session import Session
from tests.support.frames import record
from tests.support.nets import conv_attention, image, parsed

TENSORS = ("image", "a", "r", "seen", "q", "scores", "p", "mixed")


def test_models_with_probes_still_answer_and_keep_their_metadata() -> None:
    model = conv_attention()
    model.metadata_props["me2e.recurrent"] = '{"memory": "memory_out"}'
    feeds = {**image(3), "memory": np.zeros((1, 8, 64), np.float32)}
    session = probed_session(model, TENSORS, Extremes(), threads=1, optimize=True)
    other = Session(model)

    assert session.recurrent == {"memory": "memory_out"}
    ours, plain = (np.asarray(s.run(feeds)["y"], float) for s in (session, other))
    np.testing.assert_allclose(ours, plain, rtol=1e-5, atol=1e-5)


def test_scheduling_lets_probes_run_as_soon_as_they_can() -> None:
    model = insert_probes(conv_attention(), TENSORS, Extremes())
    late = [node for node in model.graph if (node.name or "").startswith(READINGS)]
    model.graph.remove(late)
    model.graph.extend(late)

    schedule_probes(model)

    nodes = list(model.graph)
    assert {node.name for node in nodes} >= {node.name for node in late}
    made = {value: at for at, node in enumerate(nodes) for value in node.outputs}
    driving = [at for at, n in enumerate(nodes) if not str(n.name).startswith(READINGS)]
    for at, node in enumerate(nodes):
        sources = [made[value] for value in node.inputs if value in made]
        assert all(source < at for source in sources)
        if at not in driving and sources and node.op_type != "Concat":
            assert not [other for other in driving if max(sources) < other < at]


def test_nodes_that_lead_nowhere_survive_the_scheduling() -> None:
    model = parsed(
        "m (float[2] x, bool c) => (float[2] y) { y = Relu(x)"
        " z = If (c) <then_branch = t () => (float[2] a) { a = Abs(y) },"
        " else_branch = e () => (float[2] b) { b = Neg(y) }> }"
    )

    schedule_probes(model)

    assert [node.op_type for node in model.graph] == ["Relu", "If"]


@pytest.mark.parametrize("opset", [13, 17])
def test_histograms_are_those_of_numpy(tmp_path: Path, opset: int) -> None:
    model = parsed(
        f'<ir_version: 9, opset_import: ["" : {opset}]>\n'
        "m (float[4,900] x) => (float[4,900] y) { y = Neg(x) }"
    )
    draws = np.random.default_rng(0)
    arrays = [draws.normal(0, 3, (4, 900)).astype(np.float32) for _ in range(3)]
    frames = CalibrationSet(record(tmp_path, [{"x": each} for each in arrays]))

    seen = Calibrator("mse", threads=1).collect(model, ["x", "y"], frames)

    together = np.abs(np.stack(arrays))
    edge = 2.0 ** np.frexp(together.max())[1]
    expected, _ = np.histogram(together, BINS, (0, edge))
    np.testing.assert_array_equal(seen.histograms(), [expected, expected])
    assert graph.digest(model) == seen.model


def test_what_onnxruntime_names_twice_in_a_branch_is_still_measured() -> None:
    # Its fusion of MatMul and Add gives a reshape one name, here and in the branch.
    model = parsed(
        '<ir_version: 9, opset_import: ["" : 20]>\n'
        """g (bool s, float[2,2,3,2] x) => (float[2,2,3,2] z)
        <float[2] b = {1, 2}, float[2,2] w = {1, 2, 3, 4}> {
            a = MatMul(x, w)
            y = Add(b, a)
            t = Tanh(y)
            z = If (s) <
                then_branch = one () => (float[2,2,3,2] v) <float[2] c = {1, 2}> {
                    p = MatMul(t, w)
                    v = Add(p, c)
                },
                else_branch = two () => (float[2,2,3,2] u) { u = Neg(t) }
            >
        }"""
    )
    session = probed_session(model, ["y"], Extremes(), threads=1, optimize=True)
    feeds = {"s": np.array(True), "x": np.ones((2, 2, 3, 2), np.float32)}
    readings = session.run(feeds, [READINGS])[READINGS].reshape(-1)
    np.testing.assert_array_equal(readings[:2], [5, 8])
