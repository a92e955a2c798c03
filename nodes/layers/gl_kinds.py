"""Which class draws a kind with a technique. Imports what a run draws, nothing else."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...shared.errors import ConfigError

if TYPE_CHECKING:
    import moderngl

    from ...shared.layer_config import LayerSection
    from ...shared.layers.layer import Layer
    from .gl_layer import Drawn


def gl_layer(context: moderngl.Context, layer: Layer, settings: LayerSection) -> Drawn:
    """The layer on the device. Raises ConfigError for a kind that nothing draws."""
    if settings.technique in ("triangles", "strips"):
        return _mesh(context, layer, settings)
    is_instanced = settings.technique == "instancing"
    match layer.kind:
        case "arcs":
            from .gl_arcs import GlArcInstances, GlArcs

            drawn = GlArcInstances if is_instanced else GlArcs
        case "blocks":
            from .gl_blocks import GlBlockInstances, GlBlocks

            drawn = GlBlockInstances if is_instanced else GlBlocks
        case "cuboids":
            from .gl_cuboids import GlCuboidInstances, GlCuboids

            drawn = GlCuboidInstances if is_instanced else GlCuboids
        case "polygons":
            from .gl_polygons import GlPolygonInstances, GlPolygons

            drawn = GlPolygonInstances if is_instanced else GlPolygons
        case "trajectories":
            from .gl_trajectories import GlTrajectories

            drawn = GlTrajectories
        case _:
            raise _not_drawn(layer)
    return drawn(context, layer, settings)


def _mesh(context: moderngl.Context, layer: Layer, settings: LayerSection) -> Drawn:
    """The baselines that keep geometry on the device."""
    from .gl_mesh import GlMesh
    from .mesh import for_technique

    technique = settings.technique
    match layer.kind:
        case "arcs":
            from .expand_arcs import strips

            mesh = for_technique(strips(layer, settings.arcs.segments), technique)
        case "blocks":
            from .expand_blocks import strips
            from .gl_blocks import GlBlockMesh

            return GlBlockMesh(context, layer, settings, for_technique(strips(layer), technique))
        case "cuboids":
            from .expand_cuboids import strips

            mesh = for_technique(strips(layer), technique)
        case "polygons":
            from . import expand_polygons

            mesh = (expand_polygons.strips if technique == "strips" else expand_polygons.triangles)(layer)
        case "trajectories":
            from .gl_trajectories import trajectory_mesh

            return trajectory_mesh(context, layer, settings)
        case _:
            raise _not_drawn(layer)
    return GlMesh(context, layer, settings, mesh)


def _not_drawn(layer: Layer) -> ConfigError:
    return ConfigError(f"layer {layer.name}: found kind {layer.kind!r}, which nothing draws")
