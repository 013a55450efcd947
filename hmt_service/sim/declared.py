"""What is declared of a simulated robot: immutable values, checked where they are made.

References:
    own; pydantic's dataclasses, so that `dataclasses.replace` checks as well.
"""

from __future__ import annotations

from typing import Any, Self, TypeVar, cast, dataclass_transform

from pydantic import ConfigDict, Field, ModelWrapValidatorHandler, ValidationError, model_validator
from pydantic.dataclasses import dataclass
from pydantic_core import ArgsKwargs

from hmt_service.errors import InvalidInput

_T = TypeVar("_T")
_CHECKED = ConfigDict(extra="forbid", use_attribute_docstrings=True, allow_inf_nan=False)


class Declared:
    """Base of what is declared: a value out of range raises InvalidInput with that value."""

    __slots__ = ()

    @model_validator(mode="wrap")
    @classmethod
    def _refuse(cls, values: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:
        if not isinstance(values, ArgsKwargs):
            return handler(values)  # a part of something declared, which will refuse it
        try:
            return handler(values)
        except ValidationError as error:
            wrong = (
                f"{'.'.join(map(str, each['loc']))} = {each['input']!r}: {each['msg']}"
                for each in error.errors()
            )
            raise InvalidInput(f"{cls.__name__}: {'; '.join(wrong)}") from error


@dataclass_transform(frozen_default=True, field_specifiers=(Field,))
def checked(cls: type[_T]) -> type[_T]:
    """Make a subclass of `Declared` a frozen dataclass that keeps to the ranges of its fields."""
    return cast(type[_T], dataclass(cls, frozen=True, slots=True, config=_CHECKED))
