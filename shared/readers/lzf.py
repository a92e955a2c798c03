"""LZF decompression, as PCD files need it. Format: Lehmann, liblzf 3.6 (2011)."""

from __future__ import annotations

from numba import njit

MAX_EXPANSION = 88
"""No stream grows by more: a reference of three bytes stands for 264 at most."""


@njit(nogil=True, cache=True)
def decompress(data, out):
    """Fill ``out`` (uint8) from ``data`` (uint8): the number of bytes written, or −1 where the stream makes no sense.

    A control byte below 32 is followed by that many literal bytes and one. Else its upper three bits are a length
    (7: one more byte is added), and its lower five with the next byte a distance back into the output.
    Every index is checked: a stream can neither read nor write outside the arrays.
    """
    read = written = 0
    while read < len(data):
        control = int(data[read])
        read += 1
        if control < 32:
            n = control + 1
            if read + n > len(data) or written + n > len(out):
                return -1
            for _ in range(n):
                out[written] = data[read]
                read += 1
                written += 1
            continue
        n = (control >> 5) + 2
        if n == 9:
            if read >= len(data):
                return -1
            n += int(data[read])
            read += 1
        if read >= len(data):
            return -1
        source = written - ((control & 31) << 8) - int(data[read]) - 1
        read += 1
        if source < 0 or written + n > len(out):
            return -1
        for _ in range(n):  # byte by byte: source and destination may overlap
            out[written] = out[source]
            source += 1
            written += 1
    return written
