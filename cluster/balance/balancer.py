"""On rank 0: hears what every rank's stages took, and says by which plan the next frame starts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ...shared.errors import MessageError
from ...shared.messages import Kind
from ..layout import Layout, Plan
from ..transport import Transport
from . import Policy
from .hysteresis import Hysteresis, imbalance
from .subtrees import SubtreeBorders
from .tiles import TileBorders
from .times import FRAMES_A_NOTE, StageTimes

LEAST_FRAMES = FRAMES_A_NOTE // 2
"""Of a plan, that are measured before it is judged."""

SMOOTHED = 0.5
"""Share of what was measured before in what is thought now, under one plan."""


class Balancer:
    """The plans of a run, one after the other.

    policies : what may be moved.  frames : of the job.
    changes : what ``run.json`` says of each change of plan.
    """

    def __init__(self, layout: Layout, transport: Transport, policies: Sequence[Policy], frames: Sequence[int]) -> None:
        self._transport = transport
        self._policies = [(policy, Hysteresis()) for policy in policies]
        self._frames = frames
        self._to_hear = {rank: len(frames) // FRAMES_A_NOTE for rank in layout.workers if rank}
        self._heard: dict[int, dict[int, StageTimes]] = {}  # by first frame and rank
        self._n_workers = len(layout.workers)
        self._since = 0
        self._seconds: dict[int, dict[str, float]] = {}  # of the plan that holds, smoothed
        self.changes: list[dict[str, Any]] = []

    def hear(self, times: StageTimes, rank: int = 0) -> None:
        """Take what a rank's stages took."""
        self._heard.setdefault(times.first, {})[rank] = times

    def plan_for(self, position: int, plan: Plan) -> Plan:
        """The plan by which the frame at a position starts; the one that holds, or its successor. Waits for nobody."""
        for rank in self._to_hear:
            while self._to_hear[rank] and self._transport.has_note(rank, Kind.STAGE_TIMES):
                self._take(rank)
        before = plan
        for first in sorted(self._heard):
            if len(self._heard[first]) == self._n_workers:
                plan = self._judged(self._heard.pop(first), first, position, plan)
        if plan is not before:
            self._since, self._seconds = position, {}
        return plan

    def finish(self) -> None:
        """Take the notes that are still to come."""
        for rank in self._to_hear:
            while self._to_hear[rank]:
                self._take(rank)

    def _take(self, rank: int) -> None:
        self._to_hear[rank] -= 1
        _, note = self._transport.receive_note(rank, Kind.STAGE_TIMES)
        self.hear(StageTimes.from_note(note, rank), rank)

    def _judged(self, times: dict[int, StageTimes], first: int, position: int, plan: Plan) -> Plan:
        """The plan after some frames that all ranks have told of."""
        skipped = max(self._since - first, 0)  # those frames had the plan before
        if FRAMES_A_NOTE - skipped < LEAST_FRAMES:
            return plan
        seconds: dict[int, dict[str, float]] = {}
        for rank, of in times.items():
            medians = {stage: float(np.median(values[skipped:])) for stage, values in of.seconds.items()}
            held = self._seconds.get(rank, medians)
            seconds[rank] = {stage: SMOOTHED * held[stage] + (1 - SMOOTHED) * s for stage, s in medians.items()}
        self._seconds = seconds
        slowest_s = max(sum(of.values()) for of in seconds.values())
        adopting_s = max(of.adopting_s for of in times.values())
        successor = plan
        for policy, hysteresis in self._policies:
            parts = policy.parts(seconds)
            hysteresis.measured(parts)
            self._note_after(policy.name, parts)
            proposed, expected = policy.proposal(successor, seconds)
            if hysteresis.is_uneven and hysteresis.accepts(
                parts,
                expected,
                slowest_s=slowest_s,
                adopting_s=adopting_s,
                frames_held=position - self._since,
                frames_left=len(self._frames) - position,
            ):
                self._note_change(policy.name, position, parts, expected, successor, proposed)
                successor = proposed
        return plan if successor is plan else replace(successor, number=plan.number + 1)

    def _note_change(
        self, name: str, position: int, parts: np.ndarray, expected: np.ndarray, before: Plan, after: Plan
    ) -> None:
        self.changes.append(
            {
                "frame": self._frames[position],
                "moved": name,
                "reason": f"the slowest of {len(parts)} took {1e3 * parts.max():.2f} ms of a frame, "
                f"{imbalance(parts):.2f} times the mean; expected {1e3 * expected.max():.2f} ms",
                "imbalance": imbalance(parts),
                "imbalance_expected": imbalance(expected),
                "imbalance_after": None,
                "before": _borders(before, name),
                "after": _borders(after, name),
            }
        )

    def _note_after(self, name: str, parts: np.ndarray) -> None:
        """What the last change of these parts has brought, once that is measured."""
        last = next((change for change in reversed(self.changes) if change["moved"] == name), None)
        if last is not None and last["imbalance_after"] is None:
            last["imbalance_after"] = imbalance(parts)


def make_policies(
    layout: Layout, cells: Sequence[np.ndarray], width: int, height: int, tiles_stay: bool = False
) -> list[Policy]:
    """What may be moved in a layout.

    cells : by lane, number of cells of each of its subtrees.  width, height : of the picture, pixels.
    tiles_stay : they are the screens of a wall.
    """
    policies: list[Policy] = []
    for i, lane in enumerate(layout.lanes):
        if lane.culling == lane.sampling and len(lane.culling) > 1:
            policies.append(SubtreeBorders(i, lane, ("culling", "sampling"), cells[i]))
        else:
            policies += [
                SubtreeBorders(i, lane, (stage,), cells[i])
                for stage in ("culling", "sampling")
                if len(getattr(lane, stage)) > 1
            ]
    if layout.split == "tiles" and len(layout.render) > 1 and not tiles_stay:
        policies.append(TileBorders(layout, width, height))
    return policies


def send_cells(cells: Sequence[np.ndarray], transport: Transport) -> None:
    """Tell rank 0, which has no octree, how many cells each lane's subtrees have."""
    transport.send_note(0, Kind.STAGE_TIMES, 0, {"cells": [of.tolist() for of in cells]})


def receive_cells(layout: Layout, transport: Transport) -> list[np.ndarray]:
    """What ``send_cells`` sends, of the first culling rank. Raises MessageError for anything else."""
    rank = layout.lanes[0].culling[0]
    _, note = transport.receive_note(rank, Kind.STAGE_TIMES)
    try:
        cells = [np.array(of, np.int64) for of in note["cells"]]
    except (KeyError, TypeError, ValueError, OverflowError):
        cells = []
    if len(cells) != len(layout.lanes) or not all(of.ndim == 1 and len(of) and (of > 0).all() for of in cells):
        raise MessageError(f"STAGE_TIMES from rank {rank}: expected the numbers of cells of each lane's subtrees")
    return cells


def _borders(plan: Plan, name: str) -> Any:
    return plan.windows if name == "tiles" else getattr(plan, name.partition("+")[0])
