"""Building a scene: batches of points → sequential octree and point-array on disk.

===================  ==================================================================================
module               owns
===================  ==================================================================================
``settings``         what a build is told (``BuildSettings``) and reports (``BuildReport``)
``ingest``           inputs → columns of finite points
``morton``           root cube, keys, the counting sort's kernels
``partition``        keys → cells, and point indices in leaf order
``flatness``         the eigenvalue criterion
``eigen``            3×3 symmetric matrices
``sets``             order inside a leaf, level-of-detail sets of inner cells
``cones``            normal cones
``neighbours``       estimated normals, splat radii
``features``         flat, edge and corner cells, quads of the flat ones
``subtree``          one partition: the above put together
``runs``             sorted runs on disk, for inputs larger than memory, and partitions that fit
``streamed``         a leaf larger than memory
``parallel``         threads over kernels
``assembly``         subtrees → one sequential octree
``point_array``      stored points: gathered, made relative to their block, appended
``coded_positions``  positions in the form of a codec, points in the order that follows from it
``pooled``           the pooled form of cells that gain by it
``writer``           the scene directory: partial, checksums, rename
``builder``          ``build_scene``: the order of all this
``shares``           inputs and partitions, dealt to ranks
``ranks``            what several processes need of each other, steps that fail on all or none
``on_ranks``         ``build_scene_on_ranks``: the same by several processes
===================  ==================================================================================
"""

from .builder import build_scene
from .settings import BuildReport, BuildSettings

__all__ = ["BuildReport", "BuildSettings", "build_scene"]
