"""A run that only looks like one, for tests of what looks at it: one rank that draws a small scene with NumPy."""

from __future__ import annotations

import io
import math
import threading
import time
from typing import Any

import numpy as np
from PIL import Image

LOWER = np.array([500_000.0, 5_200_000.0, 100.0])
UPPER = LOWER + np.array([200.0, 120.0, 40.0])
HOME: dict[str, Any] = {
    "eye": ((LOWER + UPPER) / 2 + np.array([0, -190.0, 120.0])).tolist(),
    "target": ((LOWER + UPPER) / 2).tolist(),
    "up": [0.0, 0.0, 1.0],
    "fov_deg": 45.0,
}
DEFAULTS: dict[str, Any] = {
    "camera.width": 640,
    "camera.height": 360,
    "camera.fov_deg": 45.0,
    "sampling.pixel_threshold": 32.0,
    "sampling.points_per_pixel": 2.0,
    "sampling.point_budget": 0,
    "render.point_size_px": 2,
    "render.point_size_world": 0.0,
    "render.colour": "elevation",
    "render.colormap": "viridis",
    "render.colour_range": None,
    "render.background": "#1e2127",
    "render.supersampling": 1,
    "render.edl_strength": 0.0,
    "render.edl_radius_px": 1.5,
    "filter.classes": [],
    "filter.boxes": [],
    "live.fps": 20.0,
}
KINDS: dict[str, dict[str, Any]] = {
    "camera.width": {"type": "integer", "least": 16, "most": 4096, "label": "Width", "unit": "px"},
    "camera.height": {"type": "integer", "least": 16, "most": 4096, "label": "Height", "unit": "px"},
    "camera.fov_deg": {"type": "number", "least": 5, "most": 120, "label": "Field of view", "unit": "°"},
    "sampling.pixel_threshold": {"type": "number", "least": 0, "most": 256, "label": "Pixel threshold", "unit": "px"},
    "sampling.points_per_pixel": {"type": "number", "least": 0.1, "most": 16, "label": "Points per pixel", "unit": ""},
    "sampling.point_budget": {"type": "integer", "least": 0, "most": 10**9, "label": "Point budget", "unit": ""},
    "render.point_size_px": {"type": "integer", "least": 1, "most": 32, "label": "Point size", "unit": "px"},
    "render.point_size_world": {"type": "number", "least": 0, "most": 1000, "label": "Size in the scene", "unit": "m"},
    "render.colour": {
        "type": "choice",
        "options": ["auto", "rgb", "intensity", "elevation", "classification"],
        "label": "Colour",
    },
    "render.colormap": {"type": "choice", "options": ["viridis", "magma", "terrain"], "label": "Colour map"},
    "render.colour_range": {"type": "range", "label": "Range of the map"},
    "render.background": {"type": "colour", "label": "Background"},
    "render.supersampling": {"type": "integer", "least": 1, "most": 4, "label": "Supersampling", "unit": "×"},
    "render.edl_strength": {"type": "number", "least": 0, "most": 4, "label": "Eye-dome lighting"},
    "render.edl_radius_px": {"type": "number", "least": 0.5, "most": 8, "label": "Its radius", "unit": "px"},
    "filter.classes": {"type": "classes", "label": "Classes"},
    "filter.boxes": {"type": "boxes", "label": "Clip boxes", "most": 8},
    "live.fps": {"type": "number", "least": 1, "most": 60, "label": "Pictures a second to hold", "unit": "1/s"},
}
CHOICES = {key: {"unit": "", "default": DEFAULTS[key], **about} for key, about in KINDS.items()}
_CLASS_RGB = np.zeros((256, 3), np.uint8)
_CLASS_RGB[[2, 5, 6, 9]] = [(166, 124, 82), (51, 105, 30), (216, 79, 63), (63, 143, 210)]


def make_points(n: int = 40_000) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) float64 positions of hills, houses and a lake; (n,) uint8 classes."""
    rng = np.random.default_rng(8)
    share = rng.random((n, 3))
    x, y = share[:, 0], share[:, 1]
    hills = 0.25 + 0.18 * np.sin(5 * x) * np.cos(4 * y) + 0.1 * x
    z, classes = np.maximum(hills, 0.16), np.where(hills < 0.16, 9, 2)
    trees = (np.sin(23 * x) * np.sin(19 * y) > 0.72) & (classes == 2)
    z[trees] += 0.25 * share[trees, 2]
    classes[trees] = 5
    house = (abs(x % 0.2 - 0.1) < 0.035) & (abs(y % 0.25 - 0.12) < 0.05) & (x > 0.5)
    z[house], classes[house] = 0.75 - 2 * abs(y[house] % 0.25 - 0.12), 6
    return LOWER + np.column_stack([x, y, z]) * (UPPER - LOWER), classes.astype(np.uint8)


class FakeServices:
    """Answers from the points of a run: the one nearest to a ray."""

    def __init__(self, run: FakeRun) -> None:
        self.run = run

    def pick(self, view: Any, width: int, height: int, x: float, y: float, settings: dict[str, Any]) -> dict[str, Any]:
        places, depths = self.run.project(view.eye, view.target, view.up, view.fov_deg, width, height)
        off = np.hypot(places[:, 0] - x * width, places[:, 1] - y * height) + (depths <= 0) * 1e9
        near = np.flatnonzero(off < 6)
        if not len(near):
            return {"found": False}
        i = int(near[np.argmin(depths[near])])
        attributes = {"classification": int(self.run.classes[i]), "intensity": 1234, "rgb": [120, 200, 80]}
        return {"found": True, "position": self.run.points[i].tolist(), "attributes": attributes}

    def path(self, keys: list[Any], fps: float, settings: dict[str, Any]) -> str:
        lines = "".join(f"  {{ time = {key.time}, eye = {list(key.view.eye)} }},\n" for key in keys)
        return f'[camera]\npath = "keyframes"\nkeyframes = [\n{lines}]\n'

    def expected(self, ranks: int, counts: dict[str, float]) -> list[dict[str, Any]]:
        return [{"rank": 0, "values": {"render.work_ms": 14.0, "sampling.work_ms": 5.0}}]

    def left_out(self) -> list[dict[str, Any]]:
        return [{"what": "splats", "why": "the scene has no radii", "saves": "2 ms"}]


class FakeRun:
    """Rank 0 of no run, in a thread. Context manager. Give ``link`` before entering: the hub has the services first."""

    def __init__(self) -> None:
        self.points, self.classes = make_points()
        self.link: Any = None
        self.settings = dict(DEFAULTS)
        self.view = HOME
        self.cameras: list[dict[str, Any]] = []
        """The last cameras, as they came."""
        self.refuse = ""
        """A key that no change is allowed of."""
        self._frame = 0
        self._due = threading.Event()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._live, name="fake run", daemon=True)

    def __enter__(self) -> FakeRun:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self.link.close()

    def reset(self) -> None:
        """Everything as at the start."""
        self.refuse, self.settings, self.view, self.cameras = "", dict(DEFAULTS), HOME, []
        self.link.send({"kind": "settings", "settings": self.settings})
        self._due.set()

    def project(
        self, eye: Any, target: Any, up: Any, fov_deg: float, width: int, height: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """(n, 2) pixels, (n,) depths."""
        forward = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
        right = np.cross(forward, up)
        right /= np.linalg.norm(right)
        offset = self.points - np.asarray(eye)
        depth = offset @ forward
        focal = height / 2 / math.tan(math.radians(fov_deg) / 2)
        with np.errstate(divide="ignore", invalid="ignore"):
            places = np.column_stack([offset @ right, -(offset @ np.cross(right, forward))]) * (focal / depth)[:, None]
        return places + np.array([width / 2, height / 2]), depth

    def draw(self, width: int, height: int) -> Image.Image:
        """A picture of the present view and settings."""
        v, s = self.view, self.settings
        places, depth = self.project(v["eye"], v["target"], v["up"], v["fov_deg"], width, height)
        kept = (depth > 0) & (np.abs(places) < 1e5).all(axis=1)
        if s["filter.classes"]:
            kept &= np.isin(self.classes, s["filter.classes"])
        for box in s["filter.boxes"]:
            inside = ((self.points >= box["lower"]) & (self.points <= box["upper"])).all(axis=1)
            kept &= inside == (box.get("keep", "inside") == "inside")
        order = np.flatnonzero(kept)
        order = order[np.argsort(-depth[order])]
        if s["render.colour"] == "classification":
            colours = _CLASS_RGB[self.classes[order]]
        else:
            t = ((self.points[order, 2] - LOWER[2]) / 32).clip(0, 1)[:, None]
            colours = ((1 - t) * [60, 40, 130] + t * [250, 220, 90]).astype(np.uint8)
        image = np.empty((height, width, 3), np.uint8)
        image[:] = np.frombuffer(bytes.fromhex(s["render.background"][1:7]), np.uint8)
        x, y = places[order].astype(int).T
        side = int(s["render.point_size_px"])
        for dx in range(side):
            for dy in range(side):
                on = (x + dx >= 0) & (x + dx < width) & (y + dy >= 0) & (y + dy < height)
                image[y[on] + dy, x[on] + dx] = colours[on]
        return Image.fromarray(image)

    def _live(self) -> None:
        n = len(self.points)
        run = {"scene": "valley & village", "points": n, "cells": 64, "lower": LOWER.tolist(), "upper": UPPER.tolist(),
               "up": [0.0, 0.0, 1.0], "attributes": ["rgb", "intensity", "classification"], "classes": [2, 5, 6, 9],
               "topology": "pipelined", "rasterizer": "cpu", "ranks": [{"rank": 0, "role": "render", "host": "here"}]}  # fmt: skip
        self.link.send({"kind": "ready", "run": run, "view": self.view, "settings": self.settings, "choices": CHOICES})
        camera: dict[str, Any] = {"moving": False, "t": 0.0, "viewer": 0}
        told, refine_at = 0.0, math.inf
        self._due.set()
        while not self._stop.is_set():
            for header, _ in self.link.receive(0.02):
                if header["kind"] == "camera":
                    camera, self.view = dict(header), header["view"]
                    self._due.set()
                    self.cameras = [*self.cameras[-200:], header]
                elif header["kind"] == "settings":
                    self._change(header)
                elif header["kind"] == "screenshot":
                    self._send_picture(camera, header)
            if self._due.is_set():
                self._due.clear()
                self._send_picture(camera)
                refine_at = time.monotonic() + 0.15 if camera["moving"] else math.inf
            if time.monotonic() > refine_at:
                camera = {**camera, "moving": False}
                self._due.set()
            if time.monotonic() > told + 0.5:
                told = time.monotonic()
                self._send_metrics(told)

    def _change(self, header: dict[str, Any]) -> None:
        if self.refuse and self.refuse in header["set"]:
            why = f"{self.refuse}: not today"
            self.link.send({"kind": "refused", "viewer": header["viewer"], "request": header["request"], "why": why})
            return
        self.settings |= {key: DEFAULTS[key] if value is None else value for key, value in header["set"].items()}
        self.link.send({"kind": "settings", "settings": self.settings})
        self._due.set()

    def _send_picture(self, camera: dict[str, Any], screenshot: dict[str, Any] | None = None) -> None:
        frame, self._frame = self._frame, self._frame + 1
        still = not camera["moving"]
        scale = 1.0 if still or screenshot else 0.75
        about = screenshot or {"width": self.settings["camera.width"], "height": self.settings["camera.height"]}
        width, height = max(1, round(about["width"] * scale)), max(1, round(about["height"] * scale))
        now = time.monotonic()
        self.link.send({
            "kind": "started", "frame": frame, "view": self.view, "still": still, "scale": scale, "t": camera["t"],
            "viewer": camera["viewer"], "camera_at": camera.get("at"), "asked_at": now, "begun_at": now,
            "screenshot": {name: screenshot[name] for name in ("viewer", "request")} if screenshot else None,
        })  # fmt: skip
        if not screenshot:
            camera["t"], camera["at"] = 0.0, None  # of one picture, not of another that follows by itself
        data = io.BytesIO()
        image = self.draw(width, height)
        composed = time.monotonic()
        if still:
            image.save(data, "png", compress_level=1)
        else:
            image.save(data, "jpeg", quality=80)
        header = {"kind": "screenshot" if screenshot else "picture", "frame": frame, "width": width, "height": height}
        times = {"composed_at": composed, "encoding_at": composed, "sent_at": time.monotonic()}
        self.link.send({**header, **times, "encoding": "png" if still else "jpeg"}, data.getvalue())

    def _send_metrics(self, now: float) -> None:
        wave = math.sin(now / 3)
        for rank, (role, stage, work) in enumerate(
            [("render", "render", 16), ("culling", "culling", 2), ("sampling", "sampling", 6)]
        ):
            values = {f"{stage}.work_ms": work + 2 * wave, f"{stage}.wait_ms": 18 - work + wave, "frames_per_s": 21 + 3 * wave,
                      "queue": 2, "points": 1_234_567, "cells": 120, "entries": 90, "pixels": 9.2e5, "sent_bytes_per_s": 3.2e6, "memory_bytes": 4.2e8, "cpu": 0.8}  # fmt: skip
            self.link.send({"kind": "metrics", "rank": rank, "role": role, "host": "here", "t": now, "values": values})
