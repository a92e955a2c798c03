// One workgroup a piece. A framebuffer word is depth bits << 32 | colour, and the least word of a pixel wins.
// PASS_WORD: one pass of 64-bit atomics. Without them, PASS_DEPTH finds the least depth, then PASS_COLOUR the least
// colour at that depth; ``precise`` makes both see the same depth.

layout(local_size_x = 64) in;

layout(std430, binding = 8) restrict readonly buffer Pieces { uvec4 pieces[]; };  // first, count, stride, block
uniform uint n_pieces;

// Reading before the atomic loses nothing: words only fall, so an old value costs at most a needless atomic.
#ifdef PASS_WORD
layout(std430, binding = 9) restrict buffer Framebuffer { uint64_t words[]; };
void cover(int pixel, uint depth, uint point) {
    if (depth <= uint(words[pixel] >> 32))
        atomicMin(words[pixel], uint64_t(depth) << 32 | uint64_t(colour[point]));
}
#else
layout(std430, binding = 9) restrict buffer Framebuffer { uvec2 words[]; };  // colour, depth bits
void cover(int pixel, uint depth, uint point) {
#ifdef PASS_DEPTH
    if (depth < words[pixel].y) atomicMin(words[pixel].y, depth);
#else
    if (depth == words[pixel].y) atomicMin(words[pixel].x, colour[point]);
#endif
}
#endif

void main() {
    uint id = gl_WorkGroupID.y * gl_NumWorkGroups.x + gl_WorkGroupID.x;
    if (id >= n_pieces) return;
    uvec4 piece = pieces[id];
    Block block = block_at(piece.w);
    ivec2 size = ivec2(viewport);
    for (uint i = gl_LocalInvocationID.x; i < piece.y; i += gl_WorkGroupSize.x) {
        uint point = piece.x + i * piece.z;
        Square s = project(point, block);
        if (s.visible) {  // no ``continue``: that costs llvmpipe a quarter of the frame
#ifdef SQUARES
            ivec2 low = max(s.corner, ivec2(0)), high = min(s.corner + s.side, size);
            for (int row = low.y; row < high.y; row++)
                for (int column = low.x; column < high.x; column++)
                    cover(row * size.x + column, s.depth, point);
#else
            cover(s.corner.y * size.x + s.corner.x, s.depth, point);
#endif
        }
    }
}
