"""The coordinator of a live run: takes what viewers say, starts frames on the ranks, and hears when they are done."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ...shared.config import LiveSection
from ...shared.errors import SplatpipeError
from ...shared.messages import FrameStart, Kind, Use
from ...shared.store import Scene
from ...shared.windows import tiles
from ..layout import Layout, Plan
from .protocol import LiveMessage, View
from .settings import changed, choices, configured, settings_of
from .steering import Steering, Wanted
from .views import camera_of, view_of

if TYPE_CHECKING:
    from ..coordinator import Progress
    from ..job import Job
    from ..transport import Transport
    from .sockets import RunLink

MAX_SCREENSHOT_PIXELS = 1 << 25
"""8K: some 0.8 GB of framebuffers with two threads."""
_IN_FLIGHT = 2
"""Frames that are begun and not drawn: the next one is selected while one is drawn; more would be old when seen."""
_POLL_S = 0.001
"""How long a coordinator that waits for ranks as well listens to the hub at a time."""
_IDLE_S = 0.25
_LATENCIES = 256
_MAX_LOOKED_AT = 1 << 26


class LiveCoordinator:
    """Starts frames when somebody has moved the camera or changed something. On rank 0.

    job : of the configuration as it was given.
    """

    def __init__(self, job: Job, layout: Layout, transport: Transport | None, plan: Plan, link: RunLink) -> None:
        self._job, self._layout, self._transport, self._link = job, layout, transport, link
        self._plan = plan
        self.plans: dict[int, Plan] = {}
        self.latency_s: list[float] = []
        self._others = [rank for rank in layout.workers if rank]
        self._display = layout.display
        self._near = job.camera(0).near
        camera = job.config.camera
        view = view_of(job)
        self._steering = Steering(view, (camera.width, camera.height), self._kept(job.config.live))
        self._ready: deque[FrameStart] = deque()
        self._under_way: deque[tuple[Use, float]] = deque()
        self._frame = 0
        self._over = False
        ranks = [{"rank": rank, "role": layout.role_of(rank)} for rank in layout.workers]
        info = job.scene.info
        run = {
            "scene": job.scene.path.name,
            "points": info.n_points,
            "cells": info.n_cells,
            "lower": list(info.lower),
            "upper": list(info.upper),
            "up": job.views.path.up.tolist(),
            "attributes": sorted(info.attributes),
            "classes": _classes(job.scene),
            "topology": job.config.pipeline.topology,
            "rasterizer": job.rasterizer,
            "ranks": ranks,
        }
        link.send({
            "kind": "ready",
            "run": run,
            "view": view.model_dump(mode="json"),
            "settings": settings_of(job.config),
            "choices": choices(job.config, job.scene),
        })  # fmt: skip

    def start(self, i: int, progress: Progress) -> FrameStart:
        """The next frame as this rank is to do it, once somebody wants one; use END once the run is over."""
        while not self._ready:
            self._hear(progress)
            longest = _POLL_S if self._under_way else _IDLE_S
            wait_s = min(self._steering.wait_s(time.monotonic()), longest) if self._has_room() else _POLL_S
            for message in self._link.receive(0.0 if self._over else wait_s):
                self._take(message)
            self._begin()
        return self._ready.popleft()

    def finished(self, note: Mapping[str, Any]) -> None:
        """Take note that the display has finished the next frame, in ``busy_s`` of its time."""
        use, begun = self._under_way.popleft()
        self.latency_s = [*self.latency_s[-_LATENCIES:], time.monotonic() - begun]
        if use is Use.MOVING:
            self._steering.scale.took(float(note.get("busy_s", 0.0)), 1 / self._steering.live.fps)

    def finish(self, progress: Progress) -> None:
        """Hear of every frame that is still to be finished."""
        while self._under_way:
            self._hear(progress, wait=True)

    @property
    def queue(self) -> int:
        """Frames that are begun and not finished."""
        return len(self._under_way)

    # --- frames ------------------------------------------------------------------------------------------------------

    def _has_room(self) -> bool:
        return len(self._under_way) < (_IN_FLIGHT if self._others else 1)

    def _begin(self) -> None:
        """Begin what is wanted, as far as there is room."""
        if self._over:
            if not self._ready and not self._under_way:
                camera = camera_of(self._steering.view, 16, 16, self._frame, self._near)
                self._send(FrameStart(camera, self._plan.number, Use.END))
            return
        while self._has_room() and (wanted := self._steering.next(time.monotonic())):
            self._start(wanted)

    def _start(self, wanted: Wanted) -> None:
        now = time.monotonic()
        (width, height), settings = wanted.size, dict(wanted.settings)
        given = self._job.config
        if wanted.size != (given.camera.width, given.camera.height):
            settings |= {"camera.width": width, "camera.height": height}
        else:
            settings = {key: value for key, value in settings.items() if key not in ("camera.width", "camera.height")}
        drawn = int(settings.get("render.supersampling", given.render.supersampling))
        self._change_to(settings, width * drawn, height * drawn)
        frame, self._frame = self._frame, self._frame + 1
        start = FrameStart(
            camera_of(wanted.view, width * drawn, height * drawn, frame, self._near), self._plan.number, wanted.use
        )
        self._under_way.append((wanted.use, now))
        if not wanted.screenshot:
            self._steering.started(frame, now)
        self._send(start)
        said = {
            "kind": "started",
            "frame": frame,
            "view": wanted.view.model_dump(mode="json"),
            "t": wanted.t,
            "still": wanted.use is not Use.MOVING,
            "scale": wanted.scale,
            "viewer": wanted.viewer,
            "camera_at": wanted.at,
            "asked_at": wanted.asked_s,
            "begun_at": now,
        }
        self._link.send(said | ({"screenshot": dict(wanted.screenshot)} if wanted.screenshot else {}))

    def _send(self, start: FrameStart) -> None:
        for rank in self._others:
            assert self._transport
            self._transport.send(rank, start)
        self._ready.append(start)

    def _change_to(self, settings: dict[str, Any], width: int, height: int) -> None:
        """Make these settings hold from the next frame on."""
        if settings == self._plan.settings:
            return
        windows = self._plan.windows
        if windows:
            windows = tuple(tiles(width, height, [1.0] * len(self._layout.render)))
        plan = replace(self._plan, number=self._plan.number + 1, windows=windows, settings=settings)
        self._plan = self.plans[plan.number] = plan
        for rank in self._others:
            assert self._transport
            self._transport.send_note(rank, Kind.PLAN, 0, plan.to_note())

    def _hear(self, progress: Progress, wait: bool = False) -> None:
        """Take note of the frames that the display has finished."""
        if not self._transport or not self._display:
            return
        while self._under_way and (wait or self._transport.has_note(self._display, Kind.FRAME_DONE)):
            self.finished(self._transport.receive_note(self._display, Kind.FRAME_DONE)[1])
            progress("rendering", self._frame)

    # --- what viewers say --------------------------------------------------------------------------------------------

    def _take(self, message: LiveMessage) -> None:
        """Do what the hub passes on."""
        said, now = message.header, time.monotonic()
        try:
            take: dict[str, Callable[[], object]] = {
                "camera": lambda: self._steering.looked(
                    _usable(View.model_validate(said["view"], strict=False)),
                    said["moving"],
                    said["t"],
                    said["viewer"],
                    now,
                    said["at"],
                ),
                "settings": lambda: self._set(said["set"], said["viewer"], now),
                "screenshot": lambda: self._shoot(said),
                "shown": lambda: self._steering.shown(said["frame"]),
                "viewers": lambda: self._steering.watched(said["pictures"], now),
                "quit": self._quit,
            }
            take.get(said["kind"], lambda: None)()
        except SplatpipeError as error:
            refused = {"kind": "refused", "viewer": said.get("viewer", 0), "request": said.get("request", 0)}
            self._link.send(refused | {"why": str(error)})

    def _set(self, wanted: Mapping[str, Any], viewer: int, now: float) -> None:
        settings = changed(self._steering.settings, wanted)
        config = configured(self._job.config, settings)
        self._job.with_config(config)  # refuses what does not suit the scene
        self._steering.set(settings, (config.camera.width, config.camera.height), self._kept(config.live), viewer, now)
        self._link.send({"kind": "settings", "settings": settings_of(config)})

    def _kept(self, live: LiveSection) -> LiveSection:
        """With no smaller pictures where their size would cost more than it saves."""
        return live if self._job.resizes else live.model_copy(update={"least_scale": 1.0})

    def _shoot(self, said: Mapping[str, Any]) -> None:
        if said["width"] * said["height"] > MAX_SCREENSHOT_PIXELS:
            size = f"{said['width']} × {said['height']}"
            raise SplatpipeError(f"screenshot: found {size} pixels, expected at most {MAX_SCREENSHOT_PIXELS:,}")
        if not self._steering.shoot(dict(said)):
            raise SplatpipeError("screenshot: too many are waiting")

    def _quit(self) -> None:
        self._over = True


def _classes(scene: Scene) -> list[int]:
    """Codes of classes that points of a scene have; none where there are too many points to look at.

    Cost: one read of a byte a point.
    """
    if "classification" not in scene.info.attributes or scene.info.n_stored > _MAX_LOOKED_AT:
        return []
    return np.flatnonzero(np.bincount(scene.attribute("classification"), minlength=1)).tolist()


def _usable(view: View) -> View:
    """A view of which a camera can be made. Raises InputError."""
    camera_of(view, 16, 16, 0, 1.0)
    return view
