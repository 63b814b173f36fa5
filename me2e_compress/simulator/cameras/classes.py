"""Classes of pixels in the label rasters."""

from enum import IntEnum

from me2e_compress.simulator.scene import ActorKind


class PixelClass(IntEnum):
    """Values of the uint8 class rasters, of a camera and of the bird's-eye view."""

    SKY = 0
    TERRAIN = 1
    SHOULDER = 2
    """Paved but no lane."""
    DRIVABLE = 3
    LANE_MARKING = 4
    STOP_LINE = 5
    CROSSWALK = 6
    """The white bars."""
    VEHICLE = 7
    BICYCLE = 8
    PEDESTRIAN = 9
    STATIC = 10
    """Cones, barriers."""
    TRAFFIC_LIGHT = 11
    TRAFFIC_SIGN = 12
    EGO = 13
    """Only in the bird's-eye view."""


ACTOR_CLASSES = {
    ActorKind.CAR: PixelClass.VEHICLE,
    ActorKind.VAN: PixelClass.VEHICLE,
    ActorKind.TRUCK: PixelClass.VEHICLE,
    ActorKind.EMERGENCY: PixelClass.VEHICLE,
    ActorKind.PARKED: PixelClass.VEHICLE,
    ActorKind.DOOR: PixelClass.VEHICLE,
    ActorKind.BICYCLE: PixelClass.BICYCLE,
    ActorKind.PEDESTRIAN: PixelClass.PEDESTRIAN,
    ActorKind.CONE: PixelClass.STATIC,
    ActorKind.BARRIER: PixelClass.STATIC,
}
"""The class of an actor's pixels."""
