from __future__ import annotations

import re
from pathlib import Path

import pytest
import typer.main

from hmt_service.cli.app import app
from hmt_service.core.config import Config, Preset
from hmt_service.io.decoding import Defect
from hmt_service.service.keys import Call, Control, Input, Topic
from hmt_service.service.readings import Refusal

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
PAGES = [README, *(page.read_text() for page in sorted((ROOT / "docs").glob("*.md")))]
COMMANDS = sorted(typer.main.get_group(app).commands)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_is_documented(command: str) -> None:
    assert re.search(rf"(hmt|make) {command}\b", README)


def test_every_documented_command_exists() -> None:
    for page in PAGES:
        named = set(re.findall(r"(?:^|`)hmt ([a-z]+)", page, flags=re.MULTILINE))
        assert named <= set(COMMANDS)


@pytest.mark.parametrize("target", re.findall(r"`?make ([a-z]+)", README))
def test_every_documented_make_target_exists(target: str) -> None:
    assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text(), flags=re.MULTILINE)


@pytest.mark.parametrize(
    ("prefix", "names"), [("in/", Input), ("", Topic), ("ro/", Call), ("@ctl/", Control)]
)
def test_every_key_is_in_the_key_table(
    prefix: str, names: type[Input] | type[Topic] | type[Call] | type[Control]
) -> None:
    base = re.escape("| `hmt/{site}/{robot}/" + prefix)
    rows = re.findall(rf"^{base}([a-z_{{}},]+)`", README, re.MULTILINE)
    documented = {name for row in rows for name in row.strip("{}").split(",")}
    assert documented == set(names)


@pytest.mark.parametrize("reason", [*Refusal, *Defect])
def test_every_reason_of_refusal_is_documented(reason: Refusal | Defect) -> None:
    assert f"`{reason}`" in README


@pytest.mark.parametrize("section", Config.model_fields)
def test_every_section_of_the_settings_is_documented(section: str) -> None:
    assert f"`{section}`" in README


@pytest.mark.parametrize("preset", Preset)
def test_every_preset_is_documented(preset: Preset) -> None:
    assert f"`--preset {preset}`" in README
