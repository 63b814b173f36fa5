from typing import Any

import numpy as np

from benchmarks.bench_int8_shapes import FORMS, Convolution, product, resnet, session


def test_layers_run_in_every_form_with_their_own_macs() -> None:
    layer = Convolution("strided", 2, 6, 4, 8, 16, kernel=3, stride=2)
    pixels = np.ones((2, 6, 4, 8), np.uint8)

    ran = session(layer.text(), (16, 8, 3, 3), 0).run(None, {"x": pixels})
    found: Any = ran[0]

    assert found.shape == (2, 3, 2, 16)
    assert layer.macs == found.size * 8 * 9
    for form in FORMS:
        rows = np.ones((5, 8), np.uint8)
        answer: Any = product(form, 5, (8, 16)).run(None, {"x": rows})[0]
        assert answer.shape == (5, 16)


def test_names_are_unique() -> None:
    names = [each.name for each in resnet()]

    assert len(set(names)) == len(names) == 21
