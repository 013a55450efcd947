"""g2o files, read and optimised by gtsam."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest

from hmt_service.core.config import Preset, load_config
from hmt_service.core.geometry import GaussianPose, planar_pose, yaw_of
from hmt_service.core.stored import StoredHypothesis, StoredMap
from hmt_service.errors import InvalidInput
from hmt_service.io.exporters.formats import Format
from hmt_service.io.exporters.g2o import export_g2o
from hmt_service.io.exporters.registry import export_map
from hmt_service.io.placed_map import PlacedMap
from tests.io.test_map_file import random_map
from tests.mapped import map_file_in, mapped


def with_hypothesis(hypothesis: StoredHypothesis) -> StoredMap:
    return replace(mapped().stored(), hypotheses=(hypothesis,))


def test_planar_graph_is_at_its_optimum_and_has_the_factors(tmp_path: Path) -> None:
    path = tmp_path / "out.g2o"
    export_map(map_file_in(tmp_path), path, Format.G2O)
    graph, values = gtsam.readG2o(str(path), is3D=False)
    (hypothesis,) = mapped().stored().hypotheses
    assert graph.size() == len(hypothesis.factors) == 3
    for index, factor in enumerate(hypothesis.factors):
        read: Any = graph.at(index)
        assert read.keys() == [factor.visit_a, factor.visit_b]
        mean, axes = factor.a_from_b.mean, [3, 4, 2]
        expected = gtsam.Pose2(mean[0, 3], mean[1, 3], yaw_of(mean))
        assert read.measured().equals(expected, 1e-12)
        covariance = factor.a_from_b.covariance[np.ix_(axes, axes)]
        np.testing.assert_allclose(read.noiseModel().covariance(), covariance, atol=0.0, rtol=1e-9)
    # Solved anew, the poses stay where the map has them.
    graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(), gtsam.noiseModel.Isotropic.Sigma(3, 1e-6)))
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    for visit, pose in hypothesis.reference_from_visit.items():
        expected = gtsam.Pose2(pose[0, 3], pose[1, 3], yaw_of(pose))
        assert values.atPose2(visit).equals(expected, 1e-12)
        assert solved.atPose2(visit).equals(expected, 1e-4)


def test_spatial_graph_comes_back(tmp_path: Path) -> None:
    stored = replace(
        random_map(4, keyframes=6, visits=3, hypotheses=1),
        config_json=load_config(Preset.INDOOR).model_dump_json(),
    )
    path = tmp_path / "out.g2o"
    export_g2o(PlacedMap.of(stored), path)
    graph, values = gtsam.readG2o(str(path), is3D=True)
    (hypothesis,) = stored.hypotheses
    first = hypothesis.reference_from_visit[0]
    for visit, pose in hypothesis.reference_from_visit.items():
        expected = gtsam.Pose3(np.linalg.inv(first) @ pose)
        assert values.atPose3(visit).equals(expected, 1e-9)
    assert graph.size() == 2
    for index, factor in enumerate(hypothesis.factors):
        read: Any = graph.at(index)
        assert read.measured().equals(gtsam.Pose3(factor.a_from_b.mean), 1e-9)
        covariance = factor.a_from_b.covariance
        np.testing.assert_allclose(read.noiseModel().covariance(), covariance, atol=0.0, rtol=1e-6)


def test_far_vertices_keep_all_digits(tmp_path: Path) -> None:
    (hypothesis,) = mapped().stored().hypotheses
    far = {**hypothesis.reference_from_visit, 2: planar_pose(12345.678901234567, 0.1, 0.2)}
    export_g2o(
        PlacedMap.of(with_hypothesis(replace(hypothesis, reference_from_visit=far))),
        tmp_path / "out.g2o",
    )
    _, values = gtsam.readG2o(str(tmp_path / "out.g2o"), is3D=False)
    assert values.atPose2(2).x() == pytest.approx(12345.678901234567, abs=1e-10)


def test_visits_without_a_factor_are_left_out(tmp_path: Path) -> None:
    (hypothesis,) = mapped().stored().hypotheses
    tied = tuple(f for f in hypothesis.factors if 2 not in (f.visit_a, f.visit_b))
    assert len(tied) == 1
    export_g2o(
        PlacedMap.of(with_hypothesis(replace(hypothesis, factors=tied))), tmp_path / "out.g2o"
    )
    _, values = gtsam.readG2o(str(tmp_path / "out.g2o"), is3D=False)
    assert sorted(values.keys()) == [0, 1]


def test_factor_without_information_is_refused(tmp_path: Path) -> None:
    (hypothesis,) = mapped().stored().hypotheses
    first = hypothesis.factors[0]
    certain = replace(first, a_from_b=GaussianPose(first.a_from_b.mean, np.zeros((6, 6))))
    placed = PlacedMap.of(with_hypothesis(replace(hypothesis, factors=(certain,))))
    with pytest.raises(InvalidInput, match="visits 0 and 1 has no information"):
        export_g2o(placed, tmp_path / "out.g2o")
    assert list(tmp_path.iterdir()) == []
