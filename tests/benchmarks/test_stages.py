"""The clock over hand-made stages, and that the real ones exist."""

from __future__ import annotations

from itertools import islice

import pytest

from benchmarks.stages import STAGES, Stage, StageClock
from hmt_service.core.config import load_config
from hmt_service.runtime.offline import map_readings
from hmt_service.sim.simulation import INDOOR_LASER, simulate
from hmt_service.sim.worlds.families import Family, draw


class Time:
    """A clock that only work moves."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


class Worker:
    """Work of known length, one part of it inside the other."""

    def __init__(self, time: Time) -> None:
        self.time = time

    def outer(self, *, fails: bool = False) -> str:
        self.time.now_s += 1.0
        self.inner(fails=fails)
        self.time.now_s += 2.0
        self.inner()
        return "done"

    def inner(self, *, fails: bool = False) -> None:
        self.time.now_s += 10.0
        if fails:
            raise ValueError("on purpose")

    def again(self, times: int) -> None:
        self.time.now_s += 1.0
        if times > 1:
            self.again(times - 1)


METHODS = {
    Stage.TSBI: ((Worker, "outer"),),
    Stage.GRAPH: ((Worker, "inner"),),
    Stage.REST: ((Worker, "again"),),
}


def test_time_of_an_inner_stage_counts_for_it_alone() -> None:
    time = Time()
    clock = StageClock(METHODS, time)
    with clock.running():
        assert Worker(time).outer() == "done"
    assert clock.spent_s == {Stage.TSBI: 3.0, Stage.GRAPH: 20.0, Stage.REST: 0.0}
    assert sum(clock.spent_s.values()) == time.now_s


def test_a_stage_that_calls_itself_counts_once() -> None:
    time = Time()
    clock = StageClock(METHODS, time)
    with clock.running():
        Worker(time).again(5)
    assert clock.spent_s[Stage.REST] == 5.0


def test_a_stage_that_fails_counts_until_then() -> None:
    time = Time()
    clock = StageClock(METHODS, time)
    with clock.running():
        with pytest.raises(ValueError, match="on purpose"):
            Worker(time).outer(fails=True)
        Worker(time).inner()
    assert clock.spent_s == {Stage.TSBI: 1.0, Stage.GRAPH: 20.0, Stage.REST: 0.0}


def test_outside_the_block_nothing_is_measured_and_nothing_stays_wrapped() -> None:
    before = [getattr(owner, name) for methods in STAGES.values() for owner, name in methods]
    time = Time()
    clock = StageClock(METHODS, time)
    with clock.running(), StageClock().running():
        pass
    Worker(time).outer()
    assert set(clock.spent_s.values()) == {0.0}
    after = [getattr(owner, name) for methods in STAGES.values() for owner, name in methods]
    assert before == after


@pytest.mark.parametrize(
    ("owner", "name"), [method for methods in STAGES.values() for method in methods]
)
def test_every_wrapped_method_exists_where_it_is_said_to_be(owner: type, name: str) -> None:
    assert callable(vars(owner)[name])


def test_every_stage_has_its_own_methods() -> None:
    assert set(STAGES) == set(Stage)
    methods = [method for methods in STAGES.values() for method in methods]
    assert len(set(methods)) == len(methods)


def test_all_stages_of_a_real_run_take_time_and_add_up_to_the_whole() -> None:
    instants = islice(simulate(draw(Family.OFFICE, 0), INDOOR_LASER, 0), 300)
    readings = [reading for instant in instants for reading in instant.readings]
    clock = StageClock()
    with clock.running():
        _, cost = map_readings(readings, load_config())
    assert all(seconds > 0.0 for seconds in clock.spent_s.values())
    assert 0.8 * cost.busy_s < sum(clock.spent_s.values()) <= cost.busy_s
