"""The audit: what lasts is kept once, what is old is dropped, and events say why."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_service.core.alignment import Aligner
from hmt_service.core.audit import Audit, between, decisive, longest_doubt, recognised
from hmt_service.core.config import load_config
from hmt_service.core.engine import Engine
from hmt_service.core.odometry import Odometry
from hmt_service.core.refinement import Refinement
from hmt_service.core.types import Belief, Event, EventKind
from hmt_service.core.visits import Visits
from tests.core.factories import RING, drifting, drive, ring_path
from tests.core.test_refinement import VISITS, believed


def belief(stamp_s: float, **areas: float) -> Belief:
    masses = {int(name[1:]): mass for name, mass in areas.items()}
    return Belief(stamp_s, masses, 1.0 / sum(mass**2 for mass in masses.values()))


def test_a_belief_that_lasts_is_kept_at_both_ends() -> None:
    audit = Audit()
    for stamp_s in range(5):
        audit.believe(belief(float(stamp_s), a0=1.0))
    for stamp_s in range(5, 8):
        audit.believe(belief(float(stamp_s), a0=0.4, a1=0.6))
    audit.believe(belief(8.0, a1=1.0))
    assert [b.stamp_s for b in audit.beliefs] == [0.0, 4.0, 5.0, 7.0, 8.0]


def test_what_is_older_than_many_is_dropped() -> None:
    audit = Audit(events=3, beliefs=2)
    for stamp_s in range(5):
        audit.note([Event(EventKind.LOST, float(stamp_s), "lost")])
        audit.believe(belief(float(stamp_s), **{f"a{stamp_s}": 1.0}))
    assert [event.stamp_s for event in audit.events] == [2.0, 3.0, 4.0]
    assert [b.stamp_s for b in audit.beliefs] == [3.0, 4.0]


def test_what_held_at_the_ends_of_an_interval_is_there() -> None:
    beliefs = (belief(0.0, a0=1.0), belief(10.0, a0=0.5, a1=0.5), belief(20.0, a1=1.0))
    cut = [(b.stamp_s, len(b.current_area)) for b in between(beliefs, 4.0, 15.0)]
    assert cut == [(4.0, 1), (10.0, 2), (15.0, 2)]
    assert [b.stamp_s for b in between(beliefs, 12.0, 18.0)] == [12.0, 18.0]
    assert between(beliefs, 12.0, 18.0)[0].current_area == {0: 0.5, 1: 0.5}
    assert between(beliefs, -np.inf, np.inf) == beliefs
    assert between(beliefs, 30.0, 40.0) == ()
    assert between((), 0.0, 1.0) == ()


@pytest.fixture(scope="module")
def engine() -> Engine:
    path = ring_path(laps=1.4)
    odometry = drifting(path, scale=1.02, turn_rad_per_m=0.004)
    metric, engine = Odometry(load_config()), Engine(load_config())
    for reading in drive(RING, path, odometry=odometry, noise=np.random.default_rng(0)):
        if (tracking := metric.process(reading)) is not None:
            engine.process(tracking)
    engine.finish()
    return engine


def test_every_hypothesis_has_an_origin_and_every_dropped_one_a_mass(engine: Engine) -> None:
    events = engine.audit.events
    born = {e.numbers["hypothesis"]: e for e in events if e.kind is EventKind.BRANCHED}
    dropped = [e for e in events if e.kind is EventKind.PRUNED]
    assert born
    assert dropped
    for event in born.values():
        assert {"parent", "area", "overlap", "log_factor"} <= event.numbers.keys()
        assert np.isfinite(event.numbers["log_factor"])
    # Branches of one parent: the one that is kept explains what was seen better.
    assert any(event.numbers["overlap"] > 0.45 for event in born.values())
    limits = {"negligible_mass", "budget", "patience_areas", "same_as"}
    for event in dropped:
        assert event.numbers["log_weight"] <= 0.0
        assert len(limits & event.numbers.keys()) == 1


def test_what_is_left_alone_is_accepted_whatever_became_of_the_others(engine: Engine) -> None:
    living, alone = {0.0}, []
    for event in engine.audit.events:
        if event.kind is EventKind.BRANCHED:
            living -= {event.numbers["parent"]}
            living.add(event.numbers["hypothesis"])
        elif event.kind is EventKind.PRUNED:
            living.discard(event.numbers["hypothesis"])
        elif event.kind is EventKind.ACCEPTED and "last_dropped" in event.numbers:
            assert event.numbers["hypothesis"] in living
            assert event.numbers["last_dropped_mass"] <= event.numbers["last_dropped"]
            alone.append(event.stamp_s)
    certain = [b.stamp_s for b in engine.audit.beliefs if len(b.hypotheses) == 1]
    assert alone
    assert set(alone) <= set(certain)


def test_beliefs_end_with_the_posterior(engine: Engine) -> None:
    snapshot = engine.snapshot()
    assert snapshot is not None
    last = engine.audit.beliefs[-1]
    assert last.stamp_s == snapshot.posterior.stamp_s
    assert last.current_area == snapshot.posterior.current_area
    assert last.effective_sample_size == snapshot.posterior.effective_sample_size
    for belief in engine.audit.beliefs:
        assert sum(belief.current_area.values()) == pytest.approx(1.0)
        assert sum(belief.hypotheses.values()) == pytest.approx(1.0)
    assert last.hypotheses == {h.hypothesis: h.probability for h in snapshot.posterior.hypotheses}


def test_a_new_area_that_turns_out_to_be_a_known_one_is_said_to_be() -> None:
    config = load_config()
    refined = Refinement(config, Aligner(config)).refine(
        believed(), VISITS[2], Visits(VISITS.values())
    )
    event = recognised(2, refined, 7.0)
    assert event.kind is EventKind.ACCEPTED
    assert event.numbers == {"hypothesis": 0.0, "visit": 2.0, "area": 0.0}
    assert "area 2 is area 0" in event.message


def branch(stamp_s: float, parent: int, probability: float, log_factor: float) -> Event:
    numbers = {
        "parent": float(parent),
        "parent_probability": probability,
        "log_factor": log_factor,
    }
    return Event(EventKind.BRANCHED, stamp_s, "", numbers)


def dropped(stamp_s: float, log_weight: float, **more: float) -> Event:
    return Event(EventKind.PRUNED, stamp_s, "", {"log_weight": log_weight, **more})


def test_decisive_is_what_most_probability_hung_on() -> None:
    close = [branch(2.0, 1, 0.9, np.log(0.6)), branch(2.0, 1, 0.9, np.log(0.4))]
    clear = [branch(1.0, 0, 1.0, 0.0), branch(1.0, 0, 1.0, -20.0)]
    unlikely = [branch(2.0, 2, 0.1, 0.0), branch(2.0, 2, 0.1, 0.0)]
    last = Event(EventKind.ACCEPTED, 4.0, "", {"last_dropped_mass": 0.2})
    events = [
        *clear,
        *close,
        *unlikely,
        dropped(3.0, np.log(0.3)),
        dropped(3.0, np.log(0.45), same_as=1.0),
        last,
        Event(EventKind.LOST, 5.0, ""),
    ]
    # 0.36 each, 0.3, 0.2, 0.05 each; one that was merged loses nothing.
    assert decisive(events, 4) == (*close, events[6], last)
    assert decisive(events, 6) == (*close, *unlikely, events[6], last)
    assert decisive((), 3) == ()


def test_longest_doubt_is_where_the_sample_size_was_above_one() -> None:
    short = [belief(0.0, a0=1.0), belief(10.0, a0=0.5, a1=0.5), belief(11.0, a1=1.0)]
    long = [belief(20.0, a1=0.9, a2=0.1), belief(24.0, a1=0.5, a2=0.5), belief(28.0, a2=1.0)]
    assert longest_doubt([*short, *long]) == (18.0, 30.0)
    assert longest_doubt(short) == (9.75, 11.25)
    assert longest_doubt(short[:1]) is None
