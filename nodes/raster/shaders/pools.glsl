// Pooled cells of one chunk: points are vertex + translation wherever a bit of the vertex's tag is set. Goes behind
// squares.glsl.

struct Unit {
    uint first;           // word of its first record
    uint count;           // records: of vertices, or of points that no pool covers
    uint tag_words;       // 0: points that no pool covers
    uint translation;     // first one of its pool
    uint n_translations;
    uint colour;          // of its first point
    uint cell;
};
layout(std430, binding = 0) restrict readonly buffer Units { Unit units[]; };
// A vertex: its place on the grid, the number of its first colour, its tag. A point that no pool covers: its place.
layout(std430, binding = 1) restrict readonly buffer Records { uint records[]; };
layout(std430, binding = 2) restrict readonly buffer Translations { uint translations[]; };
layout(std430, binding = 3) restrict readonly buffer ColourIndices { uint colours[]; };  // four a word
layout(std430, binding = 4) restrict readonly buffer Palettes { uint palettes[]; };      // 256 a cell

uint palette;  // of this invocation's cell

uint colour_of(uint point) {
    return palettes[palette + (colours[point / 4u] >> (point % 4u * 8u) & 255u)];
}

uint record_words(Unit unit) {
    return unit.tag_words == 0u ? 1u : unit.tag_words + 2u;
}

vec3 grid_place(uint word) {
    return vec3(word & 255u, word >> 8 & 255u, word >> 16 & 255u);
}

vec3 translation(uint i) {
    int word = int(translations[i]);
    return vec3(word << 24 >> 24, word << 16 >> 24, word << 8 >> 24);
}

// (x, y, z) times a matrix without its last column: written out and precise, so that it rounds as on the CPU.
vec3 linear(mat3x4 rows, vec3 p) {
    vec4 rx = rows[0], ry = rows[1], rw = rows[2];
    precise float x = rx.x * p.x + rx.y * p.y + rx.z * p.z;
    precise float y = ry.x * p.x + ry.y * p.y + ry.z * p.z;
    precise float w = rw.x * p.x + rw.y * p.y + rw.z * p.z;
    return vec3(x, y, w);
}

vec3 transformed_vertex(mat3x4 rows, uint record) {
    precise vec3 p = linear(rows, grid_place(records[record])) + vec3(rows[0].w, rows[1].w, rows[2].w);
    return p;
}
