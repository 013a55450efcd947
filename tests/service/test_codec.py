from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Mapping

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hmt_service.core.geometry import GaussianPose, exp
from hmt_service.core.types import (
    Arc,
    ArcResidual,
    AreaDetails,
    AreaDifference,
    AreaVisit,
    Belief,
    Comparison,
    Event,
    EventKind,
    GlobalMap,
    History,
    HmtPose,
    Hypotheses,
    HypothesisEffect,
    HypothesisSummary,
    Localization,
    MapMethod,
    PlacedArea,
    Posterior,
    StampedPose,
    StatementEffect,
    Trajectory,
)
from hmt_service.errors import (
    DaemonFailure,
    DeadlineExceeded,
    HmtError,
    InvalidInput,
    NotFound,
    Unavailable,
)
from hmt_service.runtime.messages import ProcessName, ProcessStatus
from hmt_service.service.codec import Value, decode, encode
from hmt_service.service.keys import Input
from hmt_service.service.reports import Ack, DaemonState, InputCounts, SenderCounts, Status

reals = st.floats(-1e6, 1e6)
shares = st.floats(0.0, 1.0)
ids = st.integers(0, 2**31)
counts = st.integers(0, 2**40)
texts = st.text(max_size=20)
tangents = st.lists(st.floats(-1.5, 1.5), min_size=6, max_size=6)


@st.composite
def gaussians(draw: st.DrawFn) -> GaussianPose:
    factor = np.array(draw(st.lists(reals, min_size=36, max_size=36))).reshape(6, 6)
    return GaussianPose(exp(np.array(draw(tangents))), factor)


localizations = st.builds(Localization, reals, shares, reals, st.none() | reals)
poses = st.builds(
    HmtPose,
    reals,
    ids,
    gaussians(),
    ids,
    gaussians(),
    ids,
    shares,
    localizations,
    st.integers(0, 2**60),
)
summaries = st.builds(
    HypothesisSummary, ids, shares, ids, st.lists(ids, max_size=5).map(tuple), ids, ids, ids
)
hypotheses = st.builds(Hypotheses, reals, counts, st.lists(summaries, max_size=3).map(tuple))
posteriors = st.builds(
    Posterior,
    reals,
    counts,
    st.lists(summaries, max_size=3).map(tuple),
    st.dictionaries(ids, shares, max_size=4),
    reals,
)
beliefs = st.builds(Belief, reals, st.dictionaries(ids, shares, max_size=4), reals)
histories = st.builds(History, counts, st.lists(beliefs, max_size=3).map(tuple))
clouds = st.lists(st.tuples(*[st.floats(-1e4, 1e4, width=32)] * 3), max_size=4).map(
    lambda rows: np.array(rows, dtype=np.float32).reshape(-1, 3)
)
areas = st.builds(PlacedArea, ids, gaussians(), ids, ids, clouds, st.integers(0, 2**48 - 1))
arcs = st.builds(Arc, ids, ids, gaussians(), ids)
transforms = tangents.map(lambda tangent: exp(np.array(tangent)))
area_visits = st.builds(AreaVisit, ids, transforms, reals, ids, st.booleans())
area_details = st.builds(
    AreaDetails,
    ids,
    ids,
    shares,
    counts,
    areas,
    st.lists(area_visits, max_size=2).map(tuple),
    st.lists(arcs, max_size=2).map(tuple),
)
trajectories = st.builds(
    Trajectory,
    ids,
    ids,
    shares,
    counts,
    st.booleans(),
    st.lists(st.builds(StampedPose, reals, transforms), max_size=3).map(tuple),
)
maps = st.builds(
    GlobalMap,
    st.sampled_from(MapMethod),
    ids,
    ids,
    shares,
    counts,
    st.lists(areas, max_size=2).map(tuple),
    st.lists(arcs, max_size=2).map(tuple),
)
comparisons = st.builds(
    Comparison,
    ids,
    ids,
    counts,
    st.lists(st.builds(AreaDifference, ids, reals, reals, reals, reals), max_size=3).map(tuple),
    st.lists(st.builds(ArcResidual, ids, ids, reals, reals), max_size=3).map(tuple),
)
effects = st.builds(
    StatementEffect,
    counts,
    ids,
    ids,
    counts,
    st.lists(
        st.builds(
            HypothesisEffect,
            ids,
            ids,
            st.booleans(),
            shares,
            shares,
            reals,
            reals,
            st.none() | reals,
        ),
        max_size=3,
    ).map(tuple),
)
events = st.builds(
    Event, st.sampled_from(EventKind), reals, texts, st.dictionaries(texts, reals, max_size=3)
)
tallies = st.dictionaries(texts, counts, max_size=3)
input_counts = st.builds(
    InputCounts, counts, counts, tallies, counts, counts, counts, counts, tallies
)
processes = st.builds(
    ProcessStatus, st.sampled_from(ProcessName), ids, st.booleans(), counts, counts, reals
)
statuses = st.builds(
    Status,
    texts,
    texts,
    st.sampled_from(DaemonState),
    reals,
    input_counts,
    counts,
    counts,
    st.lists(processes, max_size=2).map(tuple),
    counts,
    ids,
    ids,
    ids,
    ids,
    st.none() | ids,
    ids,
    st.none() | localizations,
    st.lists(
        st.builds(SenderCounts, counts, st.sampled_from(Input), counts, counts), max_size=2
    ).map(tuple),
)
acks = st.builds(Ack, counts, counts, counts, counts, st.lists(texts, max_size=3).map(tuple))


def assert_same(mine: object, theirs: object) -> None:
    """Compare values field by field, numbers of rotations up to rounding."""
    assert type(mine) is type(theirs)
    if isinstance(mine, np.ndarray) and isinstance(theirs, np.ndarray):
        np.testing.assert_allclose(mine, theirs, rtol=0.0, atol=1e-12)
    elif dataclasses.is_dataclass(mine):
        for field in dataclasses.fields(mine):
            assert_same(getattr(mine, field.name), getattr(theirs, field.name))
    elif isinstance(mine, tuple) and isinstance(theirs, tuple):
        assert len(mine) == len(theirs)
        for a, b in zip(mine, theirs, strict=True):
            assert_same(a, b)
    elif isinstance(mine, Mapping) and isinstance(theirs, Mapping):
        assert dict(mine) == dict(theirs)
    else:
        assert mine == theirs


@given(
    poses
    | posteriors
    | hypotheses
    | histories
    | maps
    | comparisons
    | effects
    | events
    | statuses
    | acks
)
def test_values_come_back_as_they_were(value: Value) -> None:
    message = encode(value)
    assert_same(decode(message.payload, message.encoding), value)


@given(area_details | trajectories)
def test_details_come_back_as_they_were(value: Value) -> None:
    message = encode(value)
    assert_same(decode(message.payload, message.encoding), value)


@given(st.lists(events, max_size=3).map(tuple))
def test_lists_of_events_come_back_as_they_were(value: tuple[Event, ...]) -> None:
    message = encode(value)
    assert_same(decode(message.payload, message.encoding), value)


@pytest.mark.parametrize(
    "kind", [InvalidInput, NotFound, Unavailable, DeadlineExceeded, DaemonFailure]
)
def test_errors_come_back_with_type_and_message(kind: type[HmtError]) -> None:
    message = encode(kind("area 9 of 4"))
    error = decode(message.payload, message.encoding)
    assert type(error) is kind
    assert str(error) == "area 9 of 4"


@given(st.binary(max_size=200))
def test_any_bytes_are_a_value_or_invalid_input(payload: bytes) -> None:
    encoding = encode(Ack(0, 0, 0, 0)).encoding.replace("Ack", "GlobalMap")
    with contextlib.suppress(InvalidInput):
        assert isinstance(decode(payload, encoding), GlobalMap)


def test_an_unknown_encoding_is_invalid_input() -> None:
    with pytest.raises(InvalidInput, match="text/plain"):
        decode(b"", "text/plain")


def test_every_encoding_names_its_message() -> None:
    assert encode(Ack(0, 0, 0, 0)).encoding == "application/protobuf;hmt.v1.Ack"
    assert encode(NotFound("x")).encoding == "application/protobuf;hmt.v1.Error"
