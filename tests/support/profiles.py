"""Which examples the property tests draw, and how many: ``--hypothesis-profile``."""

from hypothesis import HealthCheck, settings

_USUAL = 100
"""Examples of a test that asks for no number."""


def register() -> None:
    """Make both profiles known; neither hangs on how busy the machine is.

    ``ci``, the default, draws the same examples every time, so that a change alone can
    break a test. ``night`` draws others each time, ten times as many.
    """
    settings.register_profile(
        "ci",
        settings.get_profile("default"),
        max_examples=_USUAL,
        derandomize=True,
        deadline=None,
        print_blob=True,
        suppress_health_check=(HealthCheck.too_slow,),
    )
    settings.register_profile(
        "night", settings.get_profile("ci"), max_examples=1000, derandomize=False
    )


def scaled(examples: int) -> int:
    """Return how many examples a test draws that are dear: so many under ``ci``."""
    return examples * settings().max_examples // _USUAL
