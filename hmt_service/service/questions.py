"""One call of a client: which one it is, its parameters, and exactly one answer.

References:
    own.
"""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Callable, Mapping
from enum import StrEnum
from typing import Generic, TypeVar

import zenoh

from hmt_service.errors import DaemonFailure, HmtError, InvalidInput, NotFound
from hmt_service.runtime.messages import Part, Wire
from hmt_service.service.codec import Value, encode, encode_place

_INTEGER = re.compile(r"[0-9]{1,18}")
_NUMBER = re.compile(r"-?[0-9]{1,18}(\.[0-9]{1,18})?(e[+-]?[0-9]{1,3})?", re.IGNORECASE)
DEADLINE, PART_BYTES = "deadline", "part_bytes"
"""Parameters of every call: s after which nobody waits for the answer any more, and the size of
the largest part that it may come in."""
_MOST_DEADLINE_S = 600.0
_MOST_CHARACTERS = 1_000_000
"""Length of all parameters: `known` of 50,000 areas."""
_LEAST_PART_BYTES, _MOST_PART_BYTES = 16_384, 1_048_576
_LOG = logging.getLogger(__name__)

Name = TypeVar("Name", bound=StrEnum)
Choice = TypeVar("Choice", bound=StrEnum)


class Question(Generic[Name]):
    """A query that waits for its answer, here or in another thread."""

    def __init__(self, query: zenoh.Query, keys: Mapping[Name, str]) -> None:
        """Read a query.

        Args:
            query: What Zenoh has received.
            keys: The key of every call that could be meant.

        Raises:
            NotFound: If it is none of them.
            InvalidInput: If a wildcard makes it several of them, or its parameters are malformed.
        """
        self._query = query
        meant = [name for name, key in keys.items() if query.key_expr.intersects(key)]
        if not meant:
            raise NotFound(f"no call {query.key_expr}: there are {', '.join(keys)}")
        if len(meant) > 1:
            raise InvalidInput(f"{query.key_expr} is several calls at once: {', '.join(meant)}")
        self.name = meant[0]
        self._key = keys[self.name]
        text = str(query.parameters)
        if len(text) > _MOST_CHARACTERS:
            raise InvalidInput(f"{len(text)} characters of parameters, {_MOST_CHARACTERS} at most")
        pairs = [pair.partition("=") for pair in text.split(";") if pair]
        # Names that begin with "_" belong to Zenoh.
        self._parameters = {name: text for name, _, text in pairs if not name.startswith("_")}

    def allow(self, *names: str) -> None:
        """Check that there are no parameters but these.

        Raises:
            InvalidInput: If there are.
        """
        known = (*names, DEADLINE, PART_BYTES)
        unknown = sorted(self._parameters.keys() - set(known))
        if unknown:
            raise InvalidInput(
                f"unknown parameters of {self.name}: {', '.join(unknown)}; "
                f"there are {', '.join(known)}"
            )

    def integer(self, name: str) -> int | None:
        """Return a parameter that is an integer >= 0, or None without it.

        Raises:
            InvalidInput: If it is none.
        """
        text = self._parameters.get(name)
        if text is None:
            return None
        if not _INTEGER.fullmatch(text):
            raise InvalidInput(f"{name}={text[:40]!r} is not an integer of 1 to 18 digits")
        return int(text)

    def needed_integer(self, name: str) -> int:
        """Return a parameter that is an integer >= 0.

        Raises:
            InvalidInput: If it is none, or missing.
        """
        number = self.integer(name)
        if number is None:
            raise InvalidInput(f"{self.name} needs {name}=IDENTIFIER")
        return number

    def needed_number(self, name: str) -> float:
        """Return a parameter that is a finite number.

        Raises:
            InvalidInput: If it is none, or missing.
        """
        number = self.number(name)
        if number is None:
            raise InvalidInput(f"{self.name} needs {name}=NUMBER")
        return number

    def number(self, name: str) -> float | None:
        """Return a parameter that is a finite number, or None without it.

        Raises:
            InvalidInput: If it is none.
        """
        text = self._parameters.get(name)
        if text is None:
            return None
        number = float(text) if _NUMBER.fullmatch(text) else math.nan
        if not math.isfinite(number):
            raise InvalidInput(f"{name}={text[:40]!r} is not a number")
        return number

    def versions(self, name: str) -> Mapping[int, int]:
        """Return a parameter that is a list `area:version,...`; nothing without it.

        Raises:
            InvalidInput: If it is none.
        """
        result = {}
        for pair in filter(None, self._parameters.get(name, "").split(",")):
            area, _, version = pair.partition(":")
            if not _INTEGER.fullmatch(area) or not _INTEGER.fullmatch(version):
                raise InvalidInput(f"{name} holds {pair[:40]!r}, which is not area:version")
            result[int(area)] = int(version)
        return result

    def deadline_s(self, usual_s: float) -> float:
        """Return how long the answer is waited for, s.

        Args:
            usual_s: How long if nothing is said about it.

        Raises:
            InvalidInput: If what is said is not a number in (0, 600].
        """
        said_s = self.number(DEADLINE)
        if said_s is None:
            return usual_s
        if not 0.0 < said_s <= _MOST_DEADLINE_S:
            raise InvalidInput(f"{DEADLINE}={said_s:g} is not in (0, {_MOST_DEADLINE_S:g}] s")
        return said_s

    @property
    def part_bytes(self) -> int | None:
        """Largest part that the answer may come in; None if it must come whole.

        Raises:
            InvalidInput: If it is out of range.
        """
        size = self.integer(PART_BYTES)
        if size is not None and not _LEAST_PART_BYTES <= size <= _MOST_PART_BYTES:
            raise InvalidInput(
                f"{PART_BYTES}={size} is not in [{_LEAST_PART_BYTES}, {_MOST_PART_BYTES}]"
            )
        return size

    def text(self, name: str) -> str:
        """Return a parameter.

        Raises:
            InvalidInput: If it is missing.
        """
        text = self._parameters.get(name)
        if not text:
            raise InvalidInput(f"{self.name} needs {name}=...")
        return text

    def choice(self, name: str, default: Choice) -> Choice:
        """Return a parameter that is one of the values of the default's type.

        Raises:
            InvalidInput: If it is none of them.
        """
        text = self._parameters.get(name, default)
        choices = type(default)
        if text not in set(choices):
            raise InvalidInput(f"{name}={text!r} is not one of {', '.join(choices)}")
        return choices(text)

    def answer(self, value: Value | HmtError) -> None:
        """Send the answer, or the error, and be done with the query."""
        _reply(self._query, self._key, value)

    def reply(self, answer: Wire) -> None:
        """Send an answer that is already encoded, and be done with the query."""
        with self._query:
            self._query.reply(self._key, answer.payload, encoding=answer.encoding)

    def reply_part(self, part: Part) -> None:
        """Send a part of the answer; with the last one be done with the query."""
        place = encode_place(part)
        self._query.reply(
            self._key, part.wire.payload, encoding=part.wire.encoding, attachment=place
        )
        if part.is_last:
            self._query.drop()


def receive(
    query: zenoh.Query,
    keys: Mapping[Name, str],
    handle: Callable[[Question[Name]], Value | None],
) -> None:
    """Let a query be answered, whatever happens.

    Args:
        query: What Zenoh has received.
        keys: The key of every call that could be meant.
        handle: Returns the answer, or None when it has arranged for one to be given later.
    """
    key = str(query.key_expr)
    value: Value | HmtError | None
    try:
        question = Question(query, keys)
        key = keys[question.name]
        value = handle(question)
    except HmtError as error:
        value = error
    except Exception as error:  # noqa: BLE001 - Zenoh would swallow it, and the client wait in vain
        _LOG.exception("call %s failed", key)
        value = DaemonFailure(f"call {key} failed: {error!r}")
    if value is not None:
        _reply(query, key, value)


def _reply(query: zenoh.Query, key: str, value: Value | HmtError) -> None:
    message = encode(value)
    with query:
        if isinstance(value, HmtError):
            query.reply_err(message.payload, encoding=message.encoding)
        else:
            query.reply(key, message.payload, encoding=message.encoding)
