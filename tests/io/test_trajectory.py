"""TUM files: exact text, exact bytes, and the way back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hmt_service.core.geometry import exp, planar_pose
from hmt_service.core.types import StampedPose
from hmt_service.errors import InvalidInput, NotFound
from hmt_service.io.trajectory import read_tum, write_tum

components = st.floats(-1.7, 1.7, allow_subnormal=False)


def test_written_line_has_six_and_nine_decimals_and_no_negative_zero(tmp_path: Path) -> None:
    path = tmp_path / "trajectory.tum"
    write_tum(path, [StampedPose(976052857.3375301, planar_pose(1.5, -1e-12, np.pi / 2))])
    assert path.read_bytes() == (
        b"976052857.337530 1.500000000 0.000000000 0.000000000 "
        b"0.000000000 0.000000000 0.707106781 0.707106781\n"
    )


@given(
    st.lists(st.tuples(st.floats(0, 2e9), st.lists(components, min_size=6, max_size=6)), max_size=5)
)
def test_reading_inverts_writing(
    tmp_path_factory: pytest.TempPathFactory, stamped: list[tuple[float, list[float]]]
) -> None:
    path = tmp_path_factory.mktemp("tum") / "trajectory.tum"
    written = [StampedPose(stamp_s, exp(np.array(xi))) for stamp_s, xi in stamped]
    write_tum(path, written)
    first_bytes = path.read_bytes()
    found = read_tum(path)
    assert [pose.stamp_s for pose in found] == pytest.approx(
        [pose.stamp_s for pose in written], rel=0, abs=1e-6
    )
    for before, after in zip(written, found, strict=True):
        assert after.reference_from_body == pytest.approx(before.reference_from_body, abs=1e-8)
    write_tum(path, written)
    assert path.read_bytes() == first_bytes


def test_comments_and_empty_lines_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "trajectory.tum"
    path.write_text("# stamp x y z qx qy qz qw\n\n1 2 3 4 0 0 0 2\n")
    (pose,) = read_tum(path)
    assert pose.stamp_s == 1.0
    assert pose.reference_from_body[:3, :3] == pytest.approx(np.eye(3))
    assert pose.reference_from_body[:3, 3] == pytest.approx([2.0, 3.0, 4.0])


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("1 2 3 4 0 0 0", "7 finite numbers of 7, not 8"),
        ("1 2 3 4 0 0 0 nan", "7 finite numbers of 8, not 8"),
        ("1 2 3 4 0 0 0 x", "could not convert"),
        ("1 2 3 4 0 0 0 0", "quaternion"),
    ],
)
def test_broken_line_is_refused_with_its_number(tmp_path: Path, line: str, reason: str) -> None:
    path = tmp_path / "trajectory.tum"
    path.write_text(f"1 2 3 4 0 0 0 1\n{line}\n")
    with pytest.raises(InvalidInput, match=rf"trajectory\.tum:2: .*{reason}"):
        read_tum(path)


def test_missing_file_is_not_found(tmp_path: Path) -> None:
    with pytest.raises(NotFound, match=r"none\.tum: No such file"):
        read_tum(tmp_path / "none.tum")
