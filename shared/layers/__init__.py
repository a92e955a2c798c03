"""Layers: what a scene has besides points. Each object is one record, from which a shader makes its geometry.

======================  ==================================================================================
module                  content
======================  ==================================================================================
``layer``               a layer in memory: objects, elements, parameters; its octree
``box_octree``          boxes of objects → sequential octree
``layer_store``         a layer on disk
``kinds``               the kinds by name
``cuboids`` …           the record of each kind, what it may hold, and where its objects lie
``outlines``            outlines of any sort → fans, of which polygons consist
``motion``              speed and acceleration of tracks
``hierarchy``           trees with sizes → treemap, sunburst
``readers``             files → layers
======================  ==================================================================================

Layers lie in world axes, heights along +z. Positions are float32 relative to the layer's origin, which is float64: they
are exact to 2**-24 of the layer's extent, wherever it lies.

Source: Scheibel, Buschmann, Trapp, Döllner, "Attributed Vertex Clouds" (2017); a record is its vertex.
"""
