"""What every rank agrees on: points, octree, cameras, messages, scene store, readers, configuration.

Nothing here knows of MPI, OpenGL or sockets. The map:

=================  =====================================================================
errors             the exceptions that become one line and an exit status
points             columns of a point batch, packing of colours and normals
readers/           files of points → batches
synth/             a synthetic city scan → batches
octree             the sequential octree: flat breadth-first arrays
store, scene_info  the scene directory: plain ``.npy`` arrays and ``scene.json``
array_source       where the arrays come from: files, or another rank
scene_share,       a rank's share of a scene; a scene without points
empty_scene
coded_positions,   positions in the form of a codec; the order of points in a set
set_order
pooled             pooled forms of cells
codecs/            how else a cell can hold its positions
layers/            objects besides points
framebuffer_runs   framebuffer words as they cross between ranks
build/, rebuild    batches → scene (partition, level-of-detail sets, external), and again
camera             cameras
wall, windows      screens of a display wall; tiles of a picture
camera_path,       orbit, keyframes, explicit poses
keyframes
messages           what crosses from one rank to another
message_codecs     the same in fewer bytes
config             the TOML configuration of a run
colour             attribute → colour word
metrics            how far one picture is from another
surfaces           generated surfaces for benchmarks
stability/         extreme cases of the above
files              files written whole or not at all
compile_cache      where numba keeps what it compiled
=================  =====================================================================
"""
