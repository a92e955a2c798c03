"""Messages in pieces between two ranks: at the borders of pieces, and beyond 2 GiB in earnest."""

from __future__ import annotations

from typing import Any

from ...shared.build.settings import available_memory_bytes
from ...shared.stability.case import OutOfReach, case, expect
from ..launch import launch, mpi_available
from ..transport import PIECE_BYTES


def _wrong_bytes(piece_bytes: int, lengths: list[int]) -> int:
    if not mpi_available():
        raise OutOfReach("MPI is missing: install splatpipe[mpi]")
    records: list[dict[str, Any]] = []
    arguments = [str(n) for n in (piece_bytes, *lengths)]
    status = launch(arguments, 2, records.append, module="splatpipe.cluster.stability.exchange")
    expect(status == 0 and len(records) == 1, f"the ranks exchanged the messages, found exit status {status}")
    return records[0]["wrong"]


@case("message/borders of pieces", bound=0.0, unit="bytes")
def borders() -> float:
    """Bytes that arrive wrong in messages of 0, 1, a piece − 1, a piece, a piece + 1 … 300 pieces + 1 bytes between two
    ranks; a piece is 4096 bytes.
    """
    return _wrong_bytes(4096, [0, 1, 4095, 4096, 4097, 8191, 8192, 8193, 300 * 4096 - 1, 300 * 4096, 300 * 4096 + 1])


@case("message/2.2 GiB", bound=0.0, unit="bytes")
def above_two_gibibytes() -> float:
    """Bytes that arrive wrong, around the borders of pieces and the ends, in one message of 2.2 GiB between two ranks,
    in the pieces that runs use.
    """
    needed = 7 << 30
    if available_memory_bytes() < needed:
        raise OutOfReach(f"needs {needed >> 30} GiB of free memory")
    return _wrong_bytes(PIECE_BYTES, [int(2.2 * (1 << 30)) + 1])
