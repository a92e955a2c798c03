// Points of the point-array into the framebuffer, one workgroup a piece.

layout(local_size_x = 64) in;

layout(std430, binding = 8) restrict readonly buffer Pieces { uvec4 pieces[]; };  // first, count, stride, block
uniform uint n_pieces;

void main() {
    uint id = gl_WorkGroupID.y * gl_NumWorkGroups.x + gl_WorkGroupID.x;
    if (id >= n_pieces) return;
    uvec4 piece = pieces[id];
    Block block = block_at(piece.w);
    for (uint i = gl_LocalInvocationID.x; i < piece.y; i += gl_WorkGroupSize.x) {
        uint point = piece.x + i * piece.z;
        cover(project(point, block), point);
    }
}
