"""A recorded path: from the keys that a viewer has recorded to a configuration of ``splatpipe run``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from ...shared.camera_path import axis_vector
from ...shared.config import RunConfig
from ...shared.keyframes import Key, KeyframePath
from ...shared.toml_text import toml_document, toml_value
from .protocol import PathKey

TOLERANCE_PX = 1.0
"""Keys are left out where pictures move by less than this without them."""
MAX_KEYS = 512
MAX_TEXT_BYTES = 60_000
"""Of a configuration, as JSON: it crosses in a header."""
_HEAD = "# A camera path recorded in splatpipe view. Draw it: splatpipe run FILE\n\n"


def recorded_config(config: RunConfig, keys: Sequence[PathKey], fps: float, scene_up: np.ndarray) -> str:
    """The text of a configuration that draws a recorded path: its duration times ``fps`` pictures.

    config : as it is at the moment.  scene_up : (3,) float64.
    The scene's path is absolute; pictures go to the default folder, beside the file.  Keys are left out where the path
    through the others passes within ``TOLERANCE_PX``, and as many more as it takes to fit into a message.
    Raises ConfigError for a key whose target is its eye.
    """
    keys = in_order(keys)
    up_name = _up_name(keys, scene_up)
    up = scene_up if up_name == "scene" else axis_vector(up_name)
    duration_s = keys[-1].time - keys[0].time
    tables = config.model_dump(mode="json", exclude_defaults=True, exclude_none=True, exclude={"live"})
    for section in ("scene", "camera", "output"):
        tables.setdefault(section, {})
    if config.scene.path:
        tables["scene"]["path"] = str(Path(config.scene.path).resolve())
    for layer in tables.get("layers", []):
        layer["path"] = str(Path(layer["path"]).resolve())
    for name in ("poses", "center", "radius", "elevation_deg", "start_deg", "sweep_deg"):
        tables["camera"].pop(name, None)
    tables["camera"] |= {"path": "keyframes", "up": up_name}
    for name in ("directory", "resume"):
        tables["output"].pop(name, None)
    tables["output"] |= {"frames": max(1, round(duration_s * fps)), "fps": fps}
    written = [_keyframe(key, keys[0].time, duration_s) for key in keys]
    room = MAX_TEXT_BYTES - _json_bytes(_HEAD + toml_document(_with_keys(tables, [])))
    most = room // max(_json_bytes(f"    {toml_value(key)},\n") for key in written)
    kept = thinned(_path_of(keys, duration_s, up), config.camera.height, max(2, min(most, MAX_KEYS)))
    return _HEAD + toml_document(_with_keys(tables, [written[i] for i in kept]))


def in_order(keys: Sequence[PathKey]) -> list[PathKey]:
    """By time; of several at one time, as far as it can be told in a share of the whole, the last."""
    ascending = sorted(keys, key=lambda key: key.time)
    begun, duration_s = ascending[0].time, ascending[-1].time - ascending[0].time
    return list({_share(key.time, begun, duration_s): key for key in ascending}.values())


def thinned(path: KeyframePath, height: int, most: int) -> list[int]:
    """Indices of keys, ascending, the first and the last among them: through these alone, pictures of ``height`` pixels
    move by less than ``TOLERANCE_PX`` at the times of the others; or ``most`` ≥ 2, those that matter most.

    Cost: some ten evaluations of the path at each key, about 0.2 ms each.
    """
    keys = path.keys
    poses = [path.pose(key.time) for key in keys]
    kept = sorted({0, len(keys) - 1})
    while len(kept) < most:
        rest = KeyframePath(tuple(keys[i] for i in kept), path.up)
        worst = []
        for begin, end in pairwise(kept):
            moved = [_moved_px(key, poses[i], rest, height) for i, key in enumerate(keys[begin + 1 : end], begin + 1)]
            if moved and max(moved) > TOLERANCE_PX:
                worst.append((max(moved), begin + 1 + int(np.argmax(moved))))
        if not worst:
            break
        kept = sorted([*kept, *(i for _, i in sorted(worst, reverse=True)[: most - len(kept)])])
    return kept


def _moved_px(key: Key, pose: np.ndarray, path: KeyframePath, height: int) -> float:
    """How far pictures of two cameras lie apart, at most: in their middle, at the depth of the target."""
    other = path.pose(key.time)
    focal_px = height / 2 / math.tan(key.fov_y_rad / 2)
    turned_rad = np.linalg.norm(pose[:3, :3] - other[:3, :3]) / math.sqrt(2)
    shift = math.dist(pose[:3, 3], other[:3, 3]) / math.dist(key.eye, key.target)
    zoomed = abs(math.log(math.tan(path.fov_y_rad(key.time) / 2) / math.tan(key.fov_y_rad / 2)))
    return float(focal_px * (turned_rad + shift) + height / 2 * zoomed)


def _path_of(keys: Sequence[PathKey], duration_s: float, up: np.ndarray) -> KeyframePath:
    begun = keys[0].time
    return KeyframePath(
        tuple(
            Key(
                _share(key.time, begun, duration_s),
                np.array(key.view.eye),
                np.array(key.view.target),
                math.radians(key.view.fov_deg),
            )
            for key in keys
        ),
        up,
    )


def _keyframe(key: PathKey, begun: float, duration_s: float) -> dict[str, Any]:
    view = key.view
    time = _share(key.time, begun, duration_s)
    return {"time": time, "eye": list(view.eye), "target": list(view.target), "fov_deg": view.fov_deg}


def _share(time: float, begun: float, duration_s: float) -> float:
    return (time - begun) / duration_s if duration_s else 0.0


def _with_keys(tables: Mapping[str, Any], keys: list[dict[str, Any]]) -> dict[str, Any]:
    ordered = {name: tables[name] for name in RunConfig.model_fields if name in tables}
    return ordered | {"camera": tables["camera"] | {"keyframes": keys}}


def _json_bytes(text: str) -> int:
    """Bytes of a text in a header: each line ends in two."""
    return len(text.encode()) + text.count("\n") + 2 * text.count('"')


def _up_name(keys: Sequence[PathKey], scene_up: np.ndarray) -> str:
    """What ``camera.up`` is to be: the axis that is up in all views, where there is one and it is not the scene's."""
    mean = np.mean([key.view.up for key in keys], axis=0)
    largest = int(np.abs(mean).argmax())
    name = ("-" if mean[largest] < 0 else "") + "xyz"[largest]
    axis = axis_vector(name)
    is_axis = all(
        np.allclose(np.array(key.view.up) / (np.linalg.norm(key.view.up) or 1), axis, atol=1e-6) for key in keys
    )
    return name if is_axis and not np.array_equal(axis, scene_up) else "scene"
