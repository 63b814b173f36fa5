"""Traffic lights and signs: in metres, facing the traffic that must obey (-x)."""

from me2e_compress.simulator.cameras.template import (
    Box,
    Quad,
    Slot,
    Template,
    facing,
    shadow,
    template,
)

POLE_M = 0.06
HOUSING_M = (0.35, 1.3, 2.95)
"""Half width, lower and upper edge. Housing and lamps are half as large again as real
ones, so that the colour of a lamp is more than a pixel at 25 m, and hang low enough
that a car waiting at the stop line still has all three in an image."""
SIGN_CENTRE_M, SIGN_RADIUS_M = 2.2, 0.5
FOOT = (-0.2, 0.2)


def traffic_light() -> Template:
    """Return a pole with three lamps."""
    half, low, high = HOUSING_M
    housing = Box((-0.15, 0.15), (-half, half), (low, high), Slot.TRIM)
    lamps: list[Quad] = []
    slots = (Slot.LAMP_GREEN, Slot.LAMP_YELLOW, Slot.LAMP_RED)
    for slot, middle in zip(slots, (1 / 6, 1 / 2, 5 / 6), strict=True):
        lamps += housing.disc("back", (0.5, middle), (0.38, 0.148), slot)
    return template([*_pole(low), *housing.quads(lamps)], FOOT, (-half, half))


def stop_sign() -> Template:
    """Return an octagon, white rim, red, with a white bar for the word."""
    quads = _pole(SIGN_CENTRE_M)
    quads += _octagon(-0.08, SIGN_RADIUS_M, Slot.STRIPE, detail=False)
    quads += _octagon(-0.09, SIGN_RADIUS_M * 0.86, Slot.BODY, detail=True)
    half, low, high = SIGN_RADIUS_M * 0.62, SIGN_CENTRE_M - 0.09, SIGN_CENTRE_M + 0.09
    word = [(half, low), (-half, low), (-half, high), (half, high)]
    quads.append(facing(word, -0.1, Slot.STRIPE, detail=True))
    return template(quads, FOOT, (-SIGN_RADIUS_M, SIGN_RADIUS_M))


def give_way_sign() -> Template:
    """Return a triangle on its point, red rim and white."""
    quads = _pole(SIGN_CENTRE_M)
    for scale, x, slot, detail in (
        (1.0, -0.08, Slot.BODY, False),
        (0.58, -0.09, Slot.STRIPE, True),
    ):
        half, low = SIGN_RADIUS_M * 1.15 * scale, SIGN_CENTRE_M - 0.66 * scale
        high = SIGN_CENTRE_M + 0.33 * scale
        corners = [(0.0, low), (0.0, low), (-half, high), (half, high)]
        quads.append(facing(corners, x, slot, detail=detail))
        if not detail:
            back = quads[-1].corners[::-1]
            quads.append(Quad(back, Slot.TRIM, 1.0, False))
    return template(quads, FOOT, (-SIGN_RADIUS_M, SIGN_RADIUS_M))


def _pole(top_m: float) -> list[Quad]:
    pole = Box((-POLE_M, POLE_M), (-POLE_M, POLE_M), (0.0, top_m), Slot.TRIM)
    return [shadow(FOOT, FOOT), *pole.quads()]


def _octagon(x: float, radius: float, slot: Slot, *, detail: bool) -> list[Quad]:
    """Return three quadrilaterals, seen from behind too if they are no detail."""
    part = radius * 0.4142
    rows = (
        (-radius, part, -part, radius),
        (-part, radius, part, radius),
        (part, radius, radius, part),
    )
    quads = []
    for low, low_half, high, high_half in rows:
        z_low, z_high = SIGN_CENTRE_M + low, SIGN_CENTRE_M + high
        corners = [(low_half, z_low), (-low_half, z_low)]
        corners += [(-high_half, z_high), (high_half, z_high)]
        quads.append(facing(corners, x, slot, detail=detail))
        if not detail:
            quads.append(Quad(quads[-1].corners[::-1], Slot.TRIM, 1.0, False))
    return quads
