from __future__ import annotations

import pytest
import zenoh

from hmt_service.errors import InvalidInput
from hmt_service.service.keys import Call, Control, Input, Keys, Topic

KEYS = Keys("plant-1", "cart_2")


def test_keys_are_those_of_the_table() -> None:
    assert KEYS.input(Input.SCAN) == "hmt/plant-1/cart_2/in/scan"
    assert KEYS.topic(Topic.POSE) == "hmt/plant-1/cart_2/pose"
    assert KEYS.call(Call.MAP) == "hmt/plant-1/cart_2/ro/map"
    assert KEYS.control(Control.FINISH) == "hmt/plant-1/cart_2/@ctl/finish"
    assert KEYS.liveliness == "hmt/@live/plant-1/cart_2"


def test_expressions_cover_their_keys_and_no_others() -> None:
    calls, controls = zenoh.KeyExpr(KEYS.calls), zenoh.KeyExpr(KEYS.controls)
    assert all(calls.includes(KEYS.call(call)) for call in Call)
    assert all(controls.includes(KEYS.control(control)) for control in Control)
    assert all(zenoh.KeyExpr(KEYS.inputs).includes(KEYS.input(name)) for name in Input)
    assert not any(calls.intersects(KEYS.control(control)) for control in Control)


def test_no_wildcard_reaches_what_changes_state() -> None:
    everything = zenoh.KeyExpr("hmt/**")
    assert all(everything.includes(KEYS.call(call)) for call in Call)
    assert not any(everything.intersects(KEYS.control(control)) for control in Control)


@pytest.mark.parametrize("name", ["", "a/b", "*", "a b", "@ctl", "a?b", "a#b", "$*", "x" * 65])
def test_names_with_a_meaning_to_zenoh_are_refused(name: str) -> None:
    with pytest.raises(InvalidInput, match="robot"):
        Keys("site", name)
    with pytest.raises(InvalidInput, match="site"):
        Keys(name, "robot")
