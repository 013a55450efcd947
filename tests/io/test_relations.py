"""Ground-truth relations: errors with known answers, laws, and the published odometry errors."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hmt_service.core.geometry import Pose, exp, identity, inverse, planar_pose
from hmt_service.core.types import OdometryReading, Scan, StampedPose
from hmt_service.errors import InvalidInput, NotFound
from hmt_service.io.carmen import read_carmen
from hmt_service.io.relations import Relations, evaluate, read_relations


def trajectory_of(*poses: Pose, step_s: float = 50.0) -> list[StampedPose]:
    return [StampedPose(index * step_s, pose) for index, pose in enumerate(poses)]


def relations_of(*relations: tuple[float, float, Pose]) -> Relations:
    return Relations(
        np.array([relation[:2] for relation in relations]),
        np.array([relation[2] for relation in relations]),
    )


def random_poses(count: int, *, seed: int) -> list[Pose]:
    return list(exp(np.random.default_rng(seed).normal(0.0, 0.5, (count, 6))))


def test_errors_have_the_known_mean_and_deviation() -> None:
    trajectory = trajectory_of(identity(), planar_pose(2.0, 0.0, 0.0), planar_pose(9.0, 0.0, 0.0))
    errors = evaluate(
        trajectory,
        relations_of(
            (0.0, 50.0, planar_pose(1.0, 0.0, 0.0)),
            # 7 m estimated; 4 m ahead and 3 m to the right of the truth, turned by -90 degrees.
            (50.0, 100.0, planar_pose(3.0, 3.0, math.pi / 2)),
            (0.0, 100.0, planar_pose(9.0, 0.0, 0.0)),
        ),
    )
    everything, loops = errors.all_pairs, errors.loop_closures
    assert (errors.matched, errors.unmatched, everything.pairs) == (3, 0, 3)
    assert everything.translation_mean_m == pytest.approx(2.0)
    assert everything.translation_std_m == pytest.approx(np.std([1.0, 5.0, 0.0]))
    assert everything.rotation_mean_deg == pytest.approx(30.0)
    assert everything.rotation_std_deg == pytest.approx(np.std([0.0, 90.0, 0.0]))
    assert everything.squared_translation_mean_m2 == pytest.approx(26.0 / 3.0)
    assert everything.squared_translation_std_m2 == pytest.approx(np.std([1.0, 25.0, 0.0]))
    assert everything.squared_rotation_mean_deg2 == pytest.approx(2700.0)
    assert everything.squared_rotation_std_deg2 == pytest.approx(np.std([0.0, 8100.0, 0.0]))
    # Only the last pair is over 60 s apart, and it is right.
    assert loops is not None
    assert loops.pairs == 1
    assert loops.translation_mean_m == pytest.approx(0.0)


def test_no_pair_far_apart_means_no_loop_closure_statistics() -> None:
    errors = evaluate(trajectory_of(identity(), identity()), relations_of((0.0, 50.0, identity())))
    assert errors.loop_closures is None


@given(seed=st.integers(0, 2**32 - 1), world=st.lists(st.floats(-1.5, 1.5), min_size=6, max_size=6))
def test_errors_vanish_for_the_truth_in_any_frame(seed: int, world: list[float]) -> None:
    poses = random_poses(5, seed=seed)
    truth = relations_of(
        *((i * 50.0, j * 50.0, inverse(poses[i]) @ poses[j]) for i in range(5) for j in range(i))
    )
    elsewhere = [exp(np.array(world)) @ pose for pose in poses]
    errors = evaluate(trajectory_of(*elsewhere), truth).all_pairs
    assert errors.translation_mean_m == pytest.approx(0.0, abs=1e-9)
    assert errors.rotation_mean_deg == pytest.approx(0.0, abs=1e-6)


def test_trajectory_may_come_in_any_order() -> None:
    poses = trajectory_of(*random_poses(4, seed=1))
    truth = relations_of((0.0, 100.0, identity()), (50.0, 150.0, identity()))
    assert evaluate(poses[::-1], truth) == evaluate(poses, truth)


def test_pairs_without_both_poses_are_counted_and_left_out() -> None:
    trajectory = trajectory_of(identity(), identity())
    truth = relations_of(
        (0.004, 49.996, planar_pose(1.0, 0.0, 0.0)),
        (0.006, 50.0, planar_pose(9.0, 0.0, 0.0)),
        (0.0, 60.0, planar_pose(9.0, 0.0, 0.0)),
        (-1.0, 50.0, planar_pose(9.0, 0.0, 0.0)),
    )
    errors = evaluate(trajectory, truth, tolerance_s=0.005)
    assert (errors.matched, errors.unmatched) == (1, 3)
    assert errors.all_pairs.translation_mean_m == pytest.approx(1.0)


def test_nothing_matched_is_refused_with_both_spans() -> None:
    truth = relations_of((1000.0, 1001.0, identity()))
    with pytest.raises(
        InvalidInput, match=r"none of 1 relations from 1000\.000 s .* 1 poses from 0\.000 s"
    ):
        evaluate(trajectory_of(identity()), truth)
    with pytest.raises(InvalidInput, match="no pose to compare with 1 relations"):
        evaluate([], truth)


def test_file_holds_fixed_axis_angles(tmp_path: Path) -> None:
    path = tmp_path / "some.relations"
    path.write_text("1.5 2.5 1 2 3 0.1 0.2 0.3\n")
    relations = read_relations(path)
    yaw = exp(np.array([0.0, 0.0, 0.3, 0.0, 0.0, 0.0]))
    pitch = exp(np.array([0.0, 0.2, 0.0, 0.0, 0.0, 0.0]))
    roll = exp(np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0]))
    assert relations.stamps_s == pytest.approx(np.array([[1.5, 2.5]]))
    assert relations.first_from_second[0, :3, :3] == pytest.approx((yaw @ pitch @ roll)[:3, :3])
    assert relations.first_from_second[0, :3, 3] == pytest.approx([1.0, 2.0, 3.0])


def test_unusable_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "some.relations"
    path.write_text("1 2 3\n")
    with pytest.raises(InvalidInput, match=r"some\.relations:1: 3 finite numbers of 3, not 8"):
        read_relations(path)
    path.write_text("# nothing\n")
    with pytest.raises(InvalidInput, match="holds no relation"):
        read_relations(path)
    with pytest.raises(NotFound, match="No such file"):
        read_relations(tmp_path / "none")


@pytest.mark.parametrize(
    ("name", "relations", "loop_closures", "published_m"),
    [("intel", 2984, 1210, 7.4), ("fr079", 1685, 577, 6.5), ("aces", 1279, 88, 0.55)],
)
def test_raw_odometry_has_its_published_error(
    hmt_data: Path, name: str, relations: int, loop_closures: int, published_m: float
) -> None:
    log = read_carmen(hmt_data / "2d" / f"{name}.clf.bz2", min_range_m=0.1, max_range_m=40.0)
    scan_stamps = {reading.stamp_s for reading in log.readings if isinstance(reading, Scan)}
    odometry = [
        StampedPose(reading.stamp_s, reading.odom_from_body)
        for reading in log.readings
        if isinstance(reading, OdometryReading) and reading.stamp_s in scan_stamps
    ]
    truth = read_relations(hmt_data / "2d" / f"{name}.relations")
    errors = evaluate(odometry, truth, tolerance_s=0.001)
    assert (errors.matched, errors.unmatched) == (relations, 0)
    assert errors.loop_closures is not None
    assert errors.loop_closures.pairs == loop_closures
    assert errors.all_pairs.translation_mean_m == pytest.approx(published_m, rel=0.01)
