// GL_POINTS of pooled cells: one draw a unit. Its vertices are the instances and its translations their vertices, all
// pairs of them, and the bit of the tag says which ones are points (figure 5 of the paper). What no pool covers is one
// instance.

void main() {
    Unit unit = units[piece.x];  // piece: unit, –, –, matrix
    Block block = block_at(piece.w);
    palette = 256u * unit.cell;
    bool pooled = unit.tag_words > 0u;
    uint i = uint(pooled ? gl_InstanceID : gl_VertexID);
    uint at = unit.first + i * record_words(unit);
    uint point = unit.colour + i;
    precise vec3 p = transformed_vertex(block.rows, at);
    bool drawn = true;
    if (pooled) {
        uint t = uint(gl_VertexID), before = (1u << t % 32u) - 1u;
        uint bits = records[at + 2u + t / 32u];
        drawn = (bits & before + 1u) != 0u;
        p += linear(block.rows, translation(unit.translation + t));
        point = records[at + 1u] + uint(bitCount(bits & before));
        for (uint k = 0u; k < t / 32u; k++) point += uint(bitCount(records[at + 2u + k]));
    }
    Square s = square_of(p.x, p.y, p.z, block);
    s.visible = s.visible && drawn;
    draw(s, drawn ? point : 0u);
}
