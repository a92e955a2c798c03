"""What every rank agrees on: points, octree, cameras, messages, scene store, readers, configuration.

Nothing here knows of MPI, OpenGL or sockets. The map:

=============  ==================================================================
errors         the exceptions that become one line and an exit status
points         columns of a point batch, packing of colours and normals
readers/       files of points → batches
synth          a synthetic city scan → batches
octree         the sequential octree: flat breadth-first arrays
store          the scene directory: plain ``.npy`` arrays and ``scene.json``
build          batches → scene (partition, level-of-detail sets, out of core)
camera         cameras and camera paths
messages       what crosses from one rank to another
config         the TOML configuration of a run
colour         attribute → colour word
=============  ==================================================================
"""
