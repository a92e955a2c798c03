"""Which class draws a kind with a technique. Imports what a run draws, nothing else."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...shared.errors import ConfigError

if TYPE_CHECKING:
    import moderngl

    from ...shared.layer_config import LayerSection
    from ...shared.layers.layer import Layer
    from .gl_layer import Drawn

TECHNIQUES = ("avc", "triangles", "strips", "instancing")


def gl_layer(context: moderngl.Context, layer: Layer, settings: LayerSection) -> Drawn:
    """The layer on the device. Raises ConfigError for a kind or technique that does not exist."""
    technique = settings.technique
    match layer.kind, technique:
        case "arcs", "avc":
            from .gl_arcs import GlArcs

            return GlArcs(context, layer, settings)
        case "arcs", "instancing":
            from .gl_arcs import GlArcInstances

            return GlArcInstances(context, layer, settings)
        case "arcs", "triangles" | "strips":
            from .expand_arcs import strips
            from .gl_mesh import GlMesh
            from .mesh import separate

            mesh = strips(layer, settings.arcs.segments)
            return GlMesh(context, layer, settings, separate(mesh) if technique == "triangles" else mesh)
        case "blocks", "avc":
            from .gl_blocks import GlBlocks

            return GlBlocks(context, layer, settings)
        case "blocks", "instancing":
            from .gl_blocks import GlBlockInstances

            return GlBlockInstances(context, layer, settings)
        case "blocks", "triangles" | "strips":
            from .expand_blocks import strips
            from .gl_blocks import GlBlockMesh
            from .mesh import separate

            mesh = strips(layer)
            return GlBlockMesh(context, layer, settings, separate(mesh) if technique == "triangles" else mesh)
        case "cuboids", "avc":
            from .gl_cuboids import GlCuboids

            return GlCuboids(context, layer, settings)
        case "cuboids", "instancing":
            from .gl_cuboids import GlCuboidInstances

            return GlCuboidInstances(context, layer, settings)
        case "cuboids", "triangles" | "strips":
            from .expand_cuboids import strips
            from .gl_mesh import GlMesh
            from .mesh import separate

            mesh = strips(layer)
            return GlMesh(context, layer, settings, separate(mesh) if technique == "triangles" else mesh)
        case "polygons", "avc":
            from .gl_polygons import GlPolygons

            return GlPolygons(context, layer, settings)
        case "polygons", "instancing":
            from .gl_polygons import GlPolygonInstances

            return GlPolygonInstances(context, layer, settings)
        case "polygons", "triangles" | "strips":
            from . import expand_polygons
            from .gl_mesh import GlMesh

            expand = expand_polygons.triangles if technique == "triangles" else expand_polygons.strips
            return GlMesh(context, layer, settings, expand(layer))
        case "trajectories", "avc" | "instancing":
            from .gl_trajectories import GlTrajectories

            return GlTrajectories(context, layer, settings)
        case "trajectories", "triangles" | "strips":
            from .gl_trajectories import trajectory_mesh

            return trajectory_mesh(context, layer, settings)
    raise ConfigError(f"layer {layer.name}: technique {technique!r} of {layer.kind}: not found")
