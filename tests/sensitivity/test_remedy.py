import math
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase

from me2e_compress.fidelity.compare import Fidelity, OutputFidelity
from me2e_compress.fidelity.floor import Floor
from me2e_compress.quantization.plan.overrides import Override, Overrides
from me2e_compress.sensitivity.estimate import NodeCost
from me2e_compress.sensitivity.remedy import MOST_TRIALS, Remedy, RemedySearch

NAMES = [f"/m{at // 16}/n{at}[x]" for at in range(64)]


def module_of(name: str) -> str:
    return name.split("/")[1]


def fidelity(noise: Mapping[int, float], overrides: Sequence[Override]) -> Fidelity:
    """Independent errors: the noise of each node, squares added; signal 1."""

    def is_float(name: str) -> bool:
        return any(
            fnmatchcase(name, each.nodes or "*")
            and each.module in (None, "", module_of(name))
            for each in overrides
        )

    left = [own**2 for at, own in noise.items() if not is_float(NAMES[at])]
    sqnr = -10 * math.log10(1e-9 + sum(left))
    return Fidelity((OutputFidelity("bev", sqnr, 0.0),), (), None, "", 1)


def search(
    noise: Mapping[int, float], told: Mapping[int, float | None] | None = None
) -> Remedy:
    """Search with the true noise as the estimate, or with what is told."""
    costs = [
        NodeCost(name, name, "MatMul", module_of(name), noisy)
        for at, name in enumerate(NAMES)
        for own in [(noise if told is None else told).get(at, 0.0)]
        for noisy in [None if own is None else {"bev": own}]
    ]
    looks = RemedySearch(
        costs, ["bev"], lambda more: fidelity(noise, more), Floor(20.0)
    )
    return looks.run(fidelity(noise, ()))


def named(remedy: Remedy) -> list[int]:
    return [NAMES.index(each.name) for each in remedy.nodes]


def test_one_node_among_many_is_confirmed_by_one_variant() -> None:
    remedy = search({37: 0.9, 3: 0.02})

    assert named(remedy) == [37]
    assert not remedy.modules
    assert not remedy.shortfalls
    assert remedy.trials == 1


def test_as_many_nodes_are_float_as_explain_the_noise_and_no_more() -> None:
    remedy = search({37: 0.9, 3: 0.5, 5: 0.04, 9: 0.03})

    assert named(remedy) == [37, 3]
    assert not remedy.shortfalls
    assert remedy.trials == 1


def test_noise_that_is_spread_over_a_module_is_cured_by_the_module() -> None:
    remedy = search({at: 0.1 for at in range(16, 32)})

    assert remedy.modules == ("m1",)
    assert not remedy.nodes
    assert not remedy.shortfalls


def test_noise_that_is_everywhere_is_never_cured_by_giving_up_int8() -> None:
    remedy = search({at: 0.5 for at in range(64)})

    assert not remedy.modules
    assert not remedy.nodes
    assert remedy.shortfalls
    assert remedy.trials == 0


def test_most_of_the_graph_is_never_kept_float() -> None:
    spread = {at: 0.2 for at in range(48)}

    remedy = search(spread)

    assert not remedy.modules
    assert remedy.trials == 0


def test_an_estimate_that_is_too_low_is_mended_by_what_a_variant_shows() -> None:
    remedy = search({37: 0.9, 3: 0.5}, told={37: 0.9, 3: 0.05})

    assert named(remedy) == [37, 3]
    assert not remedy.shortfalls
    assert remedy.trials == 2


def test_an_estimate_that_is_wrong_ends_after_few_variants() -> None:
    told = {at: 0.9 - at / 100 for at in range(64) if at != 37}
    remedy = search({37: 0.9, 3: 0.02}, told)

    assert remedy.trials <= MOST_TRIALS
    assert remedy.shortfalls


def test_what_no_estimate_explains_is_shared_by_the_nodes_without_one() -> None:
    told = {at: None for at in range(48, 64)} | {3: 0.02}
    remedy = search({50: 0.6, 60: 0.6, 3: 0.02}, told)

    assert remedy.modules == ("m3",)
    assert not remedy.nodes
    assert not remedy.shortfalls


def test_what_was_found_is_an_override_that_names_the_node_and_no_other() -> None:
    text = search({37: 0.9}).overrides()

    (override,) = Overrides.parse(text).override
    assert override.dtype == "float"
    assert override.nodes == "/m2/n37[[]x]"
