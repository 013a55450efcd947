"""The pose graph of one hypothesis as g2o file: visits as vertices, factors as edges.

Written here: gtsam's own writer keeps six digits, which are centimetres a kilometre away.

References:
    Kümmerle et al., g2o: a general framework for graph optimization, ICRA 2011;
    https://github.com/RainerKuemmerle/g2o/wiki/File-Format. Tangents are `[translation, rotation]`;
    rotations are rotation vectors, rad, as gtsam reads and writes them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from hmt_service.core.geometry import FloatArray, Pose, quaternion_of, symmetric, yaw_of
from hmt_service.core.stored import StoredFactor
from hmt_service.errors import InvalidInput
from hmt_service.io.placed_map import PlacedMap
from hmt_service.io.whole_files import whole_files


class _Form(NamedTuple):
    name: str
    axes: npt.NDArray[np.intp]
    """Rows of our tangent `[rotation, translation]`, in the order of theirs."""
    pose: Callable[[Pose], list[float]]


def export_g2o(placed: PlacedMap, path: Path) -> None:
    """Write `VERTEX_SE2` and `EDGE_SE2` of planar maps, `SE3:QUAT` of others.

    Raises:
        InvalidInput: If a covariance has no inverse.
    """
    form = _PLANAR if placed.config.sensor.is_planar else _SPATIAL
    with whole_files(path) as (part,):
        part.write_text("".join(f"{line}\n" for line in _lines(placed, form)))


def _lines(placed: PlacedMap, form: _Form) -> Iterator[str]:
    for visit in _tied(placed):
        pose = form.pose(placed.reference_from_visit[visit])
        yield f"VERTEX_{form.name} {visit} {_numbers(pose)}"
    for factor in placed.hypothesis.factors:
        information = _information(factor, form.axes)
        values = [*form.pose(factor.a_from_b.mean), *information[np.triu_indices(len(form.axes))]]
        yield f"EDGE_{form.name} {factor.visit_a} {factor.visit_b} {_numbers(values)}"


def _tied(placed: PlacedMap) -> list[int]:
    """Return the visits that an optimiser can place: of forgotten ones no factor is left."""
    ends = {end for f in placed.hypothesis.factors for end in (f.visit_a, f.visit_b)}
    return sorted(ends | {placed.reference_area})


def _information(factor: StoredFactor, axes: npt.NDArray[np.intp]) -> FloatArray:
    covariance = factor.a_from_b.covariance[np.ix_(axes, axes)]
    try:
        return symmetric(np.asarray(np.linalg.inv(covariance)))
    except np.linalg.LinAlgError as error:
        raise InvalidInput(
            f"factor between visits {factor.visit_a} and {factor.visit_b} has no information "
            f"matrix: the variances are {np.diag(covariance)}"
        ) from error


def _pose2(pose: Pose) -> list[float]:
    return [float(pose[0, 3]), float(pose[1, 3]), yaw_of(pose)]


def _pose3(pose: Pose) -> list[float]:
    return [*pose[:3, 3].tolist(), *quaternion_of(pose).tolist()]


def _numbers(values: Iterable[float]) -> str:
    """Return numbers with as many digits as bring them back bit for bit."""
    return " ".join(repr(float(value)) for value in values)


_PLANAR = _Form("SE2", np.array([3, 4, 2]), _pose2)
_SPATIAL = _Form("SE3:QUAT", np.array([3, 4, 5, 0, 1, 2]), _pose3)
