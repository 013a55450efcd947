"""`hmt eval`: how far a trajectory is from ground-truth relations.

References:
    Kümmerle et al., On measuring the accuracy of SLAM algorithms, 2009.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rich.table import Table

    from hmt_service.io.relations import RelationErrors

TRAJECTORY = "trajectory.tum"
"""Name of the trajectory in a folder that `hmt run` has written."""


def evaluate(
    directory: Annotated[
        Path, typer.Argument(metavar="DIR", help=f"Folder that holds {TRAJECTORY}.")
    ],
    relations: Annotated[Path, typer.Option(help="File of ground-truth relations.")],
    tolerance_s: Annotated[
        float, typer.Option(min=0.0, help="Largest difference of stamps that still match.")
    ] = 0.005,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Compare DIR/trajectory.tum with ground-truth relations (Kümmerle et al. 2009)."""
    from hmt_service.io.relations import evaluate as errors_of
    from hmt_service.io.relations import read_relations
    from hmt_service.io.trajectory import read_tum

    errors = errors_of(
        read_tum(directory / TRAJECTORY), read_relations(relations), tolerance_s=tolerance_s
    )
    if as_json:
        typer.echo(json.dumps(asdict(errors), allow_nan=False))
        return
    from rich.console import Console

    Console().print(_table(errors))


def _table(errors: RelationErrors) -> Table:
    from rich.table import Table

    table = Table(
        title="Error over relations, mean ± standard deviation",
        caption=f"{errors.matched} relations matched, {errors.unmatched} without a scan",
    )
    for heading in ("", "pairs", "translation m", "rotation deg", "squared m²", "squared deg²"):
        table.add_column(heading, justify="right" if heading else "left")
    for name, group in (
        ("all", errors.all_pairs),
        (f"over {errors.loop_gap_s:g} s apart", errors.loop_closures),
    ):
        if group is None:
            table.add_row(name, "0", *["-"] * 4)
            continue
        table.add_row(
            name,
            str(group.pairs),
            f"{group.translation_mean_m:.4f} ± {group.translation_std_m:.4f}",
            f"{group.rotation_mean_deg:.3f} ± {group.rotation_std_deg:.3f}",
            f"{group.squared_translation_mean_m2:.5f} ± {group.squared_translation_std_m2:.5f}",
            f"{group.squared_rotation_mean_deg2:.4f} ± {group.squared_rotation_std_deg2:.4f}",
        )
    return table
