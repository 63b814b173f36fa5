from dataclasses import dataclass
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from typing import ClassVar

import onnx_ir as ir
import pytest
from hypothesis import given
from hypothesis import strategies as st

from me2e_compress import recipe
from me2e_compress.errors import RecipeError
from me2e_compress.passes import PASSES, Context, Pass, PassResult


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
def known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PASSES, "sample", Sample)
    recipe.registry.cache_clear()


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
    ],
)
def test_text_becomes_a_pass(text: str, expected: Sample) -> None:
    assert recipe.parse(text) == (expected,)


def test_passes_are_parted_by_commas() -> None:
    text = "sample{drop=[a,b]}, sample,sample{limit=1}"
    assert recipe.parse(text) == (Sample(drop=("a", "b")), Sample(), Sample(limit=1))


@given(
    st.builds(
        Sample,
        drop=st.lists(st.text(st.characters(codec="ascii", categories=("L", "N")))).map(
            tuple
        ),
        limit=st.integers(-(2**40), 2**40),
        ratio=st.floats(allow_nan=False, allow_infinity=False),
        strict=st.booleans(),
        fill=st.text(st.characters(codec="ascii", categories=("L", "N", "Pd"))),
    )
)
def test_text_and_passes_are_the_same_thing(sample: Sample) -> None:
    PASSES["sample"] = Sample
    recipe.registry.cache_clear()
    assert recipe.parse(recipe.to_text((sample,))) == (sample,)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("smple", "no pass 'smple'; there are"),
        ("sample{limitt=3}", "sample has no option 'limitt'; it has drop, limit"),
        ("sample{limit=many}", "sample: limit: Input should be a valid integer"),
        ("sample{drop=[}", "sample: cannot read the options"),
        ("sample{limit=3", "not a pipeline from 'sample{limit=3'"),
        ("", "not a pipeline"),
        ("sample sample", "not a pipeline"),
    ],
)
def test_bad_text_names_the_culprit(text: str, message: str) -> None:
    with pytest.raises(RecipeError, match=message) as caught:
        recipe.parse(text)
    assert "\n" not in str(caught.value)


def test_a_file_and_a_text_say_the_same(tmp_path: Path) -> None:
    path = tmp_path / "r.toml"
    path.write_text('[[pass]]\nname = "sample"\ndrop = ["occ"]\n')
    assert recipe.load(path) == recipe.parse("sample{drop=[occ]}")


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


def test_a_third_party_pass_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(PASSES, "sample")
    entry = EntryPoint("sample", f"{__name__}:Sample", "me2e_compress.passes")
    monkeypatch.setattr(EntryPoint, "load", lambda _: Sample)
    monkeypatch.setattr(
        "importlib.metadata.entry_points", lambda group: EntryPoints([entry])
    )
    recipe.registry.cache_clear()
    assert recipe.parse("sample{limit=3}") == (Sample(limit=3),)


def test_a_third_party_pass_may_not_take_a_name(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    entry = EntryPoint("sample", f"{__name__}:Sample", "me2e_compress.passes")
    monkeypatch.setattr(EntryPoint, "load", lambda _: Sample)
    monkeypatch.setattr(
        "importlib.metadata.entry_points", lambda group: EntryPoints([entry])
    )
    recipe.registry.cache_clear()
    with pytest.raises(RecipeError, match="entry point sample"):
        recipe.parse("sample")


def test_a_file_that_a_recipe_names_lies_beside_the_recipe(tmp_path: Path) -> None:
    (tmp_path / "r.toml").write_text(
        '[[pass]]\nname = "sample"\nmeans = "sub/m.npz"\n'
        '[[pass]]\nname = "sample"\nmeans = "/m.npz"\n'
    )

    beside, absolute = recipe.load(tmp_path / "r.toml")

    assert beside == Sample(means=tmp_path / "sub" / "m.npz")
    assert absolute == Sample(means=Path("/m.npz"))
    assert recipe.parse("sample{means=m.npz}") == (Sample(means=Path("m.npz")),)
    assert recipe.to_text([beside]) == f'sample{{means="{tmp_path}/sub/m.npz"}}'
