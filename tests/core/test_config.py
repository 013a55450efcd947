"""Settings: what is refused, and what makes two settings different."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from hmt_service.core.config import Config, OdometryConfig, Preset, load_config
from hmt_service.errors import InvalidConfig


@pytest.mark.parametrize("preset", Preset)
def test_presets_are_valid_and_survive_a_round_trip(preset: Preset) -> None:
    config = load_config(preset)
    again = Config.model_validate_json(config.model_dump_json())
    assert again == config
    assert again.hash() == config.hash()


def test_presets_differ_in_whether_the_robot_moves_in_a_plane() -> None:
    assert load_config(Preset.PLANAR).sensor.is_planar
    assert not load_config(Preset.OUTDOOR).sensor.is_planar


def test_document_changes_only_what_it_names() -> None:
    base = load_config(Preset.OUTDOOR)
    config = load_config(Preset.OUTDOOR, "odometry: {voxel_size_m: 0.6}")
    assert config.odometry.voxel_size_m == 0.6
    assert config.odometry.model_copy(update={"voxel_size_m": 0.5}) == base.odometry
    assert config.model_copy(update={"odometry": base.odometry}) == base


@pytest.mark.parametrize("text", [None, "", "# nothing but a comment\n"])
def test_empty_document_is_the_preset(text: str | None) -> None:
    assert load_config(Preset.OUTDOOR, text) == load_config(Preset.OUTDOOR)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("odometri: {}", "odometri"),
        ("odometry: {voxel_size: 0.1}", "voxel_size"),
        ("odometry: {voxel_size_m: 0.0}", "voxel_size_m"),
        ("odometry: {voxel_size_m: thick}", "voxel_size_m"),
        ("areas: {max_cut: 2.1}", "max_cut"),
        ("particles: {budget: 0}", "budget"),
        ("odometry: 3", "odometry"),
        ("[1, 2]", "list, not a mapping"),
        ("areas: {max_cut: 0.1", "not YAML"),
    ],
)
def test_document_that_cannot_be_meant_is_refused(text: str, named: str) -> None:
    with pytest.raises(InvalidConfig, match=named):
        load_config(text=text)


def test_every_setting_changes_the_hash() -> None:
    config = load_config()
    hashes = {config.hash()}
    settings = 0
    for name, section in config:
        for key, value in section:
            other = (not value) if isinstance(value, bool) else value * 2
            changed = section.model_copy(update={key: other})
            hashes.add(config.model_copy(update={name: changed}).hash())
            settings += 1
    assert len(hashes) == settings + 1


def test_equal_settings_have_the_hash_of_every_run() -> None:
    assert load_config().hash() == Config().hash()
    assert len(load_config().hash()) == 12


def test_settings_cannot_be_changed_after_validation() -> None:
    with pytest.raises(ValidationError, match="frozen"):
        OdometryConfig().voxel_size_m = 0.2  # type: ignore[misc]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("odometry: {keyframe_distance: 1}", "did you mean keyframe_distance_m?"),
        ("odometri: {}", "there is no odometri; did you mean odometry?"),
        ("sensor: {xyz: 1}", "there is no sensor.xyz$"),
        ("odometry: {min_points: 1}", "odometry.min_points: Input should be .* 3, not 1"),
        ("sensor: 5", "sensor: Input should be .*, not 5"),
    ],
)
def test_what_is_refused_says_what_would_do(text: str, reason: str) -> None:
    with pytest.raises(InvalidConfig, match=reason.replace("?", "[?]")):
        load_config(text=text)
