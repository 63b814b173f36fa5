"""Kernels in sessions: threads, bad inputs, and who else claims their names."""

import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx_ir as ir
import onnxruntime as ort
import pytest

from me2e_compress import graph
from me2e_compress.base.errors import FramesError, GraphError
from me2e_compress.base.listener import SILENT
from me2e_compress.commands.checks import try_first
from me2e_compress.commands.listing import doctor
from me2e_compress.operators import dialect_of, kernels
from me2e_compress.operators.deformable_attention import DeformableAttention
from me2e_compress.operators.kernels import custom_ops, trampoline
from me2e_compress.operators.kernels.custom_ops import load_or_compile
from me2e_compress.operators.kernels.kernel import CompiledKernel
from me2e_compress.runtime.frames import Frame
from me2e_compress.runtime.providers import CpuProvider
from me2e_compress.runtime.runnable import replace_fused
from me2e_compress.runtime.session import Session, open_graph
from tests.operators.kernels import needs_kernels
from tests.operators.running import graph_of
from tests.operators.test_deformable_attention import CALL, arrays_of

OPERATOR = DeformableAttention()
TENSORRT = dialect_of(OPERATOR, "tensorrt")
LARGE = {**CALL, "queries": 700, "sizes": [(9, 11), (5, 4)], "width": 20}
Arrays = dict[str, npt.NDArray[Any]]


def call(open_dims: bool = False) -> tuple[ir.Model, Arrays]:
    assert TENSORRT is not None
    arrays = arrays_of(TENSORRT, LARGE)
    return graph_of(TENSORRT, arrays, opset=17, open_dims=open_dims), arrays


def expected(arrays: Arrays) -> npt.NDArray[np.floating]:
    return OPERATOR.reference(list(arrays.values()), {})


@needs_kernels
def test_sessions_and_threads_answer_alike() -> None:
    model, arrays = call()
    first = Session(model, threads=1).run(arrays)["result"]
    sessions = [Session(model, threads=2) for _ in range(2)]

    with ThreadPoolExecutor(4) as pool:
        result = list(pool.map(lambda each: each.run(arrays)["result"], sessions * 4))

    assert all(np.array_equal(each, first) for each in result)


@needs_kernels
@pytest.mark.parametrize(
    ("name", "wrong", "message"),
    [
        ("attention_weights", lambda a: a[:, :-1], "the inputs do not fit each other"),
        ("spatial_shapes", lambda a: a + 1, "a level lies outside of value"),
        ("spatial_shapes", lambda a: a * 2**20, "a level lies outside of value"),
        ("level_start_index", lambda a: a - 1, "a number is negative"),
    ],
)
def test_inputs_that_do_not_fit_are_a_sentence(
    name: str, wrong: Callable[[Any], Any], message: str
) -> None:
    model, arrays = call(open_dims=True)
    session = Session(model, threads=1)

    with pytest.raises(FramesError, match=message):
        session.run({**arrays, name: wrong(arrays[name])})

    result = session.run(arrays)["result"]  # and it lives
    assert np.allclose(result, expected(arrays), atol=1e-4)


@needs_kernels
def test_places_that_are_no_numbers_are_outside() -> None:
    model, arrays = call()
    places = np.array(arrays["sampling_locations"])
    places[:, ::3], places[:, 1::3, ..., 0] = np.nan, np.inf

    result = Session(model, threads=1).run({**arrays, "sampling_locations": places})

    assert not result["result"][:, ::3].any()
    assert not result["result"][:, 1::3].any()


@needs_kernels
def test_a_plugin_of_the_default_domain_in_a_file(tmp_path: Path) -> None:
    autoware = dialect_of(OPERATOR, "autoware")
    assert autoware is not None
    arrays = arrays_of(autoware, LARGE)
    graph.save(graph_of(autoware, arrays, opset=13), tmp_path / "m.onnx")

    result = Session(tmp_path / "m.onnx", threads=1).run(arrays)["result"]

    rows = expected(arrays)
    assert np.allclose(result, rows.reshape(*rows.shape[:2], -1), atol=1e-4)


@needs_kernels
@pytest.mark.parametrize("kept", ["in memory", "in a file"])
def test_a_kernel_goes_before_a_body_of_the_own_form(kept: str, tmp_path: Path) -> None:
    arrays = arrays_of(OPERATOR.own, LARGE)
    model = graph_of(OPERATOR.own, arrays, opset=17)
    _claim(model, OPERATOR.own.op_type)
    graph.save(model, tmp_path / "m.onnx")

    session = Session(model if kept == "in memory" else tmp_path / "m.onnx", threads=1)

    result = session.run(arrays)["result"]
    assert np.allclose(result, expected(arrays), atol=1e-4)


def test_a_body_that_came_with_a_plugin_decides() -> None:
    model, arrays = call()
    _claim(model, model.graph[0].op_type)

    assert not Session(model, threads=1).run(arrays)["result"].any()


def _claim(model: ir.Model, name: str) -> None:
    """Give a graph a function of its node's name, which answers zeros."""
    domain = model.graph[0].domain
    body = ir.from_onnx_text(
        f"""
        <ir_version: 9, opset_import: ["" : 17]>
        g (float[N,S,M,D] v, int64[L,2] s, int64[L] t, float[N,Q,M,L,P,2] p,
           float[N,Q,M,L,P] w) => (float[N,Q,M,D] y)
        <int64[1] axes = {{-1}}, float[1] zero = {{0}},
         int64[4] shape = {{0,0,0,-1}}> {{
            r = ReduceSum<keepdims=0>(p, axes)
            a = Reshape(r, shape)
            b = ReduceSum<keepdims=1>(a, axes)
            o = Mul(b, zero)
            e = Concat<axis=-1>({", ".join("o" * LARGE["width"])})
            y = Identity(e)
        }}
        """
    )
    for value in list(body.graph.initializers.values()):
        constant = ir.node("Constant", [], {"value": value.const_value}, num_outputs=1)
        value.replace_all_uses_with(constant.outputs[0])
        body.graph.insert_before(body.graph[0], constant)
    function = ir.Function(domain, name, "", graph=body.graph, attributes=[])
    model.functions[function.identifier()] = function


@needs_kernels
def test_another_library_may_have_the_operator(monkeypatch: pytest.MonkeyPatch) -> None:
    model, arrays = call()
    node = model.graph[0]
    mine = kernels.KERNELS[0]
    theirs = CompiledKernel(node.op_type, mine.module, mine.inputs, ("theirs",) * 9)
    options = ort.SessionOptions()
    code = load_or_compile(mine, trampoline.default_folder())
    with monkeypatch.context() as patch:
        patch.setattr(custom_ops, "load_or_compile", lambda *_: code)
        patch.setattr(custom_ops, "DOMAIN", node.domain)
        custom_ops.register(options, [theirs])

    session, _ = open_graph(model, options)

    result = session.run(None, arrays)[0]
    assert np.allclose(np.asarray(result), expected(arrays), atol=1e-4)


def test_what_a_library_of_the_user_names_is_left_to_it(tmp_path: Path) -> None:
    model, _ = call()
    library = tmp_path / "ops.so"
    library.write_bytes(b"\x7fELF..." + model.graph[0].op_type.encode() + b"\0")
    theirs = CpuProvider(plugins=(library,)).claims

    left, needed = replace_fused(model, compiled=True, in_library=theirs)

    assert left is model
    assert not needed


@pytest.mark.parametrize(
    ("why", "message"),
    [
        ("numba", "numba is not installed: pip install 'me2e-compress[fast]'"),
        ("platform", "there are kernels on Linux only, not on darwin"),
        ("noexec", "neither the cache folder nor memory may hold code that runs: no"),
        pytest.param("unloaded", None, marks=needs_kernels),
    ],
)
def test_without_kernels_bodies_run_and_doctor_says_why(
    why: str, message: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuses(*_: object) -> None:
        raise (ImportError if why == "unloaded" else OSError)("no")

    if why == "numba":
        monkeypatch.setattr(trampoline, "find_spec", lambda name: None)
    elif why == "platform":
        monkeypatch.setattr(sys, "platform", "darwin")
    elif why == "unloaded":  # as numba beside a numpy that is too new
        monkeypatch.setattr(custom_ops, "load_or_compile", refuses)
    else:
        monkeypatch.setattr(trampoline, "trampoline", refuses)
    model, arrays = call()
    assert kernels.why_not() == message
    if message is not None:
        checkups = {each.what: each for each in doctor().checkups}
        assert checkups["compiled kernels"].found is None
        assert checkups["compiled kernels"].advice.endswith(message)

    result = Session(model, threads=1).run(arrays)["result"]

    assert np.allclose(result, expected(arrays), atol=1e-4)
    model.graph[0].attributes["levels"] = ir.AttrInt64("levels", 2)
    with pytest.raises(GraphError, match=r"node fused: .* no attribute 'levels'"):
        Session(model)


@needs_kernels
@pytest.mark.opens_apart
def test_a_graph_with_kernels_is_opened_apart_with_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    model, arrays = call()

    try_first(model, "call", [Frame(0, True, dict(arrays))], listener=SILENT)

    (verdict,) = (tmp_path / "me2e-compress" / "opened").iterdir()
    assert verdict.read_bytes() == b"ran"


def test_numba_is_imported_only_for_kernels(driver: ir.Model, tmp_path: Path) -> None:
    graph.save(driver, tmp_path / "m.onnx")
    script = (
        "import sys; from pathlib import Path\n"
        "from me2e_compress.runtime.session import Session\n"
        "Session(Path(sys.argv[1]))\n"
        "print(*sys.modules.keys() & {'numba', 'llvmlite'})\n"
    )

    done = subprocess.run(
        [sys.executable, "-c", script, str(tmp_path / "m.onnx")],
        capture_output=True, text=True, check=True,
    )  # fmt: skip

    assert done.stdout == "\n"
