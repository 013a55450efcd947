"""The recorded public logs that this project is measured on: origin, licence, checksum; fetching.

The logs are not part of the project. Checksums are those of the copies that the measurements were
made on, uncompressed where the original is; whether the servers hold the same bytes today shows
when they are fetched. Addresses are given where public sources name them, and left out elsewhere.

References:
    Kümmerle et al., On measuring the accuracy of SLAM algorithms, Autonomous Robots 27, 2009.
"""

from __future__ import annotations

import bz2
import hashlib
import http.client
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from hmt_service.errors import InvalidInput, NotFound, Unavailable, Unreachable
from hmt_service.io.whole_files import whole_files

_TIMEOUT_S = 30.0
_CHUNK_BYTES = 1 << 16


@dataclass(frozen=True, slots=True)
class RecordedFile:
    """One file of a log."""

    name: str
    """Where it is below the folder of recorded logs; `.bz2` is added to the original's name."""
    size: int
    """Size of the original, bytes."""
    sha256: str
    """SHA-256 of the original; of a folder, of the list `SHA-256  NAME` of its files by name."""
    url: str | None = None
    """Address of the original; None where none is known."""

    @property
    def original(self) -> str:
        """Name of the original file."""
        return Path(self.name).name.removesuffix(".bz2")


@dataclass(frozen=True, slots=True)
class Dataset:
    """One recorded log."""

    title: str
    """What was recorded, and how much of it."""
    origin: str
    """Who has recorded or published it, and where it is to be found."""
    licence: str
    """What its authors allow."""
    files: tuple[RecordedFile, ...]
    """What it consists of."""
    changed: str = ""
    """How the copy differs from what was published; empty: not at all, as far as is known."""


_BENCHMARK = "http://ais.informatik.uni-freiburg.de/slamevaluation/datasets"


def _benchmark(
    name: str, title: str, author: str, log: tuple[int, str], relations: tuple[int, str], url: str
) -> Dataset:
    """Return a log of the SLAM benchmark with its ground-truth relations."""
    page = f"{_BENCHMARK}.php"
    originals = {f"2d/{name}.clf.bz2": log, f"2d/{name}.relations": relations}
    return Dataset(
        title,
        f"{author}; SLAM benchmark of the University of Freiburg, {page}",
        "CC BY 3.0",
        tuple(
            RecordedFile(file, *numbers, url and f"{url}/{Path(file).name.removesuffix('.bz2')}")
            for file, numbers in originals.items()
        ),
    )


DATASETS: Mapping[str, Dataset] = MappingProxyType(
    {
        "intel": _benchmark(
            "intel",
            "Intel Research Lab, Seattle: 13,631 scans of 180 beams, 508 m; 2,984 relations",
            "Dirk Hähnel",
            (16_433_447, "8db0ad6231b48bad4118e6a2dc78e83213b2c306be3b4ed80a90969891abfe7b"),
            (265_713, "330378f153eeae652d6756c1746f335801f66c3e097d90611548e6c4f593c359"),
            _BENCHMARK,
        ),
        "fr079": _benchmark(
            "fr079",
            "Freiburg building 079: 4,934 scans of 360 beams, 392 m; 1,685 relations",
            "Cyrill Stachniss",
            (10_293_242, "d7ef6348cf29c2b71702f3a3ac779cb19a28184e11a031ee4150ec3b5f4696e6"),
            (133_044, "7e7f06b4aca455cb68f1f23d04e7c7316c5e17773e872734c860ed7a274cdfc7"),
            # The page has it; no public source names the address of the file itself.
            "",
        ),
        "aces": _benchmark(
            "aces",
            "ACES building, Austin: 7,374 scans of 180 beams, 325 m; 1,279 relations",
            "Patrick Beeson",
            (8_162_333, "1b6a069ebbfe261f2bae8bfe1ee91426932d2b964e8c2c0927b15663a4297390"),
            (99_426, "11a15800a751b6f9413078a021d49c7cda85a768c2a465433b4fae7ef57b03d5"),
            _BENCHMARK,
        ),
        "malaga": Dataset(
            "University of Málaga, first loop of the paper's experiment: 224 scans of 361 beams",
            "MRPT, share/mrpt/datasets: 2006-01ENE-21-SENA_Telecom Faculty_one_loop_only.rawlog",
            "BSD",
            (
                RecordedFile(
                    "2d/malaga-one-loop.clf.gz",
                    135_139,
                    "0704b997d065df2395d7c66b11b7000ac8a8e855a33754d85e643d34f42af622",
                ),
            ),
            "converted from MRPT's format to CARMEN's",
        ),
        "imm-ring": Dataset(
            "323 sweeps of a VLP-16 on a ring of 621 m, with wheel odometry",
            "published with software under this licence; no address of the recording is known here",
            "GPL 3.0",
            (
                RecordedFile(
                    "3d/imm-ring.mcap",
                    8_730_754,
                    "2c1d54d7f599aea7f6fbcbac30cb7d694ed36454b173919e13f9dd0186ff8275",
                ),
            ),
            "sweeps 1.9 m apart, thinned to 271-5,687 points, converted to MCAP, stamps made up",
        ),
        "kitti00-part": Dataset(
            "KITTI odometry, the beginning of sequence 00: 110 sweeps of an HDL-64, GPS/INS poses",
            "KITTI vision benchmark suite, https://www.cvlibs.net/datasets/kitti/eval_odometry.php",
            "CC BY-NC-SA 3.0",
            (
                RecordedFile(
                    "3d/kitti00-part",
                    53_199_496,
                    "dac8d28a132acef0ea5d92a78702d5bbac7c9c8a178598067671cd430c7484a9",
                ),
            ),
            "sweeps 1.8 m apart, every fourth point",
        ),
    }
)
"""The logs by name."""


def dataset_of(name: str) -> Dataset:
    """Return the log of that name.

    Raises:
        NotFound: If there is none.
    """
    if name not in DATASETS:
        raise NotFound(f"no log {name!r}; there are {', '.join(DATASETS)}")
    return DATASETS[name]


def checksum(path: Path) -> str:
    """Return the SHA-256 of a file, uncompressed if its name ends in `.bz2`, or of a folder."""
    if path.is_dir():
        names = sorted(file.relative_to(path).as_posix() for file in path.rglob("*.*"))
        lines = (f"{checksum(path / name)}  {name}\n" for name in names)
        return hashlib.sha256("".join(lines).encode()).hexdigest()
    with bz2.open(path) if path.suffix == ".bz2" else path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def fetch(
    name: str,
    folder: Path,
    *,
    mirror: str | None = None,
    on_bytes: Callable[[int], None] = lambda _: None,
) -> Iterator[tuple[Path, bool]]:
    """Fetch the files of a log that are not there yet, and check all of them.

    Args:
        name: Of the log.
        folder: Where `2d` and `3d` are, or will be.
        mirror: Address of a folder that holds the originals; None for where they come from.
        on_bytes: Is told how many bytes have come since the last time.

    Yields:
        Each file, and whether it was fetched now.

    Raises:
        NotFound: If there is no such log, or no address of it is known.
        Unreachable: If there is no way to the server.
        Unavailable: If it refuses, or the file cannot be written.
        InvalidInput: If what is there, or what has come, is not the log that was measured on.
    """
    dataset = dataset_of(name)
    if dataset.changed:
        raise NotFound(
            f"{name} is not to be fetched: it is {dataset.changed}. Its original: {dataset.origin}"
        )
    for recorded in dataset.files:
        path = folder / recorded.name
        if path.is_file():
            _refuse_other(str(path), recorded, path.stat().st_size, checksum(path))
            yield path, False
            continue
        url = f"{mirror.rstrip('/')}/{recorded.original}" if mirror else recorded.url
        if not url:
            raise NotFound(
                f"the address of {recorded.original} is not known; take it from {dataset.origin}, "
                "and name the address of its folder with --mirror"
            )
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole_files(path) as (part,):
            _download(url, recorded, part, on_bytes)
        yield path, True


def _download(
    url: str, recorded: RecordedFile, path: Path, on_bytes: Callable[[int], None]
) -> None:
    if not url.startswith(("http://", "https://")):
        raise InvalidInput(f"{url} is no address of http or https")
    digest, size = hashlib.sha256(), 0
    is_packed = recorded.name.endswith(".bz2")
    try:
        with (
            urllib.request.urlopen(url, timeout=_TIMEOUT_S) as response,
            bz2.open(path, "wb") if is_packed else path.open("wb") as file,
        ):
            # One byte more than expected tells that it is another file: nobody fills the disk.
            while size <= recorded.size and (chunk := response.read(_CHUNK_BYTES)):
                digest.update(chunk)
                file.write(chunk)
                size += len(chunk)
                on_bytes(len(chunk))
    except urllib.error.HTTPError as error:
        error.close()
        raise Unavailable(f"{url}: the server says {error.code} {error.reason}") from error
    except (urllib.error.URLError, http.client.HTTPException, TimeoutError) as error:
        reason = getattr(error, "reason", error)
        raise Unreachable(f"{url} cannot be reached: {reason}") from error
    _refuse_other(url, recorded, size, digest.hexdigest())


def _refuse_other(where: str, recorded: RecordedFile, size: int, sha256: str) -> None:
    if sha256 != recorded.sha256:
        raise InvalidInput(
            f"{where} ({size} bytes, SHA-256 {sha256}) is not the {recorded.original} that was "
            f"measured on ({recorded.size} bytes, SHA-256 {recorded.sha256})"
        )
