// Pooled cells into the framebuffer, one workgroup a unit, one invocation a vertex. A translation goes through the matrix
// where it is added: transformed ones in shared memory took as long on llvmpipe, where nine products cost no more than
// fetching three numbers for each lane.

layout(local_size_x = 64) in;

layout(std430, binding = 8) restrict readonly buffer Pieces { uvec4 pieces[]; };  // unit, –, –, matrix
uniform uint n_pieces;

void main() {
    uint id = gl_WorkGroupID.y * gl_NumWorkGroups.x + gl_WorkGroupID.x;
    if (id >= n_pieces) return;
    uvec4 piece = pieces[id];
    Unit unit = units[piece.x];
    Block block = block_at(piece.w);
    palette = 256u * unit.cell;
    uint words = record_words(unit);
    for (uint i = gl_LocalInvocationID.x; i < unit.count; i += gl_WorkGroupSize.x) {
        uint at = unit.first + i * words;
        precise vec3 vertex = transformed_vertex(block.rows, at);
        if (unit.tag_words == 0u) {
            cover(square_of(vertex.x, vertex.y, vertex.z, block), unit.colour + i);
        } else {
            uint point = records[at + 1u];
            for (uint k = 0u; k < unit.tag_words; k++) {
                for (uint bits = records[at + 2u + k]; bits != 0u; bits &= bits - 1u) {
                    uint t = unit.translation + 32u * k + uint(findLSB(bits));
                    precise vec3 p = vertex + linear(block.rows, translation(t));
                    cover(square_of(p.x, p.y, p.z, block), point);
                    point++;
                }
            }
        }
    }
}
