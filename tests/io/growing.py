"""A process that writes a map file keyframe by keyframe until it is killed."""

from __future__ import annotations

import sys
from dataclasses import replace
from itertools import count
from pathlib import Path

from hmt_service.core.stored import StoredHypothesis, StoredMap
from hmt_service.io.map_file import read_map
from hmt_service.io.map_store import MapStore

_UPDATES = 3


def part_of(stored: StoredMap, keyframes: int) -> StoredMap:
    """Return what was known of a map after so many keyframes, as if it had been believed then."""
    visits = tuple(
        replace(visit, last_keyframe=min(visit.last_keyframe, keyframes - 1))
        for visit in stored.visits
        if visit.first_keyframe < keyframes
    )
    return replace(
        stored,
        keyframes=stored.keyframes[:keyframes],
        scans=tuple(scan for scan in stored.scans if scan.keyframe_index < keyframes),
        visits=visits,
        hypotheses=tuple(_part_of(each, len(visits)) for each in stored.hypotheses),
    )


def _part_of(hypothesis: StoredHypothesis, visits: int) -> StoredHypothesis:
    poses = hypothesis.reference_from_visit.items()
    return replace(
        hypothesis,
        assignments=hypothesis.assignments[:visits],
        reference_from_visit={visit: pose for visit, pose in poses if visit < visits},
        factors=tuple(f for f in hypothesis.factors if max(f.visit_a, f.visit_b) < visits),
    )


def _grow(stored: StoredMap, path: Path) -> None:
    """Write more and more, and tell each revision; every few updates another store goes on."""
    for revision in count(1):
        if revision % _UPDATES == 1:
            store = MapStore(path)
            with store.reading():
                pass
        part = part_of(stored, min(revision, len(stored.keyframes)))
        store.update(replace(part, revision=revision))
        sys.stdout.write(f"{revision}\n")
        sys.stdout.flush()
        if revision % _UPDATES == 0:
            store.close()


if __name__ == "__main__":
    _grow(read_map(Path(sys.argv[1])), Path(sys.argv[2]))
