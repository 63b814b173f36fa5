from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import onnx_ir as ir
import pytest

from me2e_compress.errors import RecipeError
from me2e_compress.manager import recipe
from me2e_compress.passes import Context, Pass, PassResult
from tests.installed import install


@dataclass(frozen=True)
class Sample(Pass):
    """Does nothing.

    Given:   x
    Result:  x
    """

    name: ClassVar[str] = "sample"
    exact: ClassVar[bool] = True
    drop: tuple[str, ...] = ()
    limit: int = 512
    ratio: float = 0.5
    strict: bool = False
    fill: str = "zeros"
    means: Path | None = None

    def run(self, model: ir.Model, context: Context) -> PassResult:
        return PassResult(model, 0)


@pytest.fixture(autouse=True)
def known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    entry = {"sample": f"{__name__}:Sample"}
    install(monkeypatch, tmp_path, "a-package", "me2e_compress.passes", entry)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("sample", Sample()),
        ("sample{}", Sample()),
        ("sample{drop=[occ]}", Sample(drop=("occ",))),
        ('sample{drop=["occ", "map"]}', Sample(drop=("occ", "map"))),
        ("sample{limit=3, strict=true}", Sample(limit=3, strict=True)),
        ("sample{ratio=1e-3,fill=a-b}", Sample(ratio=1e-3, fill="a-b")),
        ("sample{fill=recipes/x.json}", Sample(fill="recipes/x.json")),
        ('sample{fill="zeros, or so"}', Sample(fill="zeros, or so")),
    ],
)
def test_text_becomes_a_pass_and_is_written_as_it_is_read(
    text: str, expected: Sample
) -> None:
    assert recipe.parse(text) == (expected,)
    assert recipe.parse(f"{text}, sample,{text}") == (expected, Sample(), expected)
    assert recipe.parse(recipe.to_text([expected, Sample()])) == (expected, Sample())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("smple", "no pass 'smple'; there are"),
        ("sample{limitt=3}", "sample has no option 'limitt'; it has drop, limit"),
        ("sample{limit=many}", "sample: limit: Input should be a valid integer"),
        ("sample{drop=[}", "pass: cannot read .* from '}' on: a value is expected"),
        ("sample{limit=3", "pass: cannot read .* to the end: a comma or }"),
        ("", "pass: cannot read '' to the end: a name is expected"),
        ("sample sample", "from 'sample' on: a comma or the end is expected"),
    ],
)
def test_bad_text_names_the_culprit(text: str, message: str) -> None:
    with pytest.raises(RecipeError, match=message) as caught:
        recipe.parse(text)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "has no .*pass"),
        ("[[pass]]\nname = 3 4\n", "is not TOML"),
        ('pass = ["exact"]\n', "has no .*pass"),
        ("pass = 1\n", "has no .*pass"),
        ('[[pass]]\nname = "nobody"\n', "no pass 'nobody'"),
        ('[[pass]]\ndrop = ["occ"]\n', "no pass ''"),
    ],
)
def test_a_bad_file_names_the_culprit(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "r.toml"
    path.write_text(text)
    with pytest.raises(RecipeError, match=message):
        recipe.load(path)


def test_an_unknown_recipe_lists_the_shipped_ones() -> None:
    with pytest.raises(RecipeError, match=r"no recipe none: .*exact, feature-ext, "):
        recipe.load("none")


@pytest.mark.parametrize("name", recipe.shipped())
def test_every_shipped_recipe_builds(name: str) -> None:
    assert recipe.load(name)


def test_a_file_that_a_recipe_names_lies_beside_the_recipe(tmp_path: Path) -> None:
    (tmp_path / "r.toml").write_text(
        '[[pass]]\nname = "sample"\nmeans = "sub/m.npz"\n'
        '[[pass]]\nname = "sample"\ndrop = ["occ"]\nmeans = "/m.npz"\n'
    )

    beside, absolute = recipe.load(tmp_path / "r.toml")

    assert beside == Sample(means=tmp_path / "sub" / "m.npz")
    assert absolute == Sample(("occ",), means=Path("/m.npz"))
    assert recipe.parse("sample{means=m.npz}") == (Sample(means=Path("m.npz")),)
    assert recipe.to_text([beside]) == f'sample{{means="{tmp_path}/sub/m.npz"}}'
