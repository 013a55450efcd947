from __future__ import annotations

from dataclasses import replace

import numpy as np

from hmt_service.client.calls import Calls
from hmt_service.core.geometry import certain, identity
from hmt_service.core.types import NO_POINTS, GlobalMap, MapMethod, PlacedArea
from hmt_service.service.keys import Keys

CALLS = Calls(Keys("plant", "cart"))


def placed(area: int, points: int, version: int) -> PlacedArea:
    cloud = np.full((points, 3), area, dtype=np.float32)
    return PlacedArea(area, certain(identity()), 5, 1, cloud, version)


def whole(*areas: PlacedArea) -> GlobalMap:
    return GlobalMap(MapMethod.CONSISTENT, 0, 0, 1.0, 7, areas, ())


def test_a_question_names_what_is_asked_and_leaves_out_what_is_not() -> None:
    ask = CALLS.map(MapMethod.SHORTEST_PATH, hypothesis=3, with_points=False)
    selector = ask.selector({"deadline": "10"})
    assert selector == (
        "hmt/plant/cart/ro/map?method=shortest_path;hypothesis=3;points=0;deadline=10"
    )


def test_what_is_known_is_told_in_the_question_and_put_into_the_answer() -> None:
    known = whole(placed(0, 4, 11), placed(1, 5, 12), placed(2, 6, 13))
    ask = CALLS.map(known=known)
    assert "known=0:11,1:12,2:13" in ask.selector({})
    # The second has changed, the third is no longer there, and the fourth is new.
    unchanged = replace(placed(0, 0, 11), points_in_area=NO_POINTS)
    answer = ask.complete(whole(unchanged, placed(1, 7, 99), placed(3, 2, 14)))
    assert [len(area.points_in_area) for area in answer.areas] == [4, 7, 2]


def test_an_area_that_saw_nothing_is_not_taken_for_one_that_is_known() -> None:
    ask = CALLS.area(4, known=placed(4, 3, 21))
    assert "known=4:21" in ask.selector({})
    answer = CALLS.map(known=whole(placed(4, 3, 21))).complete(whole(placed(4, 0, 22)))
    assert len(answer.areas[0].points_in_area) == 0


def test_a_map_without_versions_is_not_told() -> None:
    assert "known" not in CALLS.map(known=whole(placed(0, 4, 0))).selector({})
