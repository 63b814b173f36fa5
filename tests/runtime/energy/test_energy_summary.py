"""What the windows of one model come to, by hand."""

import pytest

from me2e_compress.runtime.energy.energy_result import CountedBy, summarise
from me2e_compress.runtime.energy.estimate import Window
from me2e_compress.runtime.energy.reader import DeviceState

BY = CountedBy("nvml-total", "a GPU", "board", 0.1)


def windows(paused_s: float) -> list[Window]:
    """Five windows of 10 s, 20 frames and 200 J."""
    return [Window(10.0 * at, 10.0 * at + 10.0, 20, 200.0, paused_s) for at in range(5)]


def test_sums_and_means() -> None:
    found = summarise(windows(0.0), BY, None)

    assert (found.joules, found.frames, found.windows) == (1000.0, 100, 5)
    assert found.j_per_frame == pytest.approx(10.0)
    assert found.window_s == 10.0
    assert found.window_j_per_frame == (10.0,) * 5
    assert found.net_j_per_frame is None


@pytest.mark.parametrize(
    ("paused_s", "gross", "net"),
    [
        (0.0, 10.0, 10.0 - 6.0 * 10 / 20),
        # 2 s at 6 W (at most 20 W) are paused: (200 - 2 x 13) J are left of 8 s of work
        (2.0, (200 - 2 * 13) / 20, (200 - 2 * 13) / 20 - 6.0 * 8 / 20),
    ],
)
def test_an_idle_device_is_taken_off_where_frames_ran(
    paused_s: float, gross: float, net: float
) -> None:
    found = summarise(windows(paused_s), BY, 6.0)

    assert found.j_per_frame == pytest.approx(gross)
    assert found.net_j_per_frame == pytest.approx(net)


def test_the_first_and_the_last_temperature_are_kept_where_the_device_tells() -> None:
    states = [
        DeviceState(None, {}),
        DeviceState(50.0, {}, ("power cap",)),
        DeviceState(60.0, {}, ("power cap", "heat")),
        DeviceState(55.0, {}),
    ]

    found = summarise(windows(0.0), BY, None, states=states)

    assert found.temperature == (50.0, 55.0)
    assert found.throttled == ("power cap", "heat")
