"""The road under the car: friction of each wheel, bank and grade, read from a plan's road table."""

from numba.extending import register_jitable

from pdhef_logtool.records.signals import FloatArray
from truthsim.manoeuvres import ROAD_BANK, ROAD_FRICTION_LEFT, ROAD_FRICTION_RIGHT, ROAD_GRADE
from truthsim.vehicle import BANK, BANK_PER_M, FRICTION, GRADE, GRADE_PER_M


@register_jitable
def interpolated(table: FloatArray, place: float, column: int) -> float:
    """Interpolate a column at a place counted in rows; beyond the ends the outer rows apply."""
    last = table.shape[0] - 1
    if place <= 0.0:
        return float(table[0, column])
    if place >= last:
        return float(table[last, column])
    i = int(place)
    return float(table[i, column] + (place - i) * (table[i + 1, column] - table[i, column]))


@register_jitable
def read_road(
    table: FloatArray, step_m: float, at_m: float, front_m: float, rear_m: float, friction: float, road: FloatArray
) -> None:
    """Write the inputs of ``truthsim.vehicle`` from the road, [ROAD_SIZE].

    Parameters
    ----------
    table : [R, 4], friction left and right, bank and grade (rad) every ``step_m``; empty for a level road.
    at_m : distance of the CG along the table; ``front_m`` and ``rear_m`` are the distances of the axles from the CG, so
        that a change of friction affects each axle at its position.
    friction : friction of all wheels without a table.
    """
    if table.shape[0] == 0:
        for i in range(road.shape[0]):
            road[i] = 0.0
        for wheel in range(4):
            road[FRICTION + wheel] = friction
        return
    for axle in range(2):
        place = (at_m + (front_m if axle == 0 else -rear_m)) / step_m
        road[FRICTION + 2 * axle] = interpolated(table, place, ROAD_FRICTION_LEFT)
        road[FRICTION + 2 * axle + 1] = interpolated(table, place, ROAD_FRICTION_RIGHT)
    place = at_m / step_m
    road[BANK] = interpolated(table, place, ROAD_BANK)
    road[GRADE] = interpolated(table, place, ROAD_GRADE)
    # Over two rows, so that the slope of a table does not jump at each of them.
    road[BANK_PER_M] = (interpolated(table, place + 1.0, ROAD_BANK) - interpolated(table, place - 1.0, ROAD_BANK)) / (
        2.0 * step_m
    )
    road[GRADE_PER_M] = (
        interpolated(table, place + 1.0, ROAD_GRADE) - interpolated(table, place - 1.0, ROAD_GRADE)
    ) / (2.0 * step_m)
