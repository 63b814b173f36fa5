"""People, bicycles and what is put on a road."""

from me2e_compress.simulator.cameras.template import (
    FULL,
    Box,
    Slot,
    Template,
    plate,
    shadow,
    template,
)


def pedestrian() -> Template:
    """Return a pedestrian: legs, torso, head."""
    legs = Box((-0.2, 0.2), (-0.3, 0.3), (0.0, 0.48), Slot.LEGS)
    torso = Box((-0.28, 0.28), (-0.42, 0.42), (0.46, 0.84), Slot.BODY)
    head = Box((-0.18, 0.18), (-0.18, 0.18), (0.86, 1.0), Slot.SKIN)
    return template(
        [shadow((-0.4, 0.4), (-0.4, 0.4)), *legs.quads(), *torso.quads(), *head.quads()]
    )


def bicycle() -> Template:
    """Return a bicycle and its rider."""
    quads = [shadow((-0.5, 0.5), (-0.3, 0.3))]
    for x in (-0.32, 0.32):
        for half, low, high in ((0.18, 0.12, 0.36), (0.09, 0.0, 0.48)):
            corners = [(x - half, 0.0, low), (x + half, 0.0, low)]
            corners += [(x + half, 0.0, high), (x - half, 0.0, high)]
            quads += plate(corners, Slot.TYRE)
    frame = Box((-0.3, 0.3), (-0.06, 0.06), (0.25, 0.45), Slot.STRIPE)
    legs = Box((-0.14, 0.1), (-0.25, 0.25), (0.2, 0.52), Slot.LEGS)
    torso = Box(
        (-0.2, 0.08), (-0.38, 0.38), (0.5, 0.83), Slot.BODY, (-0.08, 0.18), (-0.4, 0.4)
    )
    head = Box((0.0, 0.16), (-0.18, 0.18), (0.84, 1.0), Slot.SKIN)
    lamp = frame.on("back", (0.0, 1.0), (0.4, 1.0), Slot.TAIL_LAMP)
    for box, decals in ((frame, [lamp]), (legs, []), (torso, []), (head, [])):
        quads += box.quads(decals)
    return template(quads)


def cone() -> Template:
    """Return a traffic cone with two white bands."""
    base = Box(FULL, FULL, (0.0, 0.05), Slot.TRIM)
    narrow = (-0.08, 0.08)
    cone = Box((-0.36, 0.36), (-0.36, 0.36), (0.05, 1.0), Slot.BODY, narrow, narrow)
    bands = [
        cone.on(face, (0.0, 1.0), v, Slot.STRIPE)
        for face in ("front", "back", "left", "right")
        for v in ((0.3, 0.48), (0.64, 0.8))
    ]
    return template([*base.quads(), *cone.quads(bands)])


def barrier() -> Template:
    """Return a board with stripes, across its heading."""
    foot = Box((-0.5, 0.5), (-0.45, 0.45), (0.0, 0.08), Slot.TRIM)
    board = Box((-0.2, 0.2), FULL, (0.08, 1.0), Slot.BODY)
    bands = [
        board.on(face, (at, at + 0.125), (0.0, 1.0), Slot.STRIPE)
        for face in ("front", "back")
        for at in (0.125, 0.375, 0.625, 0.875)
    ]
    return template([shadow(FULL, FULL), *foot.quads(), *board.quads(bands)])


def door() -> Template:
    """Return an open car door, across the car."""
    panel = Box(FULL, FULL, (0.2, 1.0), Slot.BODY)
    panes = [
        panel.on(face, (0.08, 0.92), (0.55, 0.94), Slot.GLASS)
        for face in ("front", "back")
    ]
    return template([shadow(FULL, FULL), *panel.quads(panes)])
