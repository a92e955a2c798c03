// A framebuffer word is depth bits << 32 | colour, and the least word of a pixel wins. Goes behind squares.glsl and a
// function ``colour_of``: the colour word of a point.
// PASS_WORD: one pass of 64-bit atomics. Without them, PASS_DEPTH finds the least depth, then PASS_COLOUR the least
// colour at that depth; ``precise`` makes both see the same depth.

// Reading before the atomic loses nothing: words only fall, so an old value costs at most a needless atomic.
#ifdef PASS_WORD
layout(std430, binding = 9) restrict buffer Framebuffer { uint64_t words[]; };
void cover_pixel(int pixel, uint depth, uint point) {
    if (depth <= uint(words[pixel] >> 32))
        atomicMin(words[pixel], uint64_t(depth) << 32 | uint64_t(colour_of(point)));
}
#else
layout(std430, binding = 9) restrict buffer Framebuffer { uvec2 words[]; };  // colour, depth bits
void cover_pixel(int pixel, uint depth, uint point) {
#ifdef PASS_DEPTH
    if (depth < words[pixel].y) atomicMin(words[pixel].y, depth);
#else
    if (depth == words[pixel].y) atomicMin(words[pixel].x, colour_of(point));
#endif
}
#endif

void cover(Square s, uint point) {
    if (s.visible) {  // no ``continue`` around it: that costs llvmpipe a quarter of the frame
        ivec2 size = ivec2(viewport);
#ifdef SQUARES
        ivec2 low = max(s.corner, ivec2(0)), high = min(s.corner + s.side, size);
        for (int row = low.y; row < high.y; row++)
            for (int column = low.x; column < high.x; column++)
                cover_pixel(row * size.x + column, s.depth, point);
#else
        cover_pixel(s.corner.y * size.x + s.corner.x, s.depth, point);
#endif
    }
}
