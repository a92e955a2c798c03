"""From framebuffer words to pictures: what the render rank does after the rasterizer, whatever that is.

``compose``    the views of a picture, one after the other → colours, depths, normals; the only name that others need
``panorama``   six cube faces → one equirectangular frame of words
``edl``        eye-dome lighting: how dark each pixel gets
``colour``     words, shades and background → 8 or 16 bits a channel, several drawn pixels averaged into one
``surface``    depths and normals of a frame
``wall``       screens cut out of a picture, mullions painted or left out
``rows``       compiled kernels over the rows of a frame, on several threads
``reference``  the short NumPy twins of the kernels

Without any of it a picture is one pass (``shared.colour.frame_to_rgba``) and nothing here but ``compose`` is imported.
"""
