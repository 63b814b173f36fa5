import math
from collections.abc import Mapping, Sequence

from me2e_compress.fidelity.compare import Fidelity, OutputFidelity
from me2e_compress.fidelity.floor import Floor
from me2e_compress.quantization.plan.overrides import Overrides
from me2e_compress.sensitivity.remedy import Int8Node, Measure, Remedy, RemedySearch

NODES = [
    Int8Node(f"/m{at // 16}/n{at}[x]", "MatMul", f"m{at // 16}") for at in range(64)
]


def made(noise: Mapping[int, float]) -> Measure:
    """Independent errors: the noise of each node, squares added; signal 1."""

    def measure(floats: Sequence[Int8Node]) -> Fidelity:
        power = 1e-9 + sum(
            noise.get(at, 0.0) ** 2
            for at, node in enumerate(NODES)
            if node not in floats
        )
        sqnr = -10 * math.log10(power)
        return Fidelity((OutputFidelity("bev", sqnr, 0.0),), (), None, "", 1)

    return measure


def search(noise: Mapping[int, float], most: int = 14) -> Remedy:
    measure = made(noise)
    search = RemedySearch(NODES, measure, Floor(20.0), most_trials=most)
    return search.run(measure([]))


def test_one_node_among_many_is_found_in_a_trial_a_halving() -> None:
    remedy = search({37: 0.9, 3: 0.02})

    assert remedy.nodes == (NODES[37],)
    assert not remedy.modules
    assert remedy.cures
    assert remedy.trials == 6 + 1


def test_two_nodes_are_found_one_after_the_other() -> None:
    remedy = search({37: 0.9, 3: 0.5})

    assert remedy.nodes == (NODES[37], NODES[3])
    assert remedy.cures
    assert remedy.trials == 14


def test_noise_that_is_spread_over_a_module_is_cured_by_the_module() -> None:
    remedy = search({at: 0.1 for at in range(16, 32)})

    assert remedy.modules == ("m1",)
    assert not remedy.nodes
    assert remedy.cures


def test_noise_that_is_everywhere_is_never_cured_by_giving_up_int8() -> None:
    remedy = search({at: 0.5 for at in range(64)}, most=40)

    assert len(remedy.modules) < 4
    assert not remedy.cures


def test_the_number_of_trials_is_kept() -> None:
    remedy = search({at: 0.5 for at in range(64)}, most=5)

    assert remedy.trials <= 5
    assert not remedy.cures


def test_what_was_found_is_an_override_that_names_the_node_and_no_other() -> None:
    text = search({37: 0.9}).overrides()

    (override,) = Overrides.parse(text).override
    assert override.dtype == "float"
    assert override.nodes == "/m2/n37[[]x]"
