"""Writing a scan as LAS or LAZ."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..points import unpack_rgb
from .scan import CityScan

_SCALE_M = 0.001
_BATCH_POINTS = 1_000_000


def write_las(source: CityScan, path: str | Path) -> None:
    """Write a scan as LAS 1.4, point format 7, compressed when the name ends in ``.laz``.

    Positions are rounded to 1 mm, colours widened to 16 bits; LAS has no field for normals. The file appears under
    its name only when whole.
    Raises InputError for another ending or a folder that cannot be written.
    Cost: memory of one batch of a million points.
    """
    import laspy

    path = Path(path)
    if path.suffix.lower() not in (".las", ".laz"):
        raise InputError(f"{path}: cannot write {path.suffix or 'a name without ending'}, expected .las or .laz")
    header = laspy.LasHeader(point_format=7, version="1.4")
    header.scales = np.full(3, _SCALE_M)
    header.offsets = np.floor(np.asarray(source.info.lower))
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        with laspy.open(temporary, "w", header=header) as writer:
            for batch in source.batches(_BATCH_POINTS):
                record = laspy.ScaleAwarePointRecord.zeros(len(batch), header=header)
                record.x, record.y, record.z = batch.positions.T
                rgb = unpack_rgb(batch.attributes["rgb"]).astype(np.uint16) * np.uint16(257)
                record.red, record.green, record.blue = rgb[:, 0], rgb[:, 1], rgb[:, 2]
                record.intensity = batch.attributes["intensity"].astype(np.uint16)
                record.classification = batch.attributes["classification"]
                record.return_number = batch.attributes["return_number"]
                record.number_of_returns = batch.attributes["return_number"]
                writer.write_points(record)
        os.replace(temporary, path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        temporary.unlink(missing_ok=True)
