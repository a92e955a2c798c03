"""Inputs larger than memory: the same scene as in memory, whatever the memory, and bounded."""

from __future__ import annotations

import numpy as np
import pytest
from splatpipe.shared.build import BuildSettings, build_scene, builder
from splatpipe.shared.build.settings import MemoryPlan
from splatpipe.shared.points import pack_normals
from splatpipe.shared.store import Scene

from .build_sources import ArraySource, cells_of, columns_for


def clouds(kind, n, rng):
    match kind:
        case "uniform":
            return rng.uniform(-50, 50, (n, 3))
        case "surface":
            p = rng.normal(size=(n, 3))
            return p / np.linalg.norm(p, axis=1)[:, None]
        case "clustered":  # a cluster far below the bucket level, and an outlier
            p = rng.normal(0, 1e-4, (n, 3))
            p[0] = 1000.0
            return p
        case "coincident":
            p = np.full((n, 3), 3.25)
            p[: n // 10] = rng.uniform(0, 8, (n // 10, 3))
            return p
        case "flat":
            return rng.uniform(0, 100, (n, 3)) * [1, 1, 1e-7]
    raise ValueError(kind)


def build(tmp, source, plan, monkeypatch, **options):
    monkeypatch.setattr(builder, "plan_memory", lambda *_: plan)
    out = tmp / f"scene-{plan.capacity}"
    report = build_scene([source], out, settings=BuildSettings(overwrite=True, **options))
    Scene.open(out).verify()
    return report, cells_of(out)


@pytest.mark.parametrize("kind", ["uniform", "surface", "clustered", "coincident", "flat"])
@pytest.mark.parametrize("point_order", ["layered", "depth-first"])
@pytest.mark.parametrize("flatness", [0.0, 1e-3])
def test_scene_does_not_depend_on_memory(tmp_path, monkeypatch, kind, point_order, flatness):
    rng = np.random.default_rng(7)
    positions = clouds(kind, 7000, rng)
    columns = columns_for(len(positions), ("rgb", "gps_time")) | {
        "normal": pack_normals(rng.normal(size=(7000, 3)) + 2)
    }
    source = ArraySource(positions, columns)
    options = {"point_order": point_order, "flatness": flatness, "points_per_cell": 32}
    report, whole = build(tmp_path, source, MemoryPlan(10_000, 900), monkeypatch, **options)
    assert report.n_partitions == 1
    assert report.spilled_bytes == 0
    for capacity in (5000, 2100):
        report, parts = build(tmp_path, source, MemoryPlan(capacity, 500), monkeypatch, **options)
        assert report.spilled_bytes > 0
        assert parts == whole
