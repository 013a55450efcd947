"""Options that every command which builds a map has.

References: own.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hmt_service.core.config import Config, Preset, load_config
from hmt_service.errors import NotFound

PresetName = Annotated[Preset, typer.Option("--preset", help="Kind of sensor.")]
ConfigFile = Annotated[
    Path | None,
    typer.Option("--config", help="YAML file of settings that differ from the preset."),
]
Seed = Annotated[int, typer.Option("--seed", min=0, help="Seed of all randomness.")]


def load_settings(preset: Preset, config: Path | None) -> Config:
    """Return a preset, changed by a YAML file when there is one.

    Raises:
        NotFound: If the file cannot be read.
        InvalidConfig: If its content is refused.
    """
    if config is None:
        return load_config(preset)
    try:
        return load_config(preset, config.read_text())
    except OSError as error:
        raise NotFound(f"configuration {config}: {error.strerror}") from error
