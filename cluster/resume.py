"""Going on with a run that was cut short: which pictures are there and whole, and whether they are of this run.

At its start a run leaves ``run.partial.json`` beside its pictures: everything that their bits depend on. It goes when
``run.json``, which holds the same, is written. How the work is dealt to ranks is none of it: a run may be resumed in
another topology, on more or fewer ranks, as the bits are those of one rank.

Pictures are looked for where rank 0 sees ``output.directory``: on several hosts that is a folder they share.
"""

from __future__ import annotations

import hashlib
import json
import struct
import warnings
import zlib
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ..shared.errors import InputError
from ..shared.files import write_json
from .job import Job
from .record import package_version
from .sink import LAYERS, make_output, prepare_output

PARTIAL = "run.partial.json"
PARTIAL_VERSION = 1
_BITS_DO_NOT_DEPEND_ON = (
    "pipeline.",
    "scene.",  # what it holds is compared instead, so that it may be moved
    "render.threads",
    "output.directory",
    "output.resume",
    "output.mp4",
    "output.fps",
)
_MOST_BYTES = 16 << 20
_LONG = 100
_PNG_START, _PNG_END = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR", b"\0\0\0\0IEND\xaeB`\x82"


def prepare(job: Job) -> bool:
    """Make the output directory ready and settle which frames are drawn; whether there is anything to draw.

    Without ``output.resume``, or where no run has begun, what lies there of a run is taken away. Else pictures that are
    whole stay and ``job.frames`` are the others'. Where all are there but for ``run.json``, the last one is drawn
    again, as a record needs a frame; where that is there too, the answer is False and nothing is changed.

    Raises InputError if the pictures there are of another run, or the directory cannot be written.
    Cost: two short reads a picture.
    """
    mine = drawn_as(job)
    found = _found(job.output) if job.config.output.resume else None
    if found is None:
        prepare_output(job.output)
        _leave(job, mine)
        return True
    source, theirs = found
    for key in sorted(mine.keys() | theirs.keys()):
        if theirs.get(key) != mine.get(key):
            raise InputError(
                f"{source}: {key}: found {json.dumps(theirs.get(key))}, expected {json.dumps(mine.get(key))}: pictures "
                "of another run; leave out --resume to start over, or choose another output.directory"
            )
    whole = whole_pictures(job)
    missing = [number for number in range(job.n_pictures) if number not in whole]
    film_is_there = not job.film_afterwards or (job.output / "film.mp4").exists()
    if not missing and source.name == "run.json" and film_is_there:
        return False
    make_output(job.output)
    _leave(job, mine)
    prepare_output(job.output, keep={name for number in whole for name in picture_names(job, number)})
    job.draw_only(missing or [job.n_pictures - 1])
    return True


def finished(job: Job) -> None:
    """Take away what ``prepare`` has left for a run to be resumed by; after ``run.json`` is written."""
    (job.output / PARTIAL).unlink(missing_ok=True)


def drawn_by(job: Job, pictures: list[int]) -> dict[str, int]:
    """How many pictures were there when a run began, and how many it has drawn, for its record."""
    return {"kept": job.n_pictures - len(pictures), "drawn": len(pictures)}


def drawn_as(job: Job) -> dict[str, Any]:
    """Everything that the bits of a run's pictures depend on: name → value, JSON-able; long values are hashed.

    A rasterizer chosen by ``auto`` is not resolved: whoever resumes splats or layers on another device names it.
    """
    settings = dict(_flat(job.config.model_dump(mode="json", exclude={"layers"}), ""))
    depends = {key: value for key, value in settings.items() if not key.startswith(_BITS_DO_NOT_DEPEND_ON)}
    for i, (layer, section) in enumerate(zip(job.layers, job.config.layers, strict=True)):
        depends |= _flat(section.model_dump(mode="json", exclude={"path"}), f"layers.{i}.")
        arrays = (layer.origin, layer.objects, layer.elements, layer.first_element)
        depends[f"layers.{i}.crc32"] = [zlib.crc32(np.ascontiguousarray(array).view(np.uint8).data) for array in arrays]
    depends = {key: _short(value) for key, value in depends.items()}
    depends["scene"] = _sha256(asdict(job.scene.info))
    return depends | {"splatpipe": package_version("splatpipe")}


def whole_pictures(job: Job) -> set[int]:
    """Numbers of the pictures of which every file is there and whole. Empty where a run writes no pictures."""
    if not _layers(job):
        return set()
    width, height = job.picture_size
    return {
        number
        for number in range(job.n_pictures)
        if all(is_whole(job.output / name, width, height) for name in picture_names(job, number))
    }


def picture_names(job: Job, number: int) -> list[str]:
    """Names of the files of a picture."""
    return [name for layer in _layers(job) for name in job.picture_names(layer, number)]


def is_whole(path: Path, width: int, height: int) -> bool:
    """Whether a PNG or TIFF file is of this size and has its end; what is between is not decoded."""
    try:
        return _whole_png(path, width, height) if path.suffix == ".png" else _whole_tiff(path, width, height)
    except (OSError, ValueError, SyntaxError, struct.error, KeyError, TypeError, Warning):
        return False


def _whole_png(path: Path, width: int, height: int) -> bool:
    with path.open("rb") as file:
        head = file.read(33)
        file.seek(-len(_PNG_END), 2)
        end = file.read()
    checked, size = zlib.crc32(head[12:29]), struct.pack(">II", width, height)
    return head.startswith(_PNG_START) and head[16:24] == size and head[29:] == checked.to_bytes(4) and end == _PNG_END


def _whole_tiff(path: Path, width: int, height: int) -> bool:
    from PIL import Image

    with warnings.catch_warnings(action="error"), Image.open(path, formats=["TIFF"]) as image:  # reads its directory
        tags: Any = image.tag_v2  # pyright: ignore[reportAttributeAccessIssue]
        strips = zip(tags[273], tags[279], strict=True)  # offsets, lengths
        n_bytes = sum(tags[279])
        inside = all(offset > 0 and offset + length <= path.stat().st_size for offset, length in strips)
        return image.size == (width, height) and image.mode == "F" and n_bytes == 4 * width * height and inside


def _layers(job: Job) -> list[str]:
    return [layer for layer in LAYERS if getattr(job.config.output, layer)]


def _leave(job: Job, mine: dict[str, Any]) -> None:
    write_json(job.output / PARTIAL, {"partial_version": PARTIAL_VERSION, "drawn_as": mine})


def _found(directory: Path) -> tuple[Path, dict[str, Any]] | None:
    """What the pictures in a directory were drawn as, and the file that says so; None where no run has begun."""
    for path in (directory / PARTIAL, directory / "run.json"):
        if not path.exists():
            continue
        try:
            with path.open("rb") as file:
                content = json.loads(file.read(_MOST_BYTES))
            drawn = content["drawn_as"]
            if not isinstance(drawn, dict):
                raise TypeError
        except (OSError, ValueError, KeyError, TypeError):
            raise InputError(f"{path}: found no record of what was drawn; leave out --resume to start over") from None
        return path, drawn
    return None


def _flat(tables: dict[str, Any], prefix: str) -> Iterator[tuple[str, Any]]:
    for key, value in tables.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield prefix + key, value


def _short(value: Any) -> Any:
    return value if len(json.dumps(value)) <= _LONG else _sha256(value)


def _sha256(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True, default=str).encode()).hexdigest()[:16]
