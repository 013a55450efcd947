from __future__ import annotations

import math

import numpy as np
import pytest

from hmt_service.errors import InvalidInput
from hmt_service.sim.worlds.families import RECIPES, Family, Parameter, draw
from tests.sim.worlds import beams

CHOICES = [(family, parameter) for family in Family for parameter in RECIPES[family].parameters]


def test_families_are_found_by_name() -> None:
    assert [Family.of(family.value) for family in Family] == list(Family)
    assert Family.of("nested-loops") is Family.NESTED_LOOPS


def test_unknown_name_is_refused_with_all_names() -> None:
    with pytest.raises(InvalidInput, match=r"'maze'.*office, aliased, nested-loops, campus"):
        Family.of("maze")


def test_every_family_has_a_recipe() -> None:
    assert set(RECIPES) == set(Family)
    for recipe in RECIPES.values():
        assert recipe.description.endswith(".")
        assert 0.0 < recipe.route_m[0] < recipe.route_m[1]


@pytest.mark.parametrize("choice", CHOICES)
def test_parameter_left_out_takes_its_default(choice: tuple[Family, Parameter]) -> None:
    family, parameter = choice
    assert parameter.description.endswith(".")
    chosen = draw(family, 3, **{parameter.name: parameter.default})
    assert chosen.vertices.tobytes() == draw(family, 3).vertices.tobytes()
    assert chosen.route_m.tobytes() == draw(family, 3).route_m.tobytes()


@pytest.mark.parametrize("choice", CHOICES)
def test_parameter_out_of_range_is_refused_with_its_range(choice: tuple[Family, Parameter]) -> None:
    family, parameter = choice
    for value in (parameter.low - 1, parameter.high + 1, math.nan, math.inf):
        expected = f"{parameter.name} is {value!r}, not .*{parameter.low:g} to {parameter.high:g}"
        with pytest.raises(InvalidInput, match=expected):
            draw(family, 0, **{parameter.name: value})


def test_fraction_is_refused_where_only_whole_numbers_will_do() -> None:
    with pytest.raises(InvalidInput, match=r"floors is 2\.5.*whole number 2 to 6, default 3"):
        draw(Family.GARAGE, 0, floors=2.5)


def test_whole_number_may_come_as_a_float() -> None:
    assert len(draw(Family.LONG, 0, areas=5.0).route_m) == len(
        draw(Family.LONG, 0, areas=5).route_m
    )


def test_unknown_parameter_is_refused_with_those_of_the_family() -> None:
    with pytest.raises(
        InvalidInput, match=r"aliased has no parameter laps; it has severity \(0 to"
    ):
        draw(Family.ALIASED, 0, laps=2)
    with pytest.raises(InvalidInput, match=r"warehouse has no parameter laps; it has none"):
        draw(Family.WAREHOUSE, 0, laps=2)


def test_negative_seed_is_refused() -> None:
    with pytest.raises(InvalidInput, match="seed -1"):
        draw(Family.OFFICE, -1)


def test_name_tells_family_and_seed() -> None:
    assert [draw(family, 7).name for family in Family] == [f"{family}-7" for family in Family]


@pytest.mark.parametrize("family", [Family.OFFICE, Family.NESTED_LOOPS])
def test_laps_repeat_the_loop_of_the_route(family: Family) -> None:
    once, twice, thrice = (draw(family, 2, laps=laps) for laps in (1, 2, 3))
    lap = beams.length_m(twice) - beams.length_m(once)
    assert lap > 100.0
    assert beams.length_m(thrice) - beams.length_m(once) == pytest.approx(2.0 * lap)
    assert np.array_equal(thrice.vertices, once.vertices)
    # All laps begin like the route and the last ends like it.
    added = len(twice.route_m) - len(once.route_m)
    assert np.array_equal(twice.route_m[:added], once.route_m[:added])
    assert np.array_equal(twice.route_m[added:], once.route_m)
