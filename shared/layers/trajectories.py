"""Trajectories: tracks of things that move, a node wherever they were seen.

====================  =======  ===================================================================
attribute             dtype    meaning
====================  =======  ===================================================================
of an object
trajectory            u4       which one it is a run of: a place in the parameter ``names``
of an element
position              3 × f4   of the node, relative to the layer's origin
time                  f4       seconds since the parameter ``time_origin``
speed                 f4       world units a second
acceleration          f4       of the speed, world units a second, a second
role                  u1       NODE; or NEIGHBOUR or SHARED, of another run of the same trajectory
====================  =======  ===================================================================

4 bytes an object, 25 an element; on the device 28 (role and trajectory are one word), and 16 a segment.

An object is a run of up to ``RUN`` segments, so that its box is small. Its first and its last element are NEIGHBOURs,
the next places before and after it, that joints are made with; where there is none they are at the place of the node
beside them. A run that goes on where another one ends has the node there as its second element, SHARED. Nodes at the
place of the one before are kept; segments are between places that differ.

Parameters: ``names`` of trajectories; ``time_origin``, seconds; ``radius``, what tubes are measured in, world units.
Boxes hold what is drawn within ``REACH`` radii of the nodes.

Source: "Attributed Vertex Clouds", 1.3.5.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..errors import InputError
from .layer import Layer, check_layer
from .motion import derivative, filled, path_length

OBJECT = np.dtype([("trajectory", "<u4")])
ELEMENT = np.dtype([("position", "<f4", 3), ("time", "<f4"), ("speed", "<f4"), ("acceleration", "<f4"), ("role", "u1")])

NODE, NEIGHBOUR, SHARED = range(3)
RUN = 32
REACH = 4.0
MOST_TRAJECTORIES = 100_000
NAME_LENGTH = 64
_NAME_BYTES = 12 << 20  # layer.json holds them
_LARGEST = 1e30


def bounds(layer: Layer) -> tuple[np.ndarray, np.ndarray]:
    """((n, 3), (n, 3)) float64 boxes, relative to the origin."""
    position, first = layer.elements["position"].astype(np.float64), layer.first_element
    position[first[:-1]], position[first[1:] - 1] = position[first[:-1] + 1], position[first[1:] - 2]
    reach = REACH * float(layer.parameters["radius"])
    return np.minimum.reduceat(position, first[:-1]) - reach, np.maximum.reduceat(position, first[:-1]) + reach


def check(layer: Layer) -> None:
    """Raise InputError for parameters that are missing, and runs that do not have the form described above."""
    where, parameters = f"layer {layer.name}", layer.parameters
    names = parameters.get("names")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise InputError(f"{where}: parameter names: expected a list of texts")
    for key, least in (("radius", 1e-30), ("time_origin", -_LARGEST)):
        value: Any = parameters.get(key)
        if type(value) not in (int, float) or not least <= value <= _LARGEST:
            raise InputError(f"{where}: parameter {key}: found {str(value)[:40]}, expected a number")
    number = layer.objects["trajectory"]
    if (number >= len(names)).any():
        found = number[number >= len(names)][0]
        raise InputError(f"{where}: trajectory: found number {found}, expected one of {len(names)}")
    first, role = layer.first_element, layer.elements["role"]
    short = np.diff(first) < 3
    if short.any():
        raise InputError(f"{where}: object {int(short.argmax())}: expected a node and two neighbours at least")
    expected = np.zeros(len(role), bool)
    expected[first[:-1]] = expected[first[1:] - 1] = True
    bad = ((role == NEIGHBOUR) != expected) | (role > SHARED)
    if bad.any():
        i = int(bad.argmax())
        raise InputError(f"{where}: role of element {i}: found {role[i]}, expected neighbours at both ends of objects")
    size = np.abs(layer.elements["position"]).max()
    if size > _LARGEST:
        raise InputError(f"{where}: position: found {size:g} from the origin, expected at most {_LARGEST:g}")


def trajectory_layer(
    name: str,
    position: np.ndarray,
    trajectory: np.ndarray,
    names: Sequence[str],
    time: np.ndarray | None = None,
    speed: np.ndarray | None = None,
    *,
    radius: float | None = None,
    gap_s: float | None = None,
    **parameters: Any,
) -> Layer:
    """The layer of nodes, checked and in octree order.

    position : (n, 3) float64, world.  trajectory : (n,) places in ``names``.
    time : (n,) float64, seconds; nodes of a trajectory are put in its order, those of one time stay as they are. None:
        nodes are counted, and follow each other as they are.
    speed : (n,) float64, NaN where it is not known; None: of the way between the nodes before and after.
    radius : None: 1 / 2000 of the layer's extent.
    gap_s : a trajectory is cut where two nodes are further apart in time; None: nowhere.
    Acceleration is the change of speed between the nodes before and after.
    Raises InputError for what is not finite, by name, and for more than ``MOST_TRAJECTORIES``.
    Cost: O(n log n).
    """
    names = [str(n)[:NAME_LENGTH] for n in names]
    if not len(position):
        raise InputError(f"layer {name}: found no node, expected at least one")
    if len(names) > MOST_TRAJECTORIES:
        raise InputError(f"layer {name}: found {len(names)} trajectories, expected at most {MOST_TRAJECTORIES}")
    if len(json.dumps(names)) > _NAME_BYTES:
        raise InputError(f"layer {name}: names of trajectories: found more than {_NAME_BYTES} bytes")
    for what, values in (("position", position), *((("time", time),) if time is not None else ())):
        bad = ~(np.abs(values) <= _LARGEST).reshape(len(values), -1).all(axis=1)
        if bad.any():
            i = int(bad.argmax())
            raise InputError(f"layer {name}: {what} of node {i}: found {values[i]}, expected finite numbers")
    when = np.arange(len(position), dtype=np.float64) if time is None else time
    order = np.lexsort((when, trajectory))
    position, trajectory, when = position[order], trajectory[order], when[order]
    new = np.append(True, trajectory[1:] != trajectory[:-1])
    if time is None:  # counted from the first node of each
        when = when - np.repeat(when[new], np.diff(np.append(np.flatnonzero(new), len(new))))
    if gap_s is not None:
        new[1:] |= np.diff(when) > gap_s
    part = np.cumsum(new) - 1
    moved = derivative(path_length(position, part), when, part)
    if speed is not None:
        speed = filled(speed[order], when, part)
    v = moved if speed is None else np.where(np.isnan(speed), moved, speed)

    origin = np.append((position.min(axis=0) + position.max(axis=0))[:2] / 2, position[:, 2].min())
    if radius is None:
        radius = float(np.linalg.norm(np.ptp(position, axis=0))) / 2000 or 1.0
    nodes = np.zeros(len(position), ELEMENT)
    with np.errstate(over="ignore"):  # found by check_layer
        nodes["position"], nodes["time"] = position - origin, when - when.min()
        nodes["speed"], nodes["acceleration"] = v, derivative(v, when, part)
    source, role, first = _runs(nodes["position"], part)
    elements = nodes[source]
    elements["role"] = role
    objects = np.empty(len(first) - 1, OBJECT)
    objects["trajectory"] = trajectory[source[first[:-1]]]
    parameters |= {
        "names": names,
        "time_origin": float(when.min()),
        "radius": radius,
    }
    layer = Layer(name, "trajectories", origin, objects, elements, first, parameters)
    check_layer(layer)
    return layer.in_octree_order()


def _runs(position: np.ndarray, part: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of the elements of all runs the node they are and their role; and (n + 1,) where runs begin."""
    begins = np.append(True, part[1:] != part[:-1])
    starts = begins | np.append(True, (position[1:] != position[:-1]).any(axis=1))
    place = np.cumsum(starts) - 1  # of each node
    node = np.flatnonzero(starts)  # the first of each place
    first_place = place[np.flatnonzero(begins)]
    n_places = np.diff(np.append(first_place, len(node)))
    n_runs = np.maximum(-(-(n_places - 1) // RUN), 1)
    first_run = np.cumsum(n_runs) - n_runs
    rank = place - first_place[part]
    run = first_run[part] + np.maximum(rank - 1, 0) // RUN

    of_part = np.repeat(np.arange(len(n_runs)), n_runs)
    k = np.arange(n_runs.sum()) - first_run[of_part]
    low = first_place[of_part] + RUN * k
    last = first_place[of_part] + n_places[of_part] - 1
    high = np.minimum(low + RUN, last)
    runs = np.arange(len(k))
    goes_on = np.flatnonzero(k > 0)
    n = len(position)
    source = np.concatenate(
        [
            node[np.maximum(low - 1, first_place[of_part])],
            node[low[goes_on]],
            np.arange(n),
            node[np.minimum(high + 1, last)],
        ]
    )
    role = np.repeat([NEIGHBOUR, SHARED, NODE, NEIGHBOUR], [len(k), len(goes_on), n, len(k)])
    of_run = np.concatenate([runs, goes_on, run, runs])
    stage = np.repeat([0, 1, 2, 3], [len(k), len(goes_on), n, len(k)])
    order = np.lexsort((source, stage, of_run))
    first = np.searchsorted(of_run[order], np.arange(len(k) + 1))
    return source[order], role[order].astype(np.uint8), first.astype(np.int64)


def typical_gap(time: np.ndarray, trajectory: np.ndarray) -> float | None:
    """A hundred times the median time between two nodes: what is further apart was not seen meanwhile."""
    order = np.lexsort((time, trajectory))
    steps = np.diff(time[order])[np.diff(trajectory[order]) == 0]
    steps = steps[steps > 0]
    typical = 100 * float(np.median(steps)) if len(steps) else math.inf
    return typical if math.isfinite(typical) else None
