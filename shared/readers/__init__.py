"""Readers: files of points → batches of points.

``expand_inputs`` says which files are meant; ``open_source`` reads a header and gives a ``Source``, whose ``batches``
yield ``PointBatch``es in file order. Whatever is wrong with a file becomes one InputError.

==========  ====================================================================================
inputs      paths, globs and directories → files; which format a file is in
source      ``SourceInfo``, ``Source``; checks of promised counts; library failures → InputError
described   sources that another process has opened
columns     named columns → batches: which names mean what, ranges of colours
records     fixed-size binary records (LAS, binary PLY and PCD, NPY)
rows        rows of decimal numbers (text, ASCII PLY and PCD), compiled
las, laz    LAS records; LAZ and COPC decompression
ply         and ``ply_lists``, rows that hold lists
pcd, lzf    PCD and its compression
text, npy   XYZ, TXT, CSV, PTS, ASC; NPY and NPZ
e57         through pye57, an extra
==========  ====================================================================================
"""

from .inputs import KNOWN_EXTENSIONS, expand_inputs, open_source
from .source import Source, SourceInfo

__all__ = ["KNOWN_EXTENSIONS", "Source", "SourceInfo", "expand_inputs", "open_source"]
