"""Which rows are run, and what their files are made of."""

import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest

from benchmarks.bench_runtime import Row, chosen, parser, table
from benchmarks.runtime_files import ENTRIES, REFERENCE, TORCH, made, static
from benchmarks.subject import Subject

COMPILED = "PyTorch, torch.compile"


def rows(*words: str) -> list[str]:
    return list(chosen(parser().parse_args(["out", *words])))


def test_torch_compile_runs_where_it_is_asked_for() -> None:
    assert rows() == [name for name in ENTRIES if name != COMPILED]
    assert rows("--with", "torch.compile") == list(ENTRIES)
    assert rows("--only", COMPILED) == [COMPILED, REFERENCE]


def test_constant_matrices_are_in_every_file_but_pytorchs() -> None:
    found = static(ENTRIES)

    assert list(found) == list(ENTRIES)
    for name, entry in found.items():
        before = ENTRIES[name]
        if before.engine in TORCH:
            assert entry == before
            continue
        assert entry.file == f"static-{before.file}"
        if entry.tool:
            assert entry.of == "static-source"
        else:
            assert "freeze-inputs,fold-constants" in entry.passes
    assert found[REFERENCE].passes == "import-normalize,freeze-inputs,fold-constants"
    assert found["ours, fused"].passes.endswith(ENTRIES["ours, fused"].passes[33:])


def test_the_files_of_other_tools_are_made_of_the_folded_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    subject, ran = Subject("vad-tiny", tmp_path), list[list[str]]()

    def noted(command: list[str], **_: object) -> object:
        ran.append(command)
        Path(
            command[command.index("-o") + 1] if "-o" in command else command[-1]
        ).touch()
        return SimpleNamespace(returncode=0, stderr="")

    monkeypatch.setattr(subprocess, "run", noted)

    assert made(subject, static(ENTRIES)["onnxsim + onnxruntime"], 1) is None

    folded, simplified = ran
    assert "import-normalize,freeze-inputs,fold-constants" in folded
    assert simplified[-2:] == [
        str(tmp_path / name) for name in ("static-source.onnx", "static-onnxsim.onnx")
    ]


def test_the_table_compares_with_the_first_row() -> None:
    ours = Row([1.0, 2.0], [0.5], 900.0, {"ego_fut_preds": 30.0, "bev": 20.0})
    eager = Row([10.0, 9.0], [5.0], 1700.0, {"ego_fut_preds": 99.0, "bev": 99.0})

    rows = {"PyTorch, eager": eager, "ours": ours}
    lines = table(rows, {"ours": 0.4}, "ego_fut_preds").splitlines()

    assert lines[-1].split(" | ")[1:4] == ["1.00", "1.50", "9.00"]
    assert lines[-1].endswith("20.0 | 30.0 | 40% |")
