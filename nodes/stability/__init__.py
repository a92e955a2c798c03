"""Stiff and extreme cases of scenes: points built into a store, culled, sampled and drawn, against float64.

==============  ===============================================================
module          owns
==============  ===============================================================
``chain``       positions → file → store → nodes → frame, and its references
``projection``  pixels under far translations and wide and narrow views
``extents``     clouds of any extent
``depth``       near and far, points on and behind the camera
``clouds``      degenerate clouds: coincident, collinear, one hot octant, …
``compact``     positions in fixed point
``groups``      positions interpolated in linear groups
``pools``       positions that are sums of a vertex and a translation
``matrices``    what both are drawn with: matrices that stretch or flatten
``viewports``   pixel borders and the smallest and largest images
``splats``      degenerate and grazing splats, any ε, the smallest and largest images
``layers``      degenerate, crossing and far objects of layers
``large``       more points than 32 bits count
==============  ===============================================================
"""
