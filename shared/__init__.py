"""What every rank agrees on: points, octree, cameras, messages, scene store, readers, configuration.

Nothing here knows of MPI, OpenGL or sockets. The map:

=================  =====================================================================
errors             the exceptions that become one line and an exit status
points             columns of a point batch, packing of colours and normals
readers/           files of points → batches
synth/             a synthetic city scan → batches
octree             the sequential octree: flat breadth-first arrays
store, scene_info  the scene directory: plain ``.npy`` arrays and ``scene.json``
build/, rebuild    batches → scene (partition, level-of-detail sets, external), and again
camera             cameras
camera_path,       orbit, keyframes, explicit poses
keyframes
messages           what crosses from one rank to another
config             the TOML configuration of a run
colour             attribute → colour word
metrics            how far one picture is from another
surfaces           generated surfaces for benchmarks
stability/         extreme cases of the above
files              files written whole or not at all
compile_cache      where numba keeps what it compiled
=================  =====================================================================
"""
