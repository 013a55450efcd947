from __future__ import annotations

import pytest

from hmt_service.client import HmtClient
from hmt_service.client.local import free_endpoint
from hmt_service.errors import Unavailable
from hmt_service.service.keys import Input
from hmt_service.service.session import Endpoints, Mode, open_session


def test_a_client_without_daemon_says_where_it_looked() -> None:
    endpoint = free_endpoint()
    with pytest.raises(Unavailable, match=endpoint):
        open_session(Endpoints(mode=Mode.CLIENT, connect=(endpoint,), timeout_s=0.2))


def test_a_taken_endpoint_is_named() -> None:
    endpoint = free_endpoint()
    endpoints = Endpoints(mode=Mode.PEER, listen=(endpoint,))
    with open_session(endpoints), pytest.raises(Unavailable, match=endpoint):
        open_session(endpoints)


def test_a_malformed_endpoint_is_named() -> None:
    with pytest.raises(Unavailable, match="nonsense"):
        open_session(Endpoints(mode=Mode.PEER, listen=("nonsense",)))


def test_a_client_whose_peer_is_no_daemon_says_which_key_nobody_answers() -> None:
    endpoint = free_endpoint()
    with (
        open_session(Endpoints(mode=Mode.PEER, listen=(endpoint,))),
        HmtClient(endpoint, site="plant", robot="cart", timeout_s=0.5) as client,
    ):
        with pytest.raises(Unavailable, match="hmt/plant/cart/ro/status") as error:
            client.status()
        assert endpoint in str(error.value)
        with pytest.raises(Unavailable, match="hmt/plant/cart/in/scan"):
            client.publish_raw(Input.SCAN, b"", "")
