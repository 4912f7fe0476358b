"""The tables of identified cars: driving like that of the fit apart."""

from __future__ import annotations

import math

from studies.identified_bands import Judged, bands_table


def test_driving_like_that_of_the_fit_stands_apart() -> None:
    rmse = math.radians(0.2)
    found = [
        Judged("road", "road", rmse, (1.0, 8.0), (1.0, 12.0)),
        Judged("road", "dlc", rmse, (0.5, 2.0), (0.92, 4.0)),
        Judged("sine-sweep-wide", "road", rmse, (0.7, 3.0), (0.96, 5.0)),
    ]
    lines = [line.strip("| ").split(" | ") for line in bands_table(found).splitlines()[2:]]
    assert [(line[0], line[1]) for line in lines[::2]] == [
        ("of the kind that it was identified on", "1"), ("of other kinds", "2"), ("all", "3"),
    ]  # fmt: skip
    assert {line[2] for line in lines} == {"0.200"}
    assert lines[2][3:5] == ["its own", "60%"] and lines[2][-1] == "2.50"
    assert lines[3][3:5] == ["with the posterior", "94%"] and lines[3][-2:] == ["100%", "4.50"]
