"""The RPC table against what clients ask and expect."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

import pytest

from hmt_service.client.calls import Ask, Calls
from hmt_service.core.geometry import identity
from hmt_service.service.keys import Call, Control, Keys, Topic
from hmt_service.service.rpc import GENERAL, PARAMETERS, PUBLISHED, RPCS

KEYS = Keys("site", "robot")
PROTO = Path(__file__).parents[2] / "proto/hmt_service/service/v1/hmt.proto"
ARGUMENTS = {
    "area": 1,
    "area_a": 1,
    "area_b": 2,
    "a_from_b": identity(),
    "sigma_m": 0.1,
    "sigma_rad": 0.1,
    "probability": 0.5,
    "statement": 0,
    "name": "other.hmt",
}
ALL = [*Call, *Control]


def asked(name: Call | Control) -> Ask[object]:
    """Return the question of a client, with every argument that it must have."""
    method = getattr(Calls(KEYS), "shut_down" if name is Control.SHUTDOWN else name)
    needed = [
        parameter.name
        for parameter in inspect.signature(method).parameters.values()
        if parameter.default is parameter.empty
    ]
    question: Ask[object] = method(**{argument: ARGUMENTS[argument] for argument in needed})
    return question


def test_every_call_and_publication_is_in_the_table() -> None:
    assert [*RPCS] == ALL
    assert [*PUBLISHED] == [*Topic]


@pytest.mark.parametrize("name", ALL)
def test_clients_expect_the_answer_of_the_table(name: Call | Control) -> None:
    kind = asked(name).kind
    assert RPCS[name].answer == ("Events" if kind is tuple else kind.__name__)


@pytest.mark.parametrize("name", ALL)
def test_clients_ask_with_parameters_of_the_table(name: Call | Control) -> None:
    assert {*asked(name).parameters} <= {*RPCS[name].parameters}


def test_every_parameter_is_explained_and_used() -> None:
    used = {parameter for rpc in RPCS.values() for parameter in rpc.parameters}
    assert {*PARAMETERS} == {*GENERAL, *used}


def test_every_answer_is_a_message() -> None:
    messages = {*re.findall(r"^message (\w+)", PROTO.read_text(), re.MULTILINE)}
    assert {rpc.answer for rpc in RPCS.values()} | {*PUBLISHED.values()} <= messages
