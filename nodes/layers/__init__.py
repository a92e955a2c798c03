"""Layers drawn with OpenGL: objects of all kinds into one framebuffer of words, from attributed vertices.

A kind's shaders turn a record into its geometry: transfer function and geometry generation of "Attributed Vertex
Clouds", 1.2. Besides that technique ("avc") each kind has the three that the paper holds it against: triangles,
triangle strips, hardware instancing.

======================  ==================================================================================
module                  content
======================  ==================================================================================
``gl_canvas``           context, framebuffer, read back as words
``gl_layer``            what all kinds share: records on the device, draw commands, camera
``gl_cuboids`` …        the techniques of a kind
``mesh``                triangles and strips of objects, in NumPy: what shaders are held against
``expand_cuboids`` …    the same, of a kind
``sizes``               what a layer takes on the device, by technique
``stages``              what each stage of a technique is given
======================  ==================================================================================
"""
