from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from hmt_service.core.geometry import GaussianPose, certain, exp, planar_pose
from hmt_service.core.types import (
    Arc,
    ArcResidual,
    Comparison,
    GlobalMap,
    MapMethod,
    PlacedArea,
    Points,
)
from hmt_service.errors import InvalidInput, NotFound
from hmt_service.viz.figures import area_colours, draw_maps, position_ellipse

# sqrt of the 95 % quantile of the chi-squared distribution with two degrees of freedom, -2 ln 0.05.
SIGMAS_95 = math.sqrt(-2.0 * math.log(0.05))
RED = (0xD0, 0, 0)


def covariance(sigma_x: float, sigma_y: float) -> np.ndarray:
    return np.diag([1e-6, 1e-6, 0.01, sigma_x**2, sigma_y**2, 1e-6])


def square_of_points() -> Points:
    side = np.linspace(-1.0, 1.0, 50)
    edges = [(side, 0 * side + end) for end in (-1.0, 1.0)]
    flat = np.vstack([np.column_stack(edge) for x, y in edges for edge in ((x, y), (y, x))])
    return np.column_stack([flat, np.zeros(len(flat))]).astype(np.float32)


def ring_map(method: MapMethod, *, areas: int = 6, traversals: int = 1) -> GlobalMap:
    """Return areas on a circle of 10 m, each joined to the next one."""
    poses = [
        GaussianPose(
            planar_pose(10.0 * math.cos(angle), 10.0 * math.sin(angle), angle),
            covariance(0.1, 0.4),
        )
        for angle in np.linspace(0.0, math.tau, areas, endpoint=False)
    ]
    arcs = [tuple(sorted((area, (area + 1) % areas))) for area in range(areas)]
    return GlobalMap(
        method=method,
        reference_area=0,
        hypothesis=2,
        probability=0.75,
        revision=9,
        areas=tuple(
            PlacedArea(area, pose, 5, 1, square_of_points()) for area, pose in enumerate(poses)
        ),
        arcs=tuple(Arc(a, b, certain(np.eye(4)), traversals) for a, b in sorted(arcs)),
    )


def comparison(residual_m: float) -> Comparison:
    return Comparison(
        reference_area=0,
        hypothesis=2,
        revision=9,
        areas=(),
        arcs=(ArcResidual(0, 1, 0.0, 0.0), ArcResidual(0, 5, 0.01, residual_m)),
    )


def decoded(path: Path) -> np.ndarray:
    """Return the pixels of a PNG as integers in [0, 255], shape (height, width, 3)."""
    assert path.read_bytes().startswith(b"\x89PNG")
    return np.asarray(np.rint(255 * imread(path)[..., :3]), dtype=int)


def has_colour(pixels: np.ndarray, colour: tuple[int, int, int]) -> bool:
    return bool(np.any(np.all(pixels == colour, axis=-1)))


def test_ellipse_axes_are_known_multiples_of_sigma() -> None:
    pose = GaussianPose(planar_pose(3.0, -2.0, 0.0), covariance(0.5, 0.2))
    long, short, direction = position_ellipse(pose)
    assert long == pytest.approx(2 * SIGMAS_95 * 0.5, rel=1e-3)
    assert short == pytest.approx(2 * SIGMAS_95 * 0.2, rel=1e-3)
    assert math.sin(direction) == pytest.approx(0.0, abs=1e-9)


def test_ellipse_turns_with_the_area() -> None:
    yaw = math.radians(30.0)
    _, _, direction = position_ellipse(
        GaussianPose(planar_pose(3.0, -2.0, yaw), covariance(0.5, 0.2))
    )
    assert math.remainder(direction - yaw, math.pi) == pytest.approx(0.0, abs=1e-9)


def test_ellipse_holds_95_percent_of_sampled_positions() -> None:
    pose = GaussianPose(planar_pose(3.0, -2.0, 1.1), covariance(0.5, 0.2))
    rng = np.random.default_rng(0)
    offsets = np.zeros((20_000, 6))
    offsets[:, 3:] = rng.multivariate_normal(np.zeros(3), pose.covariance[3:, 3:], 20_000)
    positions = (pose.mean @ exp(offsets))[:, :2, 3] - pose.mean[:2, 3]
    long, short, direction = position_ellipse(pose)
    c, s = math.cos(direction), math.sin(direction)
    along, across = positions @ [c, s] / (long / 2), positions @ [-s, c] / (short / 2)
    # Five standard errors of a share of 20,000 draws.
    assert np.mean(along**2 + across**2 <= 1.0) == pytest.approx(0.95, abs=0.008)


def test_certain_pose_has_an_ellipse_without_size() -> None:
    assert position_ellipse(certain(planar_pose(1.0, 2.0, 0.3)))[:2] == (0.0, 0.0)


def test_two_maps_make_a_png_that_is_twice_as_wide(tmp_path: Path) -> None:
    maps = [ring_map(MapMethod.CONSISTENT), ring_map(MapMethod.SHORTEST_PATH)]
    draw_maps(maps, comparison(2.0), tmp_path / "both.png")
    draw_maps(maps[:1], None, tmp_path / "one.png")
    both, one = decoded(tmp_path / "both.png"), decoded(tmp_path / "one.png")
    assert both.shape[0] == one.shape[0]
    assert both.shape[1] > 1.7 * one.shape[1]


def test_contradiction_is_marked_in_red_in_the_right_panel_only(tmp_path: Path) -> None:
    maps = [ring_map(MapMethod.CONSISTENT), ring_map(MapMethod.SHORTEST_PATH)]
    draw_maps(maps, comparison(2.0), tmp_path / "map.png")
    pixels = decoded(tmp_path / "map.png")
    height, width = pixels.shape[:2]
    # The lowest tenth holds the legend.
    panels = pixels[: height * 9 // 10]
    assert not has_colour(panels[:, : width // 2], RED)
    assert has_colour(panels[:, width // 2 :], RED)


def test_negligible_residual_is_not_marked(tmp_path: Path) -> None:
    draw_maps([ring_map(MapMethod.SHORTEST_PATH)], comparison(0.001), tmp_path / "map.png")
    pixels = decoded(tmp_path / "map.png")
    assert not has_colour(pixels[: len(pixels) * 9 // 10], RED)


def test_number_of_traversals_is_drawn(tmp_path: Path) -> None:
    for traversals in (1, 2):
        shown = ring_map(MapMethod.CONSISTENT, traversals=traversals)
        draw_maps([shown], None, tmp_path / f"{traversals}.png")
    assert not np.array_equal(decoded(tmp_path / "1.png"), decoded(tmp_path / "2.png"))


def test_neighbouring_areas_have_different_colours(tmp_path: Path) -> None:
    # Nine areas: the colour of area 8 would be that of area 0, its neighbour, in a plain cycle.
    shown = ring_map(MapMethod.CONSISTENT, areas=9)
    colours = area_colours([shown])
    assert len(colours) == 9
    assert all(colours[arc.area_a] != colours[arc.area_b] for arc in shown.arcs)


def test_map_of_one_area_without_points_is_drawn(tmp_path: Path) -> None:
    empty = PlacedArea(0, certain(np.eye(4)), 1, 1, np.zeros((0, 3), dtype=np.float32))
    alone = GlobalMap(MapMethod.CONSISTENT, 0, 0, 1.0, 1, (empty,), ())
    draw_maps([alone], None, tmp_path / "alone.png")
    assert decoded(tmp_path / "alone.png").min() < 128


def test_nothing_to_draw_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="0 maps"):
        draw_maps([], None, tmp_path / "map.png")


def test_unknown_image_format_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="png"):
        draw_maps([ring_map(MapMethod.CONSISTENT)], None, tmp_path / "map.hmt")


def test_missing_folder_is_not_found(tmp_path: Path) -> None:
    with pytest.raises(NotFound, match="absent"):
        draw_maps([ring_map(MapMethod.CONSISTENT)], None, tmp_path / "absent" / "map.png")
