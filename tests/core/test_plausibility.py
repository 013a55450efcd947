"""Clouds with known quantiles against the expectations of every preset."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_service.core.config import Preset, load_config
from hmt_service.core.engine import Engine
from hmt_service.core.geometry import FloatArray, certain, exp, identity
from hmt_service.core.plausibility import Plausibility, fitting_preset
from hmt_service.core.types import Event, EventKind, Keyframe, Scan, Tracking

SENSOR = np.array([0.3, -0.2, 0.8])
UPRIGHT = np.eye(3)
SLANT = exp(np.array([0.3, 0.4, 0.0, 0.0, 0.0, 0.0]))[:3, :3]


def rays_of(
    near_m: float, far_m: float, *, is_flat: bool = False, rotation: FloatArray = UPRIGHT
) -> FloatArray:
    """Return 22 rays: 12 of `near_m`, 9 half as long as `far_m`, 1 as long as `far_m`.

    The median is `near_m`, the 95 % quantile half of `far_m`; from 6 m on, none share a cell.
    """
    azimuth = np.linspace(0.0, 2.0 * np.pi, 22, endpoint=False)
    elevation = np.zeros(22) if is_flat else np.radians(30.0) * (np.arange(22) % 3 - 1)
    level = np.cos(elevation)
    directions = np.stack(
        [level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=1
    )
    lengths = np.concatenate([np.full(12, near_m), np.full(9, 0.5 * far_m), np.full(1, far_m)])
    return np.asarray(lengths[:, None] * directions @ rotation.T)


def keyframe(index: int, rays: FloatArray) -> Keyframe:
    points = (rays + SENSOR).astype(np.float32)
    return Keyframe(index, 10.0 + index, points, SENSOR, certain(identity()))


def events_of(plausibility: Plausibility, *stays: tuple[int, FloatArray]) -> list[Event]:
    """Return what is said of so many keyframes of each cloud, one after the other."""
    clouds = [rays for count, rays in stays for _ in range(count)]
    return [
        event
        for index, rays in enumerate(clouds)
        for event in plausibility.check(keyframe(index, rays))
    ]


def checked(preset: Preset, rays: FloatArray, keyframes: int = 200) -> list[Event]:
    return events_of(Plausibility(load_config(preset).sensor), (keyframes, rays))


ROOM = rays_of(10.0, 48.0)
"""Median 10.0 m, 95 % at 24 m: a hall with a view."""
FIELD = rays_of(20.0, 90.0)
"""Median 20.0 m, 95 % at 45 m."""
SLICE = rays_of(10.0, 48.0, is_flat=True)


@pytest.mark.parametrize(
    ("preset", "rays"),
    [
        (Preset.PLANAR, SLICE),
        (Preset.PLANAR, rays_of(20.0, 70.0, is_flat=True)),
        (Preset.INDOOR, ROOM),
        (Preset.OUTDOOR, FIELD),
        # Between large halls and small squares nobody is wrong.
        (Preset.INDOOR, rays_of(14.5, 60.0)),
        (Preset.OUTDOOR, rays_of(14.5, 60.0)),
    ],
)
def test_the_right_preset_is_not_doubted(preset: Preset, rays: FloatArray) -> None:
    assert checked(preset, rays) == []


@pytest.mark.parametrize(
    ("preset", "rays", "expectation", "advice"),
    [
        (Preset.OUTDOOR, ROOM, "a median range of at least 13 m", "3d-indoor would fit"),
        (Preset.INDOOR, FIELD, "a median range of at most 16 m", "3d-outdoor would fit"),
        (Preset.INDOOR, SLICE, "heights of more than 0.3 m", "2d would fit"),
        (Preset.PLANAR, ROOM, "one plane, give or take 0.3 m", "3d-indoor would fit"),
        (Preset.PLANAR, FIELD, "one plane, give or take 0.3 m", "3d-outdoor would fit"),
        (
            Preset.OUTDOOR,
            SLICE,
            "a median range of at least 13 m and heights of more than 0.3 m",
            "2d would fit",
        ),
        (
            Preset.PLANAR,
            rays_of(14.5, 60.0),
            "one plane, give or take 0.3 m",
            "3d-indoor or 3d-outdoor would fit",
        ),
    ],
)
def test_the_wrong_preset_is_doubted_once_with_expectation_and_advice(
    preset: Preset, rays: FloatArray, expectation: str, advice: str
) -> None:
    (event,) = checked(preset, rays)
    assert event.kind is EventKind.PRESET_DOUBTED
    assert event.message.startswith(f"preset {preset} expects {expectation}; in 40 keyframes, ")
    assert event.message.endswith(f": {advice} better")
    assert event.stamp_s == 10.0 + 39


def test_a_doubt_has_the_quantiles_of_the_cloud() -> None:
    (event,) = checked(Preset.OUTDOOR, ROOM)
    assert event.numbers["keyframes"] == 40.0
    assert event.numbers["median_range_m"] == pytest.approx(10.0, abs=0.11)
    assert event.numbers["range_95_m"] == pytest.approx(24.0, abs=0.11)
    assert event.numbers["min_median_range_m"] == 13.0
    for text in ("nearer than 10.1 m", "95 % nearer than 24.1 m"):
        assert text in event.message


def test_heights_are_those_above_and_below_the_plane_of_most_rays() -> None:
    azimuth = np.linspace(0.0, 2.0 * np.pi, 20, endpoint=False)
    ring = 10.0 * np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(20)], axis=1)
    # Up ahead and behind, down on both sides: they tilt no plane.
    spokes = np.array([[8.0, 0.0, 5.0], [-8.0, 0.0, 5.0], [0.0, 8.0, -5.0], [0.0, -8.0, -5.0]])
    (event,) = checked(Preset.PLANAR, np.concatenate([ring, spokes]) @ SLANT.T)
    assert event.numbers["height_95_m"] == pytest.approx(5.0, abs=0.11)


def test_density_does_not_matter() -> None:
    """Where a scan is denser is the sensor's doing, not the place's."""
    rng = np.random.default_rng(5)
    post = [3.0, 0.0, 0.0] + rng.uniform(-0.1, 0.1, (10_000, 3))
    assert checked(Preset.OUTDOOR, np.concatenate([FIELD, post])) == []


def test_a_laser_that_is_mounted_at_a_slant_is_still_flat() -> None:
    slanted = rays_of(10.0, 48.0, is_flat=True, rotation=SLANT)
    assert np.ptp(slanted[:, 2]) > 10.0
    assert checked(Preset.PLANAR, slanted) == []


def test_ground_alone_is_not_flat_seen_from_above() -> None:
    ground = SLICE - [0.0, 0.0, 1.5]
    (event,) = checked(Preset.PLANAR, ground)
    assert event.numbers["height_95_m"] > 1.0


def test_nothing_is_said_of_few_keyframes_or_empty_ones() -> None:
    assert checked(Preset.OUTDOOR, ROOM, keyframes=39) == []
    assert checked(Preset.OUTDOOR, np.zeros((0, 3))) == []


def test_a_change_of_mind_is_said_and_ends_the_doubt() -> None:
    plausibility = Plausibility(load_config(Preset.OUTDOOR).sensor)
    doubted, confirmed = events_of(plausibility, (40, ROOM), (400, FIELD))
    assert (doubted.kind, confirmed.kind) == (
        EventKind.PRESET_DOUBTED,
        EventKind.PRESET_CONFIRMED,
    )
    assert confirmed.numbers["keyframes"] in (80.0, 160.0, 320.0)
    assert confirmed.message.startswith("preset 3d-outdoor fits after all: in ")
    assert plausibility.doubt is None


def test_other_advice_is_another_doubt() -> None:
    plausibility = Plausibility(load_config(Preset.PLANAR).sensor)
    doubts = events_of(plausibility, (40, ROOM), (400, rays_of(20.0, 70.0)))
    assert [event.message.partition(": ")[2].split()[0] for event in doubts] == [
        "3d-indoor",
        "3d-outdoor",
    ]
    assert plausibility.doubt is doubts[-1]


def test_a_doubt_is_kept_as_long_as_it_stands() -> None:
    plausibility = Plausibility(load_config(Preset.OUTDOOR).sensor)
    assert plausibility.doubt is None
    (event,) = events_of(plausibility, (500, ROOM))
    assert plausibility.doubt is event


def test_other_expectations_may_be_set_and_are_no_preset_s() -> None:
    lenient = load_config(Preset.OUTDOOR, "sensor: {min_median_range_m: 5.0}").sensor
    assert events_of(Plausibility(lenient), (40, ROOM)) == []
    strict = load_config(Preset.INDOOR, "sensor: {max_median_range_m: 5.0}").sensor
    (event,) = events_of(Plausibility(strict), (40, ROOM))
    assert event.message.startswith("the configuration expects a median range of at most 5 m; ")


def test_what_no_preset_is_made_for_gets_no_advice() -> None:
    (event,) = checked(Preset.OUTDOOR, rays_of(50.0, 120.0, is_flat=True))
    assert event.message.endswith(": no preset fits")


def test_the_engine_returns_the_event_and_keeps_the_warning() -> None:
    engine = Engine(load_config(Preset.OUTDOOR))
    here = certain(identity())
    events: list[Event] = []
    for index in range(45):
        events += engine.process(Tracking(float(index), index, here, keyframe(index, ROOM)))
        assert (len(engine.warnings) == 1) is (index >= 39)
    doubts = [event for event in events if event.kind is EventKind.PRESET_DOUBTED]
    assert tuple(doubts) == engine.warnings


def scans_of(rays: FloatArray, count: int = 50) -> list[Scan]:
    return [Scan(float(n), rays + SENSOR, SENSOR) for n in range(count)]


@pytest.mark.parametrize(
    ("rays", "preset"),
    [
        (SLICE, Preset.PLANAR),
        (SLICE @ SLANT.T, Preset.PLANAR),
        (ROOM, Preset.INDOOR),
        (FIELD, Preset.OUTDOOR),
        # Both fit where their expectations overlap, from 13 to 16 m: the middle divides them.
        (rays_of(14.0, 60.0), Preset.INDOOR),
        (rays_of(15.0, 60.0), Preset.OUTDOOR),
    ],
)
def test_the_preset_that_fits_is_found(rays: FloatArray, preset: Preset) -> None:
    fit = fitting_preset(scans_of(rays))
    assert fit is not None
    assert (fit.preset, fit.has_doubt, fit.scans) == (preset, False, 50)
    assert str(fit).startswith(f"preset {preset} fits: in 50 scans, half of what it sees")


def test_the_preset_that_fits_is_not_doubted_on_the_way() -> None:
    for rays in (SLICE, ROOM, FIELD):
        fit = fitting_preset(scans_of(rays))
        assert fit is not None
        assert checked(fit.preset, rays) == []


def test_what_no_preset_expects_gets_the_least_wrong_one() -> None:
    fit = fitting_preset(scans_of(rays_of(50.0, 90.0, is_flat=True)))
    assert fit is not None
    assert (fit.preset, fit.has_doubt) == (Preset.PLANAR, True)
    assert "least wrong, though no preset fits" in str(fit)


def test_scans_without_a_return_in_sight_tell_no_preset() -> None:
    nothing = Scan(0.0, np.zeros((0, 3)), SENSOR)
    assert fitting_preset([nothing]) is None
    assert fitting_preset(scans_of(1000.0 * ROOM)) is None
    fit = fitting_preset([nothing, *scans_of(ROOM, 3)])
    assert fit is not None
    assert fit.scans == 3
