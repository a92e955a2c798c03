"""The coordinator of a live run: takes what viewers say, starts frames on the ranks, and hears when they are done."""

from __future__ import annotations

import platform
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ...nodes.raster import MAX_SIDE_PX
from ...shared.config import LiveSection, RunConfig
from ...shared.errors import SplatpipeError
from ...shared.messages import FrameStart, Kind, Use
from ...shared.store import Scene
from ...shared.windows import tiles
from ..layout import Layout, Plan
from .protocol import LiveMessage, View
from .settings import changed, check_size, choices, configured, settings_of
from .steering import Steering, Wanted
from .views import camera_of, view_of

if TYPE_CHECKING:
    from ..coordinator import Progress
    from ..job import Job
    from ..transport import Transport
    from .sockets import RunLink

_IN_FLIGHT = 2
"""Frames that are begun and not drawn: the next one is selected while one is drawn; more would be old when seen."""
_POLL_S = 0.001
"""How long a coordinator that waits for ranks as well listens to the hub at a time."""
_IDLE_S = 0.25
_LATENCIES = 256
_MAX_WHY = 400
"""Characters of a refusal, since a message may quote what a viewer has said."""
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
            if self._over:
                wait_s = _POLL_S if self._under_way else 0.0
            for message in self._link.receive(wait_s):
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
            try:
                self._start(wanted)
            except SplatpipeError as error:
                said = {"kind": "screenshot", **wanted.screenshot} if wanted.screenshot else {"kind": "camera"}
                self._refuse({"viewer": wanted.viewer, **said}, str(error))

    def _start(self, wanted: Wanted) -> None:
        """Begin a picture. Raises ConfigError, InputError where it cannot be had; nothing has then been begun.

        A rank that could not do what it is told would end the run: whatever can be wrong is found here.
        """
        now = time.monotonic()
        (width, height), settings = wanted.size, dict(wanted.settings)
        given = self._job.config
        if wanted.size != (given.camera.width, given.camera.height):
            settings |= {"camera.width": width, "camera.height": height}
        else:
            settings = {key: value for key, value in settings.items() if key not in ("camera.width", "camera.height")}
        if wanted.screenshot and settings != self._plan.settings:  # others are checked when they are set
            self._checked(settings, screenshot=True)
        drawn = int(settings.get("render.supersampling", given.render.supersampling))
        camera = camera_of(wanted.view, width * drawn, height * drawn, self._frame, self._near)
        self._change_to(settings, width * drawn, height * drawn)
        frame, self._frame = self._frame, self._frame + 1
        start = FrameStart(camera, self._plan.number, wanted.use)
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
            "host": platform.node(),
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
            self._refuse(said, str(error))
        except Exception as error:  # what one viewer says must not end the run of all
            self._refuse(said, f"{said['kind']} failed: {type(error).__name__}")

    def _refuse(self, said: Mapping[str, Any], why: str) -> None:
        refused = {"kind": "refused", "viewer": said.get("viewer", 0), "request": said.get("request", 0)}
        self._link.send(refused | {"of": said["kind"], "why": " ".join(why.split())[:_MAX_WHY]})

    def _checked(self, settings: Mapping[str, Any], *, screenshot: bool = False) -> RunConfig:
        """The configuration with these settings, which all ranks can have. Raises ConfigError. Cost: a few ms."""
        config = configured(self._job.config, settings)
        check_size(config, self._job.config, screenshot=screenshot)
        self._job.with_config(config)  # refuses what does not suit the scene
        return config

    def _set(self, wanted: Mapping[str, Any], viewer: int, now: float) -> None:
        settings = changed(self._steering.settings, wanted)
        config = self._checked(settings)
        self._steering.set(settings, (config.camera.width, config.camera.height), self._kept(config.live), viewer, now)
        self._link.send({"kind": "settings", "settings": settings_of(config)})

    def _kept(self, live: LiveSection) -> LiveSection:
        """With no smaller pictures where their size would cost more than it saves."""
        return live if self._job.resizes else live.model_copy(update={"least_scale": 1.0})

    def _shoot(self, said: Mapping[str, Any]) -> None:
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
    """A view of which a camera of any size can be made. Raises InputError."""
    camera_of(view, MAX_SIDE_PX, MAX_SIDE_PX, 0, 1.0)
    return view
