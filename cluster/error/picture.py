"""A frame as the bytes that leave the machine, and the picture that those bytes show.

Each frame stands alone: ``h264`` makes one intra-coded picture, so a film of near frames takes fewer bytes than this.
"""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from ...shared.errors import DeviceError
from ..sink import PNG_LEVEL
from .config import ImageSection


def encode_picture(rgb: np.ndarray, image: ImageSection) -> bytes:
    """The bytes of an (h, w, 3) uint8 picture. Raises DeviceError if the codec is not installed."""
    if image.codec == "h264":
        return _encode_h264(rgb, image.h264_crf)
    from PIL import Image

    data = io.BytesIO()
    if image.codec == "jpeg":
        Image.fromarray(rgb).save(data, "JPEG", quality=image.jpeg_quality)  # 4:2:0, as Pillow does by default
    else:
        Image.fromarray(rgb).save(data, "PNG", compress_level=PNG_LEVEL)
    return data.getvalue()


def decode_picture(data: bytes, image: ImageSection, width: int, height: int) -> np.ndarray:
    """(height, width, 3) uint8: what ``encode_picture`` bytes show."""
    if image.codec == "h264":
        return _decode_h264(data)[:height, :width]
    from PIL import Image

    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))


def _encode_h264(rgb: np.ndarray, crf: int) -> bytes:
    av = _av()
    height, width = rgb.shape[:2]
    even = np.pad(rgb, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")  # 4:2:0 needs even sides
    codec = av.CodecContext.create("libx264", "w")
    codec.width, codec.height, codec.pix_fmt, codec.framerate = even.shape[1], even.shape[0], "yuv420p", 25
    codec.options = {"preset": "veryfast", "crf": str(crf)}
    packets = [*codec.encode(av.VideoFrame.from_ndarray(even, format="rgb24")), *codec.encode(None)]
    return b"".join(bytes(packet) for packet in packets)


def _decode_h264(data: bytes) -> np.ndarray:
    av = _av()
    codec = av.CodecContext.create("h264", "r")
    frames = [*codec.decode(av.Packet(data)), *codec.decode(None)]
    return frames[0].to_ndarray(format="rgb24")


def _av() -> Any:
    try:
        import av
    except ImportError:
        raise DeviceError("image.codec = 'h264': PyAV is missing; install splatpipe[video]") from None
    return av
