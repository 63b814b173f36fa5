from pathlib import Path

import onnx_ir as ir

from me2e_compress.manager import reproducer
from tests.conftest import DRIVER


def test_a_folder_of_the_user_is_left_alone(tmp_path: Path) -> None:
    theirs = tmp_path / "reproducer-fold-constants"
    theirs.mkdir()
    (theirs / "model.onnx").write_text("theirs")
    model = ir.from_onnx_text(DRIVER)

    made = [
        reproducer.write(tmp_path, model, "fold-constants", 0, "broke").name
        for _ in range(2)
    ]

    assert made == ["reproducer-fold-constants-2"] * 2
    assert (theirs / "model.onnx").read_text() == "theirs"
    assert len(list(tmp_path.iterdir())) == 2
