"""Compilation ahead of time: no robot waits for it.

References:
    own.
"""

from __future__ import annotations

from hmt_service.core import correlation, local_map, transients
from hmt_service.core.config import Config, Preset, load_config


def compile_kernels(config: Config) -> None:
    """Compile what a sensor's maps need, or load it, before the first scan."""
    correlation.compile_kernels()
    local_map.compile_kernels(is_planar=config.sensor.is_planar)
    transients.compile_kernels(config)


def compile_all() -> None:
    """Compile what any sensor's maps need: after installation."""
    for preset in Preset:
        compile_kernels(load_config(preset))
