"""The experiment file.

```toml
[experiment]
title = "Threads"
base = "../demo.toml"                # run configuration that every point starts from; relative to this file
output = "../../out/threads"         # results; relative to this file
repeats = 3

[set]                                # the same in every point
"output.frames" = 40

[grid]                               # every combination
"pipeline.topology" = ["single", "pipelined"]
"render.threads" = [1, 2]

[[zip]]                              # keys that vary together: one more dimension of the grid
"camera.width" = [640, 1280]
"camera.height" = [360, 720]

[[point]]                            # one more point
"render.threads" = 4

[scenes.small]                       # a scene to build first; scene.path = "small" is this one
synth = 100000
```
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from ...shared.section import Section

Values = Annotated[list[Any], Field(min_length=1)]


class ExperimentSection(Section):
    """``[experiment]``.

    order : ``listed``, or ``shuffled`` within each repeat, by ``seed``.
    measure : column of the table that the plot and the scaling show.
    notes : what a reader should know beside the figures.
    """

    title: str = ""
    base: str
    output: str
    repeats: Annotated[int, Field(ge=1, le=1000)] = 3
    order: Literal["listed", "shuffled"] = "listed"
    seed: int = 0
    measure: str = "frames_per_s"
    notes: str = ""


class ScalingSection(Section):
    """``[scaling]``: speed-up and efficiency along one key.

    kind : ``strong`` (the same work, more resources) or ``weak`` (work grows with resources).
    over : the key; its smallest value is the baseline.
    along : keys that change with it, such as the scene of weak scaling.
    """

    kind: Literal["strong", "weak"]
    over: str
    along: list[str] = Field(default_factory=list)


class SceneRecipe(Section):
    """``[scenes.NAME]``: a scene made before the first run, kept in the output folder.

    inputs : point files, relative to the experiment file; or
    synth : number of points of a synthetic city.
    The others as in ``splatpipe build``.
    """

    inputs: list[str] = Field(default_factory=list)
    synth: Annotated[int, Field(ge=0)] = 0
    seed: int = 1
    point_order: str = "layered"
    points_per_cell: int = 4096
    max_depth: int = 21
    flatness: float = 0.0
    features: bool = False
    up: str = "auto"


class PaperFigure(Section):
    """``[[paper]]``: a figure of a paper, to stand beside ours.

    where : the point that it belongs to, by any keys.
    value : the paper's figure; a pair is a range.
    measure : our column.
    source : table and row.
    """

    where: dict[str, Any]
    value: float | tuple[float, float]
    measure: str = "frames_per_s"
    source: str


class ExperimentConfig(Section):
    """Everything an experiment file may hold."""

    experiment: ExperimentSection
    set: dict[str, Any] = Field(default_factory=dict)
    grid: dict[str, Values] = Field(default_factory=dict)
    zip: list[dict[str, Values]] = Field(default_factory=list)
    point: list[dict[str, Any]] = Field(default_factory=list)
    scaling: ScalingSection | None = None
    scenes: dict[str, SceneRecipe] = Field(default_factory=dict)
    paper: list[PaperFigure] = Field(default_factory=list)
